"""Point clouds and meshes as rasters: LAS, LAZ, PLY, PCD, text of x y z, and surfaces of triangles.

In: a file and how it is to be read. Out: a raster of rasters/, the lattice that the points are or averages in cells.
Stands on laspy and trimesh, which are imported where they are used, and on rasters/.
"""
