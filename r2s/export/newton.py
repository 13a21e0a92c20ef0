"""A fabric as a cloth of Newton 1.8 (Warp): arguments of `ModelBuilder.add_cloth_mesh`.

Both of its solvers have the membrane energy mu / 2 (tr F^T F - 2) + L / 2 (J - 1 - mu / L)^2 per
area, whose stiffness at small strains is C11 = mu + L, C12 = L - mu, C33 = mu. `tri_ke` is mu
[N/m]. `tri_ka` is L [N/m] for `SolverSemiImplicit`; `SolverVBD` adds mu to it itself, so there it
is L - mu = C12.

A hinge of r2s has the moment B l / A per angle and length l of its edge, A the area of its two
triangles. VBD multiplies `edge_ke` by l: it is B l / A [N] there, another number for every edge.
`SolverSemiImplicit` multiplies by twice a triangle's area, too, which is A where both are alike:
B l / A^2 [N/m^2]. So the argument, which is one for all edges, is the mean; `set_edges` puts the
right ones into the finished model. Hinges are too stiff across diagonals.

Damping is Kelvin-Voigt. In VBD, of shear alone: `tri_kd`, on the rate of F^T F, is half of mu times
the damping time. In `SolverSemiImplicit` it acts on the rate of F, also in a rigid rotation, as a
swinging sheet's: it is 0. `edge_kd` is `edge_ke` times the time, over A for `SolverSemiImplicit`.

With `yarns`, springs along warp and weft (`ModelBuilder.add_spring`) make it orthotropic.
"""

from typing import Any, Literal, NamedTuple

import numpy as np

from r2s.export import stiffness
from r2s.export.stiffness import Loss
from r2s.export.yarns import Springs, split, springs, together
from r2s.fabrics.fabric import Fabric
from r2s.geometry.mesh import Mesh

Kind = Literal["semi_implicit", "vbd"]
LARGE = "at large strains the law is neo-Hookean, not of Green strain"
EDGES = "one bending stiffness for all edges; `r2s.export.newton.set_edges` sets each"
DAMPING = {
    "vbd": "damping of the sheet acts on shear and bending, not on stretching",
    "semi_implicit": "damping of the sheet acts on bending alone: that of stretching and shear "
    "would brake rigid rotation",
}
RIGID = "mass damping is not expressible: multiply velocities by exp(-rate dt) in each step"


class Cloth(NamedTuple):
    """- `arguments`: for `add_cloth_mesh`.
    - `springs`: for `add_spring` (`spring_arguments`); None: the sheet is isotropic.
    - `fields`: to set on the finished model: of contact.
    """

    arguments: dict[str, float]
    springs: Springs | None
    fields: dict[str, float]


def cloth(
    fabric: Fabric, mesh: Mesh, kind: Kind = "semi_implicit", *, yarns: bool = True
) -> tuple[Cloth, Loss]:
    """Arguments that make a fabric in Newton, and what is lost.

    - `kind`: the solver.
    - `yarns`: springs along warp and weft, for a mesh such as `r2s.rectangle`; without, the nearest
      isotropic sheet.

    Raises `ValueError` for a batch, for a membrane without
    positive stiffness, and for a mesh that has no yarns.
    """
    stiffness.one(fabric)
    own = stiffness.membrane_stiffness(fabric)
    lost = (*stiffness.softening(fabric), LARGE, EDGES, DAMPING[kind])
    if yarns:
        parts = split(own)
        along = springs(mesh, parts.warp, parts.weft)
        sheet, near = stiffness.isotropic(*parts[:2]), together(parts)
    else:
        along = None
        sheet = near = stiffness.isotropic(*stiffness.nearest_isotropic(own))
    lost += (RIGID,) if float(fabric.mass_damping) else ()
    hinges = stiffness.hinged(mesh, stiffness.hinge_stiffness(fabric, mesh))
    loss = Loss(
        stiffness.errors(stiffness.probes(near), stiffness.probes(own)),
        stiffness.errors(hinges, stiffness.bending_stiffness(fabric)),
        lost,
    )
    contact = {"soft_contact_mu": float(fabric.friction)}
    return Cloth(_arguments(fabric, mesh, kind, sheet), along, contact), loss


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


def spring_arguments(found: Springs, damping: float) -> list[dict[str, Any]]:
    """The arguments of `add_spring` for each spring; `damping` is the fabric's time [s]."""
    rows = zip(found.ends.tolist(), found.constants.tolist(), strict=True)
    return [
        {"i": i, "j": j, "ke": k, "kd": damping * max(k, 0.0), "control": 0.0} for (i, j), k in rows
    ]


def edge_factors(
    length: np.ndarray, area: np.ndarray, kind: Kind, bending: float, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """`edge_ke` and `edge_kd` of hinges.

    - `length`: of their edges, [m].
    - `area`: of the two triangles of each, [m^2].
    - `kind`: the solver.
    - `bending`: stiffness, [N m].
    - `damping`: time, [s].
    """
    moment = bending * length / area
    if kind == "vbd":
        return moment, damping * moment
    return moment / area, damping * moment / area**2


def set_edges(model: Any, fabric: Fabric, mesh: Mesh, kind: Kind) -> None:
    """Give every edge of a finished model, of this cloth alone, its own bending stiffness.

    For `fabric`, `mesh` and `kind` see `cloth`.
    """
    indices = model.edge_indices.numpy()  # opposite, opposite, start, end
    places = model.particle_q.numpy().astype(np.float64)
    inner = (indices[:, :2] >= 0).all(axis=1)
    first, second, start, end = (places[indices[:, i]] for i in range(4))
    area = _area(first, start, end) + _area(second, start, end)
    length = model.edge_rest_length.numpy().astype(np.float64)
    bending, damping = stiffness.hinge_stiffness(fabric, mesh), float(fabric.damping)
    properties = model.edge_bending_properties.numpy().copy()
    factors = edge_factors(length[inner], area[inner], kind, bending, damping)
    properties[inner] = np.stack(factors, axis=1)
    model.edge_bending_properties.assign(properties)


def _area(corner: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.cross(start - corner, end - corner), axis=1) / 2
