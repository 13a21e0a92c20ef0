"""Strain and stress in a sheet, from the laws of `r2s.materials.membrane`.

The sheet has sides X (the pull) and Y. The law is in the axes of warp and weft, which are turned
by an `angle` from X. Stress is force per width [N/m]: no thickness enters.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.materials.fabric import Fabric
from r2s.materials.turned import TurnedMembrane

Gradient = Float[Array, "axis 2"]  # of displacement in X and Y, [-]
Voigt = Float[Array, " 3"]  # strain (E11, E22, 2 E12) [-]
Strain = Callable[[Gradient], Voigt]


def green(gradient: Gradient) -> Voigt:
    """Green strain [-] of a gradient of displacement, exact for any rotation."""
    f = gradient + jnp.eye(2, dtype=gradient.dtype)
    return jnp.stack([(f[:, 0] @ f[:, 0] - 1) / 2, (f[:, 1] @ f[:, 1] - 1) / 2, f[:, 0] @ f[:, 1]])


def small(gradient: Gradient) -> Voigt:
    """Small strain [-] of a gradient of displacement, with the engineering shear."""
    return jnp.stack([gradient[0, 0], gradient[1, 1], gradient[0, 1] + gradient[1, 0]])


def nominal_stress(
    fabric: Fabric,
    angle: Float[Array, ""],
    gradient: Gradient,
    rate: Gradient | None = None,
    strain: Strain = green,
) -> Gradient:
    """First Piola-Kirchhoff stress [N/m], the derivative of the energy in the gradient.

    Its first column is the traction on an edge across X, per width at rest. In Green strain it is
    F S, in small strain the symmetric stress.

    - `angle`: from X to the warp, [rad].
    - `gradient`: of the displacement, [-].
    - `rate`: of the gradient [1/s]. With it the stress has the part of Kelvin-Voigt damping:
      `fabric.damping` times the stiffness times the rate of strain.
    - `strain`: `green` or `small`.
    """
    energy = TurnedMembrane(fabric.membrane, angle).energy_density
    at, pull_back = jax.vjp(strain, gradient)
    if rate is not None:
        at = at + fabric.damping * jax.jvp(strain, (gradient,), (rate,))[1]
    return pull_back(jax.grad(energy)(at))[0]
