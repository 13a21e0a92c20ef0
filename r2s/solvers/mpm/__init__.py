"""The material point method: the second simulator, in 2-D and 3-D from one code.

- `grid`: the nodes, and why a motion failed.
- `transfer`: from particles to the grid (`p2g`) and back (`g2p`).
- `background`: gravity, table, walls and grippers at the nodes.
- `block`: a solid body of particles (`r2s.materials.solid`).
- `sheet`: a sheet of the same fabrics as `r2s.ImplicitCloth`.
"""

from r2s.solvers.mpm.background import Background
from r2s.solvers.mpm.block import Block, BlockState, layered
from r2s.solvers.mpm.grid import Grid
from r2s.solvers.mpm.sheet import MPMCloth, MPMState

__all__ = [
    "Background",
    "Block",
    "BlockState",
    "Grid",
    "MPMCloth",
    "MPMState",
    "layered",
]
