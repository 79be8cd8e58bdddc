"""Synthetic terrain: the paper's five styles from OpenSimplex noise, and rock fields made of landforms.

In: styles and seeds, or parameters. Out: heights of maps.
Stands on the node grid of simulation/.
"""
