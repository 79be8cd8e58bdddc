"""Trajectories driven in a physics engine, MuJoCo: a judge of the contact models, never called ground truth.

In: heights of maps, a Setup, and the `[physics]` table of the robot's file. Out: whether and how each driven trajectory
fails. Stands on MuJoCo (the extra `physics`) and simulation.
"""
