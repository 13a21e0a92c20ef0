"""Linear algebra of a mesh: sparse symmetric matrices of 3 x 3 blocks, and their direct solution.

- `pattern`: which pairs of vertices have a block, and how elements add up to blocks.
- `dissection`: vertices eliminated by nested dissection.
- `factor`: of a matrix in lines (a band) or by nested dissection, and solutions with it.
- `system`: what depends on a mesh alone, and a matrix made ready to be solved.
"""
