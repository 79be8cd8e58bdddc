"""Traverse simulation: what happens to a robot on a map.

In: heights of maps, a robot, an action space. Out: step, obstacle and tilt margins and failures of every trajectory.
Stands on NumPy, JAX and the top-level modules of travjax.
"""
