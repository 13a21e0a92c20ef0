"""A fabric for other simulators: their parameters, and what is lost on the way.

- `stiffness`: a fabric's stiffness in probes, the nearest sheet and springs, and the `Loss`.
- `mujoco`: a flex, as MJCF.
- `newton`: a cloth of Newton (Warp), as arguments and stiffness of every edge.
- `arcsim`: a material file of ARCSim and DiffSim.
- `pybullet`: springs of a soft body.

None of them needs the simulator that it writes for.
"""

from r2s.export.stiffness import Loss

__all__ = ["Loss"]
