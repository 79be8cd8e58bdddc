"""Training of the estimators.

In: a run and a data set. Out: checkpoints and logs in the run's folder; tables and figures of test maps.
Stands on Optax, runs/ and estimators/.
"""
