"""The two estimators as Flax modules, and their inputs.

In: elevation maps and trajectories. Out: input images of the network, logits of failures, margins.
Stands on resnet/ and simulation/.
"""
