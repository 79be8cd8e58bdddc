"""One command for a GPU for a quarter of an hour: `python -m travjax.experiments.gpu`.

In: a preset, a number of seconds. Out: a folder of figures about the device, trained estimators and their scores.
Stands on the other experiments and all that these stand on.
"""
