"""A training run on disk and its use.

In: a preset, the folder of a run or a file of a model. Out: checkpoints, the run's estimator, its predictions and
its model card.
Stands on Orbax, models/ and data/.
"""
