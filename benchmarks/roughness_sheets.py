"""Sheets of material points with and without what damps them, and their exact derivatives."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import IsotropicSpace
from r2s.mpm.sheet import Sheet
from r2s.scenarios.on_points import MEMBRANE_DAMPING, material_points
from r2s.scenarios.scenario import Scenario, rollout

DENSITY, MODULUS, RATIO = 0.19, 100.0, 0.3  # [kg/m^2], [N/m], [-]
SOFT = 1e-6  # times the stiffness between layers: they pass through each other


class Physics(NamedTuple):
    """- `damping`: of membrane and of bending, [s]. - `air`, `layers`: whether they push."""

    membrane: float
    bending: float
    air: bool
    layers: bool = True


PUBLISHED = Physics(0.0, 0.0, False)
OURS = Physics(MEMBRANE_DAMPING, 0.01, True)


def family_of(physics: Physics) -> IsotropicSpace:
    """Isotropic sheets with the damping."""
    return IsotropicSpace.make(DENSITY, damping=physics.bending)


def place_of(space: IsotropicSpace, modulus: float = MODULUS) -> Float[Array, " dim"]:
    """The sheet's, with a modulus times thickness [N/m]."""
    values = zip(space.ranges, (modulus, RATIO), strict=True)
    return jnp.stack([bound.to_unit(jnp.asarray(value, float)) for bound, value in values])


def made(scenario: Scenario, physics: Physics, stiffest: Fabric) -> tuple[Scenario, Sheet]:
    """The scenario and its material points, whose steps suit all physics, for one compilation."""
    strictest = dataclasses.replace(stiffest, damping=jnp.asarray(OURS.bending, float))
    solver = material_points(scenario, strictest, membrane_damping=MEMBRANE_DAMPING)
    array = lambda value: jnp.asarray(value, float)
    force = 1.0 if physics.layers else SOFT
    soften = lambda transverse: jax.tree.map(lambda leaf: force * leaf, transverse)
    transverse = dataclasses.replace(soften(solver.transverse), onset=solver.transverse.onset)
    background = dataclasses.replace(solver.background, forward_mode=True)
    solver = dataclasses.replace(
        solver,
        transverse=transverse,
        background=background,
        membrane_damping=array(physics.membrane),
    )
    if physics.air:
        return scenario, solver
    still = lambda part: eqx.tree_at(lambda p: p.scene.air.density, part, array(0.0))
    return still(scenario), still(solver)


@eqx.filter_jit
def positions(scenario: Scenario, solver: Sheet, space: IsotropicSpace, place: Array) -> Array:
    """Of the vertices at all frames [m]."""
    return rollout(scenario, space(place), solver=solver).x


@eqx.filter_jit
def derivative(scenario: Scenario, solver: Sheet, space: IsotropicSpace, place: Array):
    """Positions [m], and their derivatives [m/range]."""
    moved = lambda place: (rollout(scenario, space(place), solver=solver).x,) * 2
    slope, x = jax.jacfwd(moved, has_aux=True)(place)
    return x, slope


def size(slope: np.ndarray) -> np.ndarray:
    """Of a derivative (frame vertex axis dim): root mean square over vertices [m/range]."""
    return np.sqrt(np.mean(np.sum(slope.astype(float) ** 2, axis=(2, 3)), axis=1))
