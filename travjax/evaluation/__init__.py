"""Scores, tables and figures, of synthetic and labelled maps too.

In: maps, labels and predictions. Out: metrics, text, pictures, and how fast simulator and terrain are.
Stands on matplotlib, which is imported where it is used, data/ and simulation/.
"""
