"""Adam on a loss of a motion: how the published methods descend."""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from r2s.estimation.descent import Progress
from r2s.estimation.estimate import Estimate, without_standard_errors
from r2s.estimation.gauss_newton import Joint, loss_at, size
from r2s.estimation.normal_equations import Loss
from r2s.estimation.problem import Problem

EDGE = 1e-3  # of the unit cube: beyond it the sigmoid's slope is lost


def descend(
    problems: Problem | Joint,
    loss: Loss | None,
    *,
    approach: str,
    epochs: int,
    rate: float,
    start: Float[Array, " dim"] | None = None,
    reverse: bool = True,
    progress: Progress | None = None,
) -> Estimate:
    """Adam on a `loss` [m^2] (None: the default one) in the space's place, through a sigmoid.

    From `start`, or the middle of the range. The gradient is by reverse mode, or by forward mode
    for a solver that has no other. Returns the best epoch; one whose loss or gradient is not finite
    is the last. Raises `RuntimeError` when the first one's loss is not.
    """
    began = time.perf_counter()
    problems = (problems,) if isinstance(problems, Problem) else problems
    space = problems[0].space
    place = jnp.full(space.dim, 0.5, float) if start is None else jnp.clip(start, EDGE, 1 - EDGE)
    raw: Any = jnp.log(place) - jnp.log1p(-place)  # optax gives back what it is given
    optimiser = optax.adam(rate)
    state = optimiser.init(raw)
    losses, history = [], []
    for epoch in range(epochs):
        value, slope = _evaluate(problems, raw, loss, reverse)
        losses.append(float(value))
        history.append(np.asarray(space.values(jax.nn.sigmoid(raw))))
        if not (np.isfinite(losses[-1]) and np.all(np.isfinite(np.asarray(slope)))):
            break
        update, state = optimiser.update(slope, state)
        raw = optax.apply_updates(raw, update)
        if progress is not None:
            progress(epoch, min(losses))
    if not np.isfinite(losses[0]):
        raise RuntimeError(f"{approach}: the simulation diverged at the start, {history[0]}")
    finite = np.where(np.isfinite(losses), losses, np.inf)
    best = int(np.argmin(finite))
    where = jnp.asarray(_places(space, history[best]), float)
    seconds = time.perf_counter() - began
    columns = np.array(losses)[:, None], np.stack(history)[:, None]
    return without_standard_errors(approach, space, where, losses[best], *columns, seconds)


def _places(space, values: np.ndarray) -> np.ndarray:
    pairs = zip(space.ranges, values, strict=True)
    return np.array([float(bound.place(jnp.asarray(v, float))) for bound, v in pairs])


@eqx.filter_jit
def _evaluate(problems: Joint, raw, loss: Loss | None, reverse: bool):
    """The loss and its gradient in the raw place."""
    rest = jnp.zeros(size(problems) - raw.shape[0], raw.dtype)

    def value(raw):
        found = loss_at(problems, jnp.concatenate([jax.nn.sigmoid(raw), rest]), loss)
        return found, found

    slope, found = (jax.grad if reverse else jax.jacfwd)(value, has_aux=True)(raw)
    return found, slope
