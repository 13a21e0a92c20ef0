"""What a substep does to one vertex: weight, table, friction; each in closed form.

The table's push and its friction are those of the substep's end, so that neither limits it.
"""

import jax.numpy as jnp
from jaxtyping import Array

from r2s._util.units import GRAVITY
from r2s.environment.contact import PRESSURE_STIFFNESS, SLIP_SPEED
from r2s.mesh.vectors import Vector

SOLVES = 3  # of Newton's method for the slip, which comes from below, within 1 % of it


def moved_velocity(
    dt: Array,
    force: Vector,
    mass: Array,
    v: Vector,
    height: Array,
    density: Array,
    friction: Array,
    mass_damping: Array,
) -> Vector:
    """Velocities [m/s] at the end of a substep `dt` [s].

    - `force`: all but those below, [N]; `mass`: [kg]; `v`: velocities before, [m/s].
    - `height`: above the place where contact with the table begins, [m].
    - `density` [kg/m^2], `friction` [-], `mass_damping` [1/s]: of the fabric.
    """
    braking = 1 / (1 + dt * mass_damping)
    along, across, up = (braking * (u + dt * f / mass) for u, f in zip(v, force, strict=True))
    up = up - braking * dt * GRAVITY
    # depth = free depth - dt^2 PRESSURE_STIFFNESS / density * depth^2
    free = jnp.maximum(-height - dt * up, 0)
    stiff = braking * dt**2 * PRESSURE_STIFFNESS / density
    depth = 2 * free / (1 + jnp.sqrt(1 + 4 * stiff * free))
    pushed = braking * dt * PRESSURE_STIFFNESS / density * depth**2
    # a root that has a derivative where nothing slides
    speed = jnp.sqrt(along**2 + across**2 + jnp.finfo(along.dtype).tiny)
    kept = _kept_slip(speed, friction * pushed)
    return kept * along, kept * across, up + pushed


def _kept_slip(speed: Array, loss: Array) -> Array:
    """The fraction of a sliding speed [m/s] that friction leaves, of which it can take `loss`.

    With r the speed that is left, r + loss r / sqrt(r^2 + SLIP_SPEED^2) = speed.
    """
    left = jnp.maximum(speed - loss, speed * SLIP_SPEED / (SLIP_SPEED + loss))
    for _ in range(SOLVES):
        squared = left**2 + SLIP_SPEED**2
        share = loss / jnp.sqrt(squared)
        off = left * (1 + share) - speed
        left = left - off / (1 + share * SLIP_SPEED**2 / squared)
    return left / speed
