"""Estimators and simulator as files that run without travjax.

In: a predictor or a setup. Out: one function from heights to arrays, as StableHLO or ONNX, and what it is beside it as
JSON. Stands on runs and traversal.
"""
