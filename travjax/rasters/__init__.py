"""Rasters of heights from files: GeoTIFF and whatever GDAL reads, pictures, NumPy arrays.

In: a file and how it is to be read. Out: the heights at the nodes of the grid, in metres, tile by tile.
Stands on rasterio and pyproj, which are imported where they are used, and on simulation/grid.py.
"""
