"""A fabric as a cloth of Newton 1.8 (Warp): arguments of `ModelBuilder.add_cloth_mesh`.

Both of its solvers have the membrane energy mu / 2 (tr F^T F - 2) + L / 2 (J - 1 - mu / L)^2 per
area, whose stiffness at small strains is C11 = mu + L, C12 = L - mu, C33 = mu. `tri_ke` is mu
[N/m]. `tri_ka` is L [N/m] for `SolverSemiImplicit`; `SolverVBD` adds mu to it itself, so there it
is L - mu = C12.

A hinge of r2s has the moment B l / A per angle and length l of its edge, A the area of its two
triangles. VBD multiplies `edge_ke` by l: it is B l / A [N] there. `SolverSemiImplicit` multiplies
by twice a triangle's area, too, which is A where both are equal: B l / A^2 [N/m^2]. Exported is the
mean over all edges. Hinges are too stiff across diagonals.

Damping is Kelvin-Voigt. In VBD, of shear alone: `tri_kd`, on the rate of F^T F, is half of mu times
the damping time. In `SolverSemiImplicit` it would act on rigid rotation, too: it is 0. `edge_kd` is
`edge_ke` times the time, over A for `SolverSemiImplicit`. Springs are `ModelBuilder.add_spring`.
"""

from typing import Any, Literal, NamedTuple

import numpy as np

from r2s.export import stiffness
from r2s.export.stiffness import Loss
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import Mesh

Kind = Literal["semi_implicit", "vbd"]
LARGE = "at large strains the law is neo-Hookean, not of Green strain"
EDGES = "one bending stiffness for all edges: the mean of what each should have"
DAMPING = {
    "vbd": "damping of the sheet acts on shear and bending, not on stretching",
    "semi_implicit": "damping of the sheet acts on bending alone: that of stretching and shear "
    "would brake rigid rotation",
}
RIGID = "mass damping is not expressible: multiply velocities by exp(-rate dt) in each step"


class Cloth(NamedTuple):
    """- `arguments`: for `add_cloth_mesh`.
    - `springs`: for `add_spring`, of each; none: the sheet is isotropic.
    - `fields`: to set on the finished model: of contact.
    """

    arguments: dict[str, float]
    springs: list[dict[str, Any]]
    fields: dict[str, float]


def cloth(
    fabric: Fabric, mesh: Mesh, kind: Kind = "semi_implicit", *, yarns: bool = True
) -> tuple[Cloth, Loss]:
    """Arguments that make a fabric in Newton, and what is lost.

    - `kind`: the solver.
    - `yarns`: springs along warp and weft, for a mesh such as `r2s.rectangle`; without, the nearest
      isotropic sheet.

    Raises `ValueError` for a batch, for a membrane without positive stiffness, and with yarns for a
    mesh that has none.
    """
    sheet = stiffness.with_springs(fabric) if yarns else stiffness.nearest_isotropic(fabric)
    springs = []
    if yarns:
        pairs, constants, _ = stiffness.yarn_springs(mesh, sheet.warp, sheet.weft)
        for (i, j), k in zip(pairs.tolist(), constants.tolist(), strict=True):
            damping = float(fabric.damping) * max(k, 0.0)
            springs.append({"i": i, "j": j, "ke": k, "kd": damping, "control": 0.0})
    lost = (LARGE, EDGES, DAMPING[kind])
    lost += (RIGID,) if float(fabric.mass_damping) else ()
    near = stiffness.isotropic(sheet.modulus, sheet.poisson)
    contact = {"soft_contact_mu": float(fabric.friction)}
    cloth = Cloth(_arguments(fabric, mesh, kind, near), springs, contact)
    return cloth, stiffness.loss_of(fabric, sheet.stiffness, mesh, lost)


def _arguments(fabric: Fabric, mesh: Mesh, kind: Kind, sheet: np.ndarray) -> dict[str, float]:
    shear, coupling, damping = float(sheet[2, 2]), float(sheet[0, 1]), float(fabric.damping)
    edges = np.asarray(mesh.hinge_length), np.asarray(mesh.hinge_area)
    ke, kd = edge_factors(*edges, kind, stiffness.hinge_stiffness(fabric, mesh), damping)
    return {
        "density": float(fabric.density),
        "tri_ke": shear,
        "tri_ka": coupling + shear if kind == "semi_implicit" else coupling,
        "tri_kd": damping * shear / 2 if kind == "vbd" else 0.0,
        "tri_drag": 0.0,
        "tri_lift": 0.0,
        "edge_ke": float(np.mean(ke)),
        "edge_kd": float(np.mean(kd)),
        "particle_radius": float(fabric.thickness),
    }


def edge_factors(
    length: np.ndarray, area: np.ndarray, kind: Kind, bending: float, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """`edge_ke` and `edge_kd` of hinges with a `bending` stiffness [N m] and a `damping` time [s].

    `length` [m] of their edges, and `area` [m^2] of the two triangles of each.
    """
    moment = bending * length / area
    if kind == "vbd":
        return moment, damping * moment
    return moment / area, damping * moment / area**2
