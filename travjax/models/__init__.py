"""The two estimators as Flax modules, and what they look at.

In: elevation maps and trajectories. Out: images of the network, logits of failures, margins.
Stands on resnet/ and simulation/.
"""
