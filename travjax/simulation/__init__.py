"""What is simulated: heights, robots, action spaces, failure events, and the nodes that a robot touches at its poses.

In: arrays, TOML files. Out: checked maps, a Setup of robot, actions, grid and contact model, and tables of nodes.
Stands on NumPy, JAX and the top-level modules of travjax.
"""
