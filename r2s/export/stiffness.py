"""A fabric's stiffness in a few probes, the sheet nearest to it, and what an export loses.

Most simulators know isotropic sheets only. The nearest one is that whose energies in the probes are
nearest to the fabric's, by the squares of their logarithms: what is soft counts as much as what is
stiff, since a cloth that hangs or is lifted gives way where it is soft.

Springs along warp and weft make such a sheet orthotropic. Springs of k [N] per width [m] along the
warp add k to C11 and nothing else at small strains, those along the weft to C22. An isotropic sheet
has C11 = C12 + 2 C33. So with the fabric's C12 and C33 and k = C11 - C12 - 2 C33 both together have
the fabric's stiffness at small strains, exactly. A k may be negative; the sum is stable.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares, minimize_scalar

from r2s.materials.bending import HingeBending
from r2s.materials.fabric import Fabric
from r2s.materials.plate import PlateBending
from r2s.mesh.mesh import Mesh

Stiffness = Float[np.ndarray, "3 3"]  # stress [N/m] per strain (E11, E22, 2 E12)
DIRECTIONS = {"warp": 0.0, "45 deg": np.pi / 4, "weft": np.pi / 2, "-45 deg": 3 * np.pi / 4}
CURVATURE = 1e-3  # [1/m], at which hinges are linear
BOUNDS = (-0.999, 0.999)  # of Poisson's ratio; at -1 and 1 an energy vanishes
PARALLEL = 1e-6  # [rad]
NEGLIGIBLE = 1e-6  # of the sheet's stiffness: springs that are at their bound, and cost much
VARIABLE = ("Table", "Spring")  # in names of laws without one stiffness, or without a `small` one


class Loss(NamedTuple):
    """What an export loses.

    - `membrane`: by probe, the relative error of the exported energy at a small strain: pulls along
      warp, bias and weft with free sides, shear, and both yarns equally.
    - `bending`: likewise of cylinders along warp, weft and both biases; empty: not exported.
    - `lost`: what else is, in words.
    """

    membrane: dict[str, float]
    bending: dict[str, float]
    lost: tuple[str, ...]


class Sheet(NamedTuple):
    """An isotropic sheet with springs along the yarns.

    - `modulus`, `poisson`: E h [N/m] and Poisson's ratio [-] of the sheet.
    - `warp`, `weft`: force per width and stretch of the springs, [N/m].
    """

    modulus: float
    poisson: float
    warp: float = 0.0
    weft: float = 0.0

    @property
    def stiffness(self) -> Stiffness:
        """That of sheet and springs together at small strains, [N/m]."""
        return isotropic(self.modulus, self.poisson) + np.diag([self.warp, self.weft, 0.0])


class Springs(NamedTuple):
    """- `ends`: the two vertices of each. - `constants`: [N/m]. - `lengths`: at rest, [m]."""

    ends: Int[np.ndarray, "spring 2"]
    constants: Float[np.ndarray, " spring"]
    lengths: Float[np.ndarray, " spring"]


# The fabric


def membrane_stiffness(fabric: Fabric) -> Stiffness:
    """The stiffness [N/m] of the sheet at rest, of any membrane law."""
    zero = jnp.zeros(3, float)
    law = fabric.membrane.at(zero)
    return np.asarray(jax.hessian(law.energy_density)(zero), np.float64)


def bending_stiffness(fabric: Fabric) -> dict[str, float]:
    """Moment per curvature and width [N m] of a flat sheet, by direction, of any bending law."""
    along = fabric.bending.stiffness_along
    return {name: float(along(angle)) for name, angle in DIRECTIONS.items()}


def probes(stiffness: Stiffness) -> dict[str, float]:
    """Stiffness [N/m] in each probe: twice the energy per area at unit strain."""
    compliance = np.linalg.inv(stiffness)

    def pull(angle: float) -> float:
        c, s = np.cos(angle), np.sin(angle)
        along = np.array([c * c, s * s, c * s])
        return 1 / float(along @ compliance @ along)

    pulls = {name: pull(angle) for name, angle in DIRECTIONS.items()}
    return {
        "warp": pulls["warp"],
        "bias": 2 / (1 / pulls["45 deg"] + 1 / pulls["-45 deg"]),
        "weft": pulls["weft"],
        "shear": float(stiffness[2, 2]),
        "biaxial": float(np.sum(stiffness[:2, :2])),
    }


def positive_probes(fabric: Fabric) -> dict[str, float]:
    """`probes` of a fabric; raises `ValueError` for a batch, or when one has no positive energy."""
    if shape := jnp.shape(fabric.density):
        raise ValueError(f"one fabric is exported at a time, got a batch of shape {shape}")
    own = probes(membrane_stiffness(fabric))
    if not min(own.values()) > 0:
        raise ValueError(f"the membrane has no positive stiffness in every probe: {own}")
    return own


# The nearest sheet


def isotropic(modulus: float, poisson: float) -> Stiffness:
    """The stiffness of an isotropic sheet, from E h [N/m] and Poisson's ratio [-]."""
    c11, shear = modulus / (1 - poisson**2), modulus / (2 * (1 + poisson))
    return np.array([[c11, poisson * c11, 0], [poisson * c11, c11, 0], [0, 0, shear]])


