"""Traverse simulation: what happens to a robot on a map, by one of the contact models.

In: heights of maps and a Setup. Out: step, obstacle and tilt margins and failures of every trajectory, and where.
Stands on NumPy, JAX and simulation.
"""
