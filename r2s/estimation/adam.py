"""Adam on a loss of a motion: how the published methods descend."""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from r2s.estimation.estimate import Estimate, point_estimate
from r2s.estimation.gauss_newton import Problems, loss_at, theta_length
from r2s.estimation.method import Progress
from r2s.estimation.normal_equations import Loss
from r2s.estimation.prediction import explain
from r2s.estimation.problem import Problem

EDGE = 1e-3  # of the unit cube: beyond it the sigmoid's slope is lost


def descend(
    problems: Problem | Problems,
    loss: Loss | None,
    *,
    approach: str,
    epochs: int,
    rate: float,
    start: Float[Array, " dim"] | None = None,
    reverse: bool = True,
    progress: Progress | None = None,
) -> Estimate:
    """Descend by Adam on a loss in the space's unit cube, through a sigmoid; the best epoch.

    - `loss`: [m^2]; None: the default one.
    - `epochs`, `rate`: Adam's. An epoch whose loss or gradient is not finite is the last.
    - `start`: in the unit cube; None: the middle of the range.
    - `reverse`: the gradient by reverse mode; else by forward mode, for a solver without reverse.

    Adam has no criterion to stop by: the estimate says `converged=False`. Raises `RuntimeError`
    when the loss of the first epoch is not finite.
    """
    began = time.perf_counter()
    problems = (problems,) if isinstance(problems, Problem) else problems
    space = problems[0].space
    place = jnp.full(space.dim, 0.5, float) if start is None else jnp.clip(start, EDGE, 1 - EDGE)
    raw: Any = jnp.log(place) - jnp.log1p(-place)  # optax gives back what it is given
    optimiser = optax.adam(rate)
    state = optimiser.init(raw)
    losses, places = [], []
    for epoch in range(epochs):
        value, slope = _evaluate(problems, raw, loss, reverse)
        losses.append(float(value))
        places.append(jax.nn.sigmoid(raw))
        if not (np.isfinite(losses[-1]) and np.all(np.isfinite(np.asarray(slope)))):
            break
        update, state = optimiser.update(slope, state)
        raw = optax.apply_updates(raw, update)
        if progress is not None:
            progress(epoch, min(losses))
    history = np.stack([np.asarray(space.values(place)) for place in places])
    if not np.isfinite(losses[0]):
        nothing = jnp.zeros(theta_length(problems[:1]) - space.dim, float)
        why = explain(problems[0], jnp.concatenate([places[0], nothing]))
        why = why or "has a loss that is not finite"
        raise RuntimeError(f"{approach}: the simulation of the start, {history[0]}, {why}")
    best = int(np.argmin(np.where(np.isfinite(losses), losses, np.inf)))
    return point_estimate(
        approach,
        space,
        places[best],
        losses[best],
        np.array(losses)[:, None],
        history[:, None],
        time.perf_counter() - began,
    )


@eqx.filter_jit
def _evaluate(problems: Problems, raw, loss: Loss | None, reverse: bool):
    """The loss and its gradient in the raw place."""
    nuisances = jnp.zeros(theta_length(problems) - raw.shape[0], raw.dtype)

    def value(raw):
        found = loss_at(problems, jnp.concatenate([jax.nn.sigmoid(raw), nuisances]), loss)
        return found, found

    slope, found = (jax.grad if reverse else jax.jacfwd)(value, has_aux=True)(raw)
    return found, slope
