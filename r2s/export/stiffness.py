"""A fabric's stiffness in a few probes, the nearest isotropic sheet, and what an export loses.

Most simulators know isotropic sheets only. The nearest one is that whose energies in the probes are
nearest to the fabric's, by the squares of their logarithms, since that which is soft counts as
much as that which is stiff: a cloth that hangs or is lifted gives way where it is soft.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from r2s.materials.bending import HingeBending
from r2s.materials.fabric import Fabric
from r2s.materials.plate import PlateBending
from r2s.mesh.mesh import Mesh

Stiffness = Float[np.ndarray, "3 3"]
DIRECTIONS = {"warp": 0.0, "bias": np.pi / 4, "weft": np.pi / 2, "other bias": 3 * np.pi / 4}
EPSILON = 1e-3  # [1/m]: a curvature at which hinges are linear
BOUNDS = (-0.999, 0.999)  # of Poisson's ratio; at -1 and 1 an energy vanishes


@dataclass(frozen=True)
class Loss:
    """What an export loses.

    - `membrane`: by probe, the energy of what was exported over the fabric's at the same small
      strain, less 1: pulls along warp, bias and weft with free sides, shear, and both yarns alike.
    - `bending`: likewise of cylinders along warp, weft and both biases; empty: not exported.
    - `lost`: what else is, in words.
    """

    membrane: dict[str, float]
    bending: dict[str, float]
    lost: tuple[str, ...]

    @property
    def worst(self) -> float:
        """The largest error of all probes' energies, relative."""
        return max((abs(e) for e in (*self.membrane.values(), *self.bending.values())), default=0.0)


def membrane_stiffness(fabric: Fabric) -> Stiffness:
    """Stress [N/m] per strain (E11, E22, 2 E12) of the sheet at rest, of any membrane law."""
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

    angles = DIRECTIONS
    both = 2 / (1 / pull(angles["bias"]) + 1 / pull(angles["other bias"]))
    return {
        "warp": pull(angles["warp"]),
        "bias": both,
        "weft": pull(angles["weft"]),
        "shear": float(stiffness[2, 2]),
        "biaxial": float(np.sum(stiffness[:2, :2])),
    }


def isotropic(modulus: float, poisson: float) -> Stiffness:
    """The stiffness of an isotropic sheet, from E h [N/m] and Poisson's ratio [-]."""
    c11, shear = modulus / (1 - poisson**2), modulus / (2 * (1 + poisson))
    return np.array([[c11, poisson * c11, 0], [poisson * c11, c11, 0], [0, 0, shear]])


def nearest_isotropic(
    stiffness: Stiffness, bounds: tuple[float, float] = BOUNDS
) -> tuple[float, float]:
    """E h [N/m] and Poisson's ratio [-], within bounds, of the nearest isotropic sheet.

    An isotropic stiffness within the bounds comes back to rounding. Raises `ValueError` when a
    probe has no positive energy.
    """
    own = probes(stiffness)
    if not min(own.values()) > 0:
        raise ValueError(f"the membrane has no positive stiffness in every probe: {own}")

    def ratios(poisson: float) -> np.ndarray:
        unit = probes(isotropic(1.0, poisson))
        return np.log([own[name] / unit[name] for name in own])

    itself = stiffness[0, 1] / stiffness[0, 0]
    poisson = float(np.clip(itself, *bounds))
    if np.ptp(ratios(poisson)) > 1e-6:
        options = {"xatol": 1e-9}
        found: Any = minimize_scalar(
            lambda p: np.var(ratios(p)), bounds=bounds, method="bounded", options=options
        )
        poisson = float(found.x)
    return float(np.exp(ratios(poisson).mean())), poisson


def hinge_stiffness(fabric: Fabric, mesh: Mesh) -> float:
    """The stiffness of hinges [N m] on a mesh that bend most as a fabric does in all directions.

    Less than the fabric's, since hinges are too stiff across the diagonals (`hinged`); 0 for a
    fabric without bending stiffness.
    """
    own = bending_stiffness(fabric)
    if min(own.values()) <= 0:
        return 0.0
    unit = hinged(mesh, 1.0)
    return float(np.exp(np.mean([np.log(own[name] / unit[name]) for name in own])))


def errors(exported: dict[str, float], own: dict[str, float]) -> dict[str, float]:
    """Relative error of each probe in which the fabric has a stiffness."""
    return {name: exported[name] / own[name] - 1 for name in own if own[name] > 0}


def hinged(mesh: Mesh, stiffness: float) -> dict[str, float]:
    """Bending stiffness [N m] of the triangles of a mesh as hinges, bent to a cylinder along each
    direction.

    `stiffness`: of the hinges, [N m].

    Along the lines of a grid that is `stiffness`; across its diagonals it is more (see
    `r2s.materials.bending`), and in part three times as much where all diagonals are parallel.
    """
    hinges, plate = HingeBending(jnp.ones((), float)), PlateBending.make(1.0)
    mesh = Mesh.make(np.asarray(mesh.rest), np.asarray(mesh.faces))
    middle = np.asarray(mesh.rest) - np.asarray(mesh.rest).mean(axis=0)
    found = {}
    for name, angle in DIRECTIONS.items():
        along = middle @ [np.cos(angle), np.sin(angle)]
        lifted = np.concatenate([middle, EPSILON * along[:, None] ** 2 / 2], axis=1)
        of_hinges, of_plate = (_energy(mesh, law, lifted) for law in (hinges, plate))
        found[name] = stiffness * of_hinges / of_plate
    return found


def _energy(mesh: Mesh, law: Any, x) -> float:
    bent = law.bends(mesh).curvatures_at(jnp.asarray(x, float))
    density = jax.vmap(law.energy_density)(law.curvatures(mesh, bent))
    return float(jnp.sum(law.areas(mesh) * density))


def one(fabric: Fabric) -> None:
    """Raise `ValueError` for a batch of fabrics."""
    if jnp.ndim(fabric.density):
        shape = jnp.shape(fabric.density)
        raise ValueError(f"one fabric is exported at a time, got a batch of shape {shape}")


def loss_of(fabric: Fabric, near: Stiffness, mesh: Mesh | None, lost: tuple[str, ...]) -> Loss:
    """What is lost of a fabric where its membrane becomes one of constant stiffness.

    - `near`: that stiffness, [N/m].
    - `mesh`: on which it bends by hinges of `hinge_stiffness`; None: it does not bend.
    - `lost`: what else is.
    """
    bending = hinge_stiffness(fabric, mesh) if mesh is not None else 0.0
    errors_of_bending = {}
    if mesh is not None and bending:
        errors_of_bending = errors(hinged(mesh, bending), bending_stiffness(fabric))
    membrane = errors(probes(near), probes(membrane_stiffness(fabric)))
    return Loss(membrane, errors_of_bending, (*softening(fabric), *lost))


def softening(fabric: Fabric) -> tuple[str, ...]:
    """What a law of constant stiffness loses of the fabric's laws."""
    laws = ((fabric.membrane, "strain"), (fabric.bending, "curvature"))
    return tuple(
        f"{type(law).__name__}: stiffness follows the {what}; that of the flat sheet at rest is "
        "exported"
        for law, what in laws
        if any(
            word in type(law).__name__ for word in ("Table", "Spring", "Stiffening", "Softening")
        )
    )
