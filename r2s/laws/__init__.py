"""Laws of one element: the energy that a fabric stores in a strain or a curvature.

- `membrane`: Green strain of a triangle, and the energy in it.
- `bending`: laws of the angle between two triangles (hinges). `plate`: of a face's curvature.
- `wrinkling`: what compression leaves of a membrane's energy, by wrinkles finer than a cell.
  `wrinkle_limits`: how many there can be. `moving_tangents`: derivatives in what moves.
- `tables`: laws from tables of measured stiffness.
- `stiffening`: a sheet that stiffens in closed form, and softens as it bends.
- `solid`: the stress of a piece of material, for bodies of particles.
"""