def nearest_isotropic(fabric: Fabric, bounds: tuple[float, float] = BOUNDS) -> Sheet:
    """The nearest isotropic sheet with Poisson's ratio within bounds.

    An isotropic stiffness within the bounds comes back to rounding. Raises as `positive_probes`.
    """
    own, stiffness = positive_probes(fabric), membrane_stiffness(fabric)

    def ratios(poisson: float) -> np.ndarray:
        unit = probes(isotropic(1.0, poisson))
        return np.log([own[name] / unit[name] for name in own])

    poisson = float(np.clip(stiffness[0, 1] / stiffness[0, 0], *bounds))
    if np.ptp(ratios(poisson)) > 1e-6:
        options = {"xatol": 1e-9}
        minimum: Any = minimize_scalar(
            lambda p: np.var(ratios(p)), bounds=bounds, method="bounded", options=options
        )
        poisson = float(minimum.x)
    return Sheet(float(np.exp(ratios(poisson).mean())), poisson)


def with_springs(
    fabric: Fabric, poisson: tuple[float, float] = BOUNDS, negative: bool = True
) -> Sheet:
    """The isotropic sheet, with Poisson's ratio within bounds, and the springs along its yarns.

    Exact where such a sheet is within the bounds and its springs positive or allowed to be
    `negative`; else the nearest, by the probes' logarithms. Raises as `positive_probes`, and
    `ValueError` for a membrane whose shear is coupled to its yarns.
    """
    start, stiffness = nearest_isotropic(fabric, poisson), membrane_stiffness(fabric)
    if np.abs(stiffness[2, :2]).max() > 1e-6 * np.abs(stiffness).max():
        raise ValueError(f"warp and weft are not the axes of this membrane: {stiffness}")
    c11, c12, c22, c33 = (float(stiffness[i]) for i in ((0, 0), (0, 1), (1, 1), (2, 2)))
    base = c12 + 2 * c33
    ratio = c12 / base if base > 0 else np.inf
    springs = (c11 - base, c22 - base)
    if poisson[0] <= ratio <= poisson[1] and (negative or min(springs) >= 0):
        return Sheet(base * (1 - ratio**2), ratio, *springs)
    own, scale = probes(stiffness), start.modulus

    def sheet_of(parameters: np.ndarray) -> Sheet:
        modulus, ratio, *springs = parameters.tolist()
        warp, weft = (scale * (k if k > NEGLIGIBLE else 0.0) for k in springs)
        return Sheet(float(scale * np.exp(modulus)), ratio, warp, weft)

    def residuals(parameters: np.ndarray) -> np.ndarray:
        exported = probes(sheet_of(parameters).stiffness)
        return np.log([exported[name] / own[name] for name in own])

    bounds = [-5.0, poisson[0], 0.0, 0.0], [5.0, poisson[1], 100.0, 100.0]
    ratio = np.clip(start.poisson, poisson[0] + 1e-3, poisson[1] - 1e-3)
    return sheet_of(least_squares(residuals, [0.0, ratio, 0.1, 0.1], bounds=bounds).x)


# On a mesh


