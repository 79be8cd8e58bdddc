"""A training run on disk, and what it is used for.

In: a preset, the folder of a run or a file of a model. Out: checkpoints, the run's estimator, its predictions and
scores, its model card.
Stands on Orbax, estimators/ and evaluation/.
"""
