"""Each estimator as a whole: its preset, its inputs, and how it is trained and applied.

In: a preset, maps, a data set. Out: networks, batches, losses; logits and margins of many samples.
Stands on Optax, models/ and data/.
"""
