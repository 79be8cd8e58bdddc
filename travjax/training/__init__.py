"""Training of the estimators.

In: a run and a data set. Out: checkpoints and logs in the run's folder.
Stands on Optax, runs/ and estimators/.
"""
