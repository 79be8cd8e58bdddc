"""A training run on disk and its use.

In: a preset, the folder of a run or a file of a model. Out: checkpoints, the run's estimator, its predictions and
scores, its model card.
Stands on Orbax, estimators/ and evaluation/.
"""
