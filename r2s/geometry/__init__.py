"""The geometry of a sheet, apart from what it is made of.

- `mesh`: the rest shape, a triangle mesh in material coordinates.
- `patches`: the curvature of a face from the hinges around it.
- `surface`: points on a moved sheet, and the nearest one to a point in space.
"""
