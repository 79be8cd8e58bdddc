"""Which judge of motions brings a robot to its goal: plan on the map that a sensor saw, drive on the true one.

A configuration and an estimator go in; how each task ended by each method comes out. It stands on `planning`.
"""
