"""How long an explicit step may be."""

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from r2s.units import Scalar

SAFETY = 0.7  # of the limit at rest: what is stretched or compressed is stiffer


def longest_step(squares: list[tuple[Scalar, Scalar]]) -> Float[Array, ""]:
    """The longest step [s] for parts with a highest frequency and a damping time.

    `squares` are pairs of frequency squared [1/s^2] and stiffness-proportional damping time [s].
    Symplectic Euler with the damping of the step's start needs, for every frequency w,
    dt^2 w^2 + 2 dt damping w^2 <= 4. The result is `SAFETY` times that limit.
    """
    stiff = sum(square for square, _ in squares)
    damped = sum(square * time for square, time in squares)
    return SAFETY * 4 / (damped + jnp.sqrt(damped**2 + 4 * jnp.asarray(stiff, float)))


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
