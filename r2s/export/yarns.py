"""An orthotropic membrane as an isotropic one with springs along warp and weft.

Springs of k [N] per width [m] along the warp add k to C11 and nothing else at small strains, those
along the weft to C22. An isotropic sheet has C11 = C12 + 2 C33. So with the fabric's C12 and C33
and k = C11 - C12 - 2 C33 both together have the fabric's stiffness at small strains, exactly, where
the simulator takes that isotropic sheet. A k may be negative; the sum is stable.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares

from r2s.export.stiffness import (
    BOUNDS,
    Stiffness,
    isotropic,
    membrane_stiffness,
    nearest_isotropic,
    one,
    probes,
)
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import Mesh

PARALLEL = 1e-6  # [rad]
NEGLIGIBLE = 1e-6  # of the sheet's stiffness: springs that are at their bound, and cost much


class Split(NamedTuple):
    """- `modulus`, `poisson`: E h [N/m] and Poisson's ratio [-] of the isotropic sheet.
    - `warp`, `weft`: force per width and stretch of the springs, [N/m].
    """

    modulus: float
    poisson: float
    warp: float
    weft: float


class Sheet(NamedTuple):
    """- `modulus`, `poisson`: E h [N/m] and Poisson's ratio [-] of an isotropic sheet.
    - `springs`: beside it; None: there are none.
    - `stiffness`: of both together at small strains, [N/m].
    """

    modulus: float
    poisson: float
    springs: "Springs | None"
    stiffness: Stiffness


class Springs(NamedTuple):
    """- `ends`: the two vertices of each. - `constants`: [N/m]. - `lengths`: at rest, [m]."""

    ends: Int[np.ndarray, "spring 2"]
    constants: Float[np.ndarray, " spring"]
    lengths: Float[np.ndarray, " spring"]


def sheet_of(
    fabric: Fabric,
    mesh: Mesh,
    yarns: bool,
    poisson: tuple[float, float] = BOUNDS,
    negative: bool = True,
) -> Sheet:
    """A fabric as an isotropic sheet, with springs along its `yarns` or the nearest one without.

    See `split` for the other arguments. Raises `ValueError` for a batch, for a membrane without
    positive stiffness, and with yarns for a mesh that has none.
    """
    one(fabric)
    own = membrane_stiffness(fabric)
    if not yarns:
        nearest = nearest_isotropic(own, poisson)
        return Sheet(*nearest, None, isotropic(*nearest))
    parts = split(own, poisson, negative)
    along = springs(mesh, parts.warp, parts.weft)
    return Sheet(parts.modulus, parts.poisson, along, together(parts))


def split(
    stiffness: Stiffness, poisson: tuple[float, float] = BOUNDS, negative: bool = True
) -> Split:
    """The isotropic sheet, with Poisson's ratio within bounds, and the springs beside it.

    Exact where that sheet is within the bounds and, unless they may be `negative`, the springs are
    not; else the nearest, by the probes' logarithms. Raises `ValueError` for a membrane whose
    shear is coupled to its yarns, or without positive stiffness in every probe.
    """
    if np.abs(stiffness[2, :2]).max() > 1e-6 * np.abs(stiffness).max():
        raise ValueError(f"warp and weft are not the axes of this membrane: {stiffness}")
    start = nearest_isotropic(stiffness, poisson)
    c11, c12, c22, c33 = (float(stiffness[i]) for i in ((0, 0), (0, 1), (1, 1), (2, 2)))
    base = c12 + 2 * c33
    ratio = c12 / base if base > 0 else np.inf
    springs = (c11 - base, c22 - base)
    if poisson[0] <= ratio <= poisson[1] and (negative or min(springs) >= 0):
        return Split(base * (1 - ratio**2), ratio, *springs)
    return _nearest(stiffness, poisson, start)


def _nearest(
    stiffness: Stiffness, poisson: tuple[float, float], start: tuple[float, float]
) -> Split:
    own, scale = probes(stiffness), start[0]

    def split_of(parameters: np.ndarray) -> Split:
        modulus, ratio, *along = parameters.tolist()
        kept = [k if k > NEGLIGIBLE else 0.0 for k in along]
        return Split(float(scale * np.exp(modulus)), ratio, scale * kept[0], scale * kept[1])

    def residuals(parameters: np.ndarray) -> np.ndarray:
        found = probes(together(split_of(parameters)))
        return np.log([found[name] / own[name] for name in own])

    bounds = [-5.0, poisson[0], 0.0, 0.0], [5.0, poisson[1], 100.0, 100.0]
    middle = [0.0, np.clip(start[1], poisson[0] + 1e-3, poisson[1] - 1e-3), 0.1, 0.1]
    found = least_squares(residuals, middle, bounds=bounds)
    return split_of(found.x)


def together(parts: Split) -> Stiffness:
    """The stiffness of sheet and springs at small strains."""
    return isotropic(parts.modulus, parts.poisson) + np.diag([parts.warp, parts.weft, 0.0])


def springs(mesh: Mesh, warp: float, weft: float) -> Springs:
    """The springs of a mesh; for `warp` and `weft` [N/m] see `Split`.

    Each of its triangles must have an edge along the warp and one along the weft. An edge stands
    for a strip as wide as its triangles, so that those of the border are half as stiff. Raises
    `ValueError` for another mesh.
    """
    rest, pairs = np.asarray(mesh.rest, np.float64), edges_of(mesh).reshape(-1, 2)
    along = np.abs(rest[pairs[:, 1]] - rest[pairs[:, 0]])
    of_warp = along[:, 1] < PARALLEL * along[:, 0]
    of_weft = along[:, 0] < PARALLEL * along[:, 1]
    each = np.stack([of_warp, of_weft]).reshape(2, -1, 3).sum(axis=2)
    if not (each == 1).all():
        raise ValueError(
            f"face {int(np.argmax((each != 1).any(axis=0)))} has not one edge along the warp and "
            "one along the weft: springs along the yarns need a mesh such as r2s.rectangle"
        )
    kept = of_warp | of_weft
    edges, which = np.unique(pairs[kept], axis=0, return_inverse=True)
    area = np.bincount(which.ravel(), np.repeat(np.asarray(mesh.area, np.float64), 3)[kept])
    lengths = np.linalg.norm(rest[edges[:, 1]] - rest[edges[:, 0]], axis=1)
    is_warp = np.abs(rest[edges[:, 1]] - rest[edges[:, 0]])[:, 0] > lengths / 2
    return Springs(edges, np.where(is_warp, warp, weft) * area / lengths**2, lengths)


def edges_of(mesh: Mesh) -> Int[np.ndarray, "face 3 2"]:
    """The vertices of every face's edges, the lower number first."""
    return np.sort(np.asarray(mesh.faces)[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
