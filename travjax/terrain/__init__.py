"""Synthetic terrain: the paper's five styles from OpenSimplex noise.

In: styles and seeds, or parameters. Out: heights of maps.
Stands on the node grid of simulation/.
"""
