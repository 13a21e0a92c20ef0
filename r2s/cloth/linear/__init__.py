"""Linear algebra of a mesh: sparse symmetric matrices of 3 x 3 blocks, and their direct solution.

- `pattern`: which pairs of vertices have a block, and how elements add up to blocks.
- `dissection`: in which order vertices are eliminated (nested dissection).
- `factor`: the factor of such a matrix, front by front, and solutions with it.
"""
