"""The material point method: the second simulator, in 2-D and 3-D from one code.

- `grid`, `transfer`: the nodes, and what goes between them and particles.
- `background`: gravity, table, walls and grippers at the nodes.
- `block`: a solid body of particles (`r2s.laws.solid`).
- `transverse`, `elements`, `drag`, `sheet`: a sheet of fabric, the same as of `r2s.Cloth`.
- `stability`: how long a step may be, and where a run went wrong.
"""

from r2s.mpm.background import Background
from r2s.mpm.block import Block, BlockState, Surface, layered
from r2s.mpm.grid import Grid
from r2s.mpm.sheet import Sheet, SheetState
from r2s.mpm.stability import Failure, diagnose

__all__ = [
    "Background",
    "Block",
    "BlockState",
    "Failure",
    "Grid",
    "Sheet",
    "SheetState",
    "Surface",
    "diagnose",
    "layered",
]
