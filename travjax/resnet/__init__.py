"""The ResNet, and ImageNet weights for it from several sources.

In: images; weight files of torch, Keras and others. Out: features; checked weights in one convention.
Stands on Flax; also on h5py and torch, for files that need them.
"""
