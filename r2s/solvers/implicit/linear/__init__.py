"""Linear algebra of a mesh: sparse symmetric matrices of 3 x 3 blocks, and their direct solution.

- `pattern`: which pairs of vertices have a block, and how elements add up to blocks.
- `band`: vertices eliminated in lines, and the factor of it.
- `dissection`: vertices eliminated by nested dissection. `fronts`: the factor of it.
- `factor`: of a matrix by either, and solutions with it.
- `elimination`: what depends on a mesh alone. `system`: a matrix made ready to be solved.
"""
