"""How long a step may be, and where a run that diverged went wrong."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from r2s.units import Scalar
from r2s.world.scene import Control

SAFETY = 0.7  # of the limit at rest: what is stretched or compressed is stiffer


def longest_step(squares: list[tuple[Scalar, Scalar]]) -> Float[Array, ""]:
    """The longest step [s] for parts with a highest frequency and a damping time.

    `squares` are pairs of frequency squared [1/s^2] and stiffness-proportional damping time [s].
    Symplectic Euler with the damping of the step's start needs, for every frequency w,
    dt^2 w^2 + 2 dt damping w^2 <= 4. What is returned is `SAFETY` times that.
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
            "shorter step, a coarser grid, a softer or heavier material, or less damping"
        )


class Failure(NamedTuple):
    """The first step of a motion whose end is not finite, and what is not.

    - `frame`, `substep`: counted from 0.
    - `quantities`: the fields of the state, by name.
    """

    frame: int
    substep: int
    quantities: tuple[str, ...]


def diagnose(solver: Any, fabric: Any, start: Any, controls: Control) -> Failure | None:
    """Where a motion, simulated once more, is first not finite; None when it is finite.

    `controls` have the leading axes (frame, substep), as in `r2s.simulate`.
    """
    frames, substeps = controls.wind.shape[:2]
    steps = jax.tree.map(lambda leaf: leaf.reshape(frames * substeps, *leaf.shape[2:]), controls)
    finite = np.asarray(_finite(solver, fabric, start, steps))
    failed = np.flatnonzero(~finite.all(axis=1))
    if not len(failed):
        return None
    paths = jax.tree_util.tree_leaves_with_path(start)
    names = [jax.tree_util.keystr(path).lstrip(".") for path, _ in paths]
    wrong = tuple(name for name, fine in zip(names, finite[failed[0]], strict=True) if not fine)
    return Failure(int(failed[0]) // substeps, int(failed[0]) % substeps, wrong)


@eqx.filter_jit
def _finite(solver, fabric, start, steps):
    """Which fields of the state are finite at the end of every step: (step, field)."""

    def step(state, control):
        state = solver.step(fabric, state, control)
        return state, jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(state)])

    return jax.lax.scan(step, start, steps)[1]
