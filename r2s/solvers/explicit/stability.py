"""How long an explicit step may be."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from r2s._util.units import Scalar

SAFETY = 0.7  # of the limit at rest: what is stretched or compressed is stiffer
STEPS = 25  # to the longest step of a membrane that relaxes


def longest_step(squares: Sequence[tuple[Scalar, Scalar]]) -> Float[Array, ""]:
    """The longest step [s] for parts with a highest frequency and a damping time.

    `squares` are pairs of frequency squared [1/s^2] and stiffness-proportional damping time [s].
    Symplectic Euler with the damping of the step's start needs, for every frequency w,
    dt^2 w^2 + 2 dt damping w^2 <= 4. The result is `SAFETY` times that limit.
    """
    stiff = sum(square for square, _ in squares)
    damped = sum(square * time for square, time in squares)
    return SAFETY * 4 / (damped + jnp.sqrt(damped**2 + 4 * jnp.asarray(stiff, float)))


def longest_relaxing_step(
    membrane: Scalar, damping: Scalar, relaxation: Scalar, others: Sequence[tuple[Scalar, Scalar]]
) -> Float[Array, ""]:
    """The longest step [s] where the membrane has the viscosity of `viscosity`.

    - `membrane`: square of its highest frequency [1/s^2]; `damping`, `relaxation`: its times, [s].
    - `others`: as the `squares` of `longest_step`.

    The membrane needs d^2 w^2 (1 + 2 damping / (2 relaxation + d)) <= 4 in a step d, at which an
    amplitude changes its sign from step to step.
    """
    step = longest_step([(membrane, jnp.zeros((), float)), *others]) / SAFETY

    def nearer(_, step):  # from above: each at least halves the missing orders of magnitude
        stiffer = membrane * (1 + 2 * damping / (2 * relaxation + step))
        return longest_step([(stiffer, jnp.zeros((), float)), *others]) / SAFETY

    return SAFETY * jax.lax.fori_loop(0, STEPS, nearer, step)


def check_step(dt: float, longest: Float[Array, ""], material: str) -> None:
    """Raises `ValueError` when a step [s] is longer than the longest, unless that is traced."""
    if isinstance(longest, Tracer):
        return
    limit = float(np.min(np.asarray(longest)))
    if not dt <= limit:
        raise ValueError(
            f"the step is limited by {material} to {limit:.4g} s, got dt = {dt:.4g} s: take a "
            "shorter step, a coarser mesh or grid, a softer or heavier material, or less damping"
        )


RELAXATION = 2e-3  # [s]: docs/guide/simulate.md says what motions differ by


class Viscosity(NamedTuple):
    """Of substeps of one length, all dimensionless.

    - `share`: viscous stress over what the elastic stress is ahead.
    - `rate`: of that, which is caught up in a substep.
    """

    share: Array
    rate: Array

    @classmethod
    def make(cls, damping: Array, relaxation: Array, dt: Array) -> "Viscosity":
        """From times, [s]. Without relaxation it is Kelvin's and Voigt's, a substep behind."""
        return cls(damping / (relaxation + dt), dt / (relaxation + dt))

    def resist(self, stress: Array, relaxed: Array, begun: Array) -> tuple[Array, Array]:
        """Stress with viscosity, and the relaxed stress after the substep, [N/m].

        Where a motion has not `begun`, nothing has changed so far.
        """
        ahead = jnp.where(begun, stress - relaxed, 0)
        return stress + self.share * ahead, stress + (self.rate - 1) * ahead
