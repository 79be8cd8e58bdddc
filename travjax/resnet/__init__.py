"""The ResNet and its ImageNet weights, whoever made them.

In: images; files of weights of torch, Keras and others. Out: features; checked weights in one convention.
Stands on Flax; on h5py and torch where files want them.
"""