def yarn_springs(mesh: Mesh, warp: float, weft: float) -> Springs:
    """The springs of a mesh; for `warp` and `weft` [N/m] see `Sheet`.

    Each of its triangles must have an edge along the warp and one along the weft. An edge stands
    for a strip as wide as its triangles, so that those of the border are half as stiff. Raises
    `ValueError` for another mesh.
    """
    rest, pairs = np.asarray(mesh.rest, np.float64), face_edges(mesh).reshape(-1, 2)
    along = np.abs(rest[pairs[:, 1]] - rest[pairs[:, 0]])
    of_warp = along[:, 1] < PARALLEL * along[:, 0]
    of_weft = along[:, 0] < PARALLEL * along[:, 1]
    counts = np.stack([of_warp, of_weft]).reshape(2, -1, 3).sum(axis=2)
    if not (counts == 1).all():
        raise ValueError(
            f"face {int(np.argmax((counts != 1).any(axis=0)))} has not one edge along the warp and "
            "one along the weft: springs along the yarns need a mesh such as r2s.rectangle"
        )
    is_yarn = of_warp | of_weft
    edges, which = np.unique(pairs[is_yarn], axis=0, return_inverse=True)
    area = np.bincount(which.ravel(), np.repeat(np.asarray(mesh.area, np.float64), 3)[is_yarn])
    spans = rest[edges[:, 1]] - rest[edges[:, 0]]
    lengths = np.linalg.norm(spans, axis=1)
    is_warp = np.abs(spans)[:, 0] > lengths / 2
    return Springs(edges, np.where(is_warp, warp, weft) * area / lengths**2, lengths)


def face_edges(mesh: Mesh) -> Int[np.ndarray, "face 3 2"]:
    """The vertices of every face's edges, the lower number first."""
    return np.sort(np.asarray(mesh.faces)[:, [[0, 1], [1, 2], [2, 0]]], axis=2)


def hinge_stiffness(fabric: Fabric, mesh: Mesh) -> float:
    """The stiffness of hinges [N m] on a mesh that bend most as a fabric does in all directions.

    Less than the fabric's, since hinges are too stiff across the diagonals (`hinge_bending`); 0 for
    a fabric without bending stiffness.
    """
    own = bending_stiffness(fabric)
    if min(own.values()) <= 0:
        return 0.0
    unit = hinge_bending(mesh, 1.0)
    return float(np.exp(np.mean([np.log(own[name] / unit[name]) for name in own])))


def hinge_bending(mesh: Mesh, stiffness: float) -> dict[str, float]:
    """Bending stiffness [N m], by direction, of a mesh with hinges of a `stiffness` [N m].

    Along the lines of a grid it is `stiffness`; across its diagonals it is more (see
    `r2s.materials.bending`), up to three times as much where all diagonals are parallel.
    """
    hinges, plate = HingeBending(jnp.ones((), float)), PlateBending.make(1.0)
    mesh = Mesh.make(np.asarray(mesh.rest), np.asarray(mesh.faces))
    flat = np.asarray(mesh.rest) - np.asarray(mesh.rest).mean(axis=0)

    def energy(law: Any, x: np.ndarray) -> float:
        bent = law.bends(mesh).curvatures_at(jnp.asarray(x, float))
        density = jax.vmap(law.energy_density)(law.curvatures(mesh, bent))
        return float(jnp.sum(law.areas(mesh) * density))

    bending = {}
    for name, angle in DIRECTIONS.items():
        along = flat @ [np.cos(angle), np.sin(angle)]
        cylinder = np.concatenate([flat, CURVATURE * along[:, None] ** 2 / 2], axis=1)
        bending[name] = stiffness * energy(hinges, cylinder) / energy(plate, cylinder)
    return bending


# What is lost


def relative_errors(exported: dict[str, float], own: dict[str, float]) -> dict[str, float]:
    """Relative error of each probe in which the fabric has a stiffness."""
    return {name: exported[name] / own[name] - 1 for name in own if own[name] > 0}


def loss_of(fabric: Fabric, near: Stiffness, mesh: Mesh | None, lost: tuple[str, ...]) -> Loss:
    """What is lost of a fabric where its membrane becomes one of constant stiffness.

    - `near`: that stiffness, [N/m].
    - `mesh`: on which it bends by hinges of `hinge_stiffness`; None: it does not bend.
    - `lost`: what else is.
    """
    bending = {}
    if mesh is not None and (hinges := hinge_stiffness(fabric, mesh)):
        bending = relative_errors(hinge_bending(mesh, hinges), bending_stiffness(fabric))
    membrane = relative_errors(probes(near), probes(membrane_stiffness(fabric)))
    for law, what in ((fabric.bending, "curvature"), (fabric.membrane, "strain")):
        name = type(law).__name__
        if hasattr(law, "small") or any(word in name for word in VARIABLE):
            text = f"{name}: stiffness follows the {what}; that of the flat sheet is exported"
            lost = (text, *lost)
    return Loss(membrane, bending, lost)
