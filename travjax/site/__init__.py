"""Whole sites: where a robot can drive, and in which direction.

Heights of a raster of any size go in; margins of motion primitives from every place, and maps of them, come out. It
stands on the traverse kernels and on what reads elevation maps.
"""
