"""Each estimator as a whole: what it is made from, what it sees, how it is trained and read.

In: a preset, maps, a data set. Out: networks, batches, losses; logits and margins of many samples.
Stands on Optax, models/ and data/.
"""
