"""The material point method: the second simulator, in 2-D and 3-D from one code.

- `grid`: the nodes, and why a motion failed. `transfer`: from particles to the grid and back.
- `background`: gravity, table, walls and grippers at the nodes.
- `block`: a solid body of particles. `sheet`: a sheet of the fabrics of `r2s.ImplicitCloth`.
"""

from r2s.solvers.mpm.background import Background
from r2s.solvers.mpm.block import Block, BlockState
from r2s.solvers.mpm.grid import Grid
from r2s.solvers.mpm.sheet import MPMCloth, MPMState

__all__ = ["Background", "Block", "BlockState", "Grid", "MPMCloth", "MPMState"]
