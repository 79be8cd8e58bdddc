"""Metrics, tables and figures of predictions, data sets and maps; the benchmark of simulator and terrain.

In: maps, labels and predicted probabilities. Out: metrics, text tables, pictures, and timings.
Stands on data/, simulation/ and terrain/, and on matplotlib, which is imported where it is used.
"""
