"""Data sets: windows of real sites and synthetic maps, their labels, samples and splits.

In: files of real maps, or styles and seeds. Out: batches of maps, and a data set in one checked folder.
Stands on rasters/, point_clouds/, terrain/ and simulation/.
"""
