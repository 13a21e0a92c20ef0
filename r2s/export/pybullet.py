"""A fabric as a soft body of PyBullet: arguments of `loadSoftBody`, as far as springs can be it.

Bullet's deformable mass-spring force (`btDeformableMassSpringForce`) pulls at both ends of every
edge of the mesh with k (l - l0), one k [N/m] for all, and damps with d [N s/m] times the rate of l.
On a mesh that is a membrane of stiffness sum k l0^2 n n n n / area, n the edges' directions: shear
and coupling are what the diagonals make them, so only one number of the fabric goes over. A flat
sheet of such springs has no bending stiffness. Kelvin-Voigt damping of springs is d = k times its
time.
"""

import numpy as np

from r2s.export import stiffness
from r2s.export.stiffness import Loss, Stiffness
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import Mesh

NO_BENDING = "bending: a flat sheet of springs has none"
CAUCHY = "shear and coupling are what the mesh's diagonals make them"
RIGID = "mass damping is not expressible"
MASSES = "all vertices get the same mass"


def soft_body(fabric: Fabric, mesh: Mesh) -> tuple[dict[str, float | int], Loss]:
    """Arguments for `loadSoftBody` of a mesh's OBJ at scale 1, in metres, and what is lost.

    Raises `ValueError` for a batch, and for a membrane without positive stiffness.
    """
    own = stiffness.positive_probes(fabric)
    unit = stiffness.probes(spring_stiffness(mesh))
    spring = float(np.exp(np.mean([np.log(own[name] / unit[name]) for name in own])))
    lost = (CAUCHY, NO_BENDING, MASSES)
    lost += (RIGID,) if float(fabric.mass_damping) else ()
    arguments = {
        "mass": float(fabric.density) * float(np.sum(np.asarray(mesh.area, np.float64))),
        "useMassSpring": 1,
        "useNeoHookean": 0,
        "useBendingSprings": 0,
        "springElasticStiffness": spring,
        "springDampingStiffness": spring * float(fabric.damping),
        "springDampingAllDirections": 0,
        "frictionCoeff": float(fabric.friction),
        "collisionMargin": float(fabric.thickness),
    }
    return arguments, stiffness.loss_of(fabric, spring * spring_stiffness(mesh), None, lost)


def spring_stiffness(mesh: Mesh) -> Stiffness:
    """The membrane stiffness [-] of a mesh whose edges are springs of 1 N/m."""
    rest, pairs = np.asarray(mesh.rest, np.float64), stiffness.face_edges(mesh).reshape(-1, 2)
    edges = np.unique(pairs, axis=0)
    along = rest[edges[:, 1]] - rest[edges[:, 0]]
    squared = np.sum(along**2, axis=1)
    c, s = (along / np.sqrt(squared)[:, None]).T
    strain = np.stack([c * c, s * s, c * s])  # stretch of an edge per E11, E22, 2 E12
    return (strain * squared) @ strain.T / float(np.sum(np.asarray(mesh.area, np.float64)))
