"""The geometry of a sheet, apart from what it is made of.

- `mesh`: the rest shape, in material coordinates.
- `files`: a mesh from a file of another tool.
- `strain_samples`: where its strain is taken, in triangles or quadrilaterals.
- `bends`, `plate_elements`: where its curvature is taken, angles first.
- `vectors`: vectors and small matrices as tuples of arrays.
- `surface`: normals and masses of a moved sheet; the nearest place to a point in space.
"""
