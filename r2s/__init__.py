"""r2s: real-to-sim for fabrics.

In reading order:

- `units`, `fabric`, `presets`, `family`: what a fabric is, and which an estimator may choose.
- `mesh`, `physics`: the sheet at rest; membrane, bending, air, contact.
- `arcsim`, `cards`, `export`: fabrics from and to files, and to other simulators.
- `neighbours`, `layers`: contact of the sheet with itself.
- `linear`: sparse matrices over a mesh, and their factor.
- `increment`, `implicit`, `cloth`: the energy of a step, its minimiser, the solver.
- `mpm`: the second simulator, of material points.
- `scene`, `solver`, `scenario`: what an experiment fixes, motions over time.
- `trajectories`, `scenarios`: the six experiments of the study, on either solver.
- `recording`, `clouds`, `manifest`, `synthetic`, `observe`: observations, real and made.
- `video`, `markers`, `plane`, `forces`: stretching, from a video and a force log.
- `data`, `rgbench`: public data sets. `show`, `cli`: pictures, and the command line.
- `surface`, `losses`, `metrics`: distances between clouds and sheets.
- `estimators`: DIFFCLOUD, DiffCP, CMA-ES, PhysNet, the physics-informed network.
- `gradcheck`: derivatives against differences. `sweep`: thousands of fabrics at once.
- `interactive`: sliders for a fabric. `study`: the main job, its tables and report.
"""

from r2s.cloth.cloth import Cloth, ClothState
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.geometry.mesh import Mesh, rectangle
from r2s.recordings.recording import Recording
from r2s.scenarios.scenario import Scenario, rollout
from r2s.solver import Trajectory, predicted_memory, simulate
from r2s.world.scene import Control, Scene

__all__ = [
    "Cloth",
    "ClothState",
    "Control",
    "Fabric",
    "Mesh",
    "OrthotropicSpace",
    "Recording",
    "Scenario",
    "Scene",
    "Trajectory",
    "rollout",
    "predicted_memory",
    "rectangle",
    "simulate",
]
