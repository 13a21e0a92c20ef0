"""DIFFCLOUD: a fabric from point clouds, by differentiating through simulator and surface.

After Sundaresan, Antonova and Bohg 2022 ("DiffCloud: Real-to-Sim from Point Clouds with
Differentiable Simulation and Rendering of Deformable Objects"). `estimate` is r2s's default;
`original` follows their recipe.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimators import gauss_newton
from r2s.estimators.base import Estimate, Problem
from r2s.estimators.gauss_newton import Descent
from r2s.fabric import Fabric
from r2s.family import Range
from r2s.losses import one_sided_chamfer
from r2s.scenario import motion
from r2s.surface import sample

Progress = Callable[[int, float], None]  # told the iteration and the best loss [m^2]

# compiled once in a process for all recordings of as many frames, knots and points
_losses = eqx.filter_jit(eqx.filter_vmap(gauss_newton.loss_at, in_axes=(None, 0)))
_normals = eqx.filter_jit(eqx.filter_vmap(gauss_newton.normal_at, in_axes=(None, 0)))
_propose = eqx.filter_jit(eqx.filter_vmap(gauss_newton.propose, in_axes=(None, 0, None)))
_accept = eqx.filter_jit(eqx.filter_vmap(gauss_newton.accept, in_axes=(None, 0, 0, 0, None)))
_objectives = eqx.filter_jit(eqx.filter_vmap(gauss_newton.objective, in_axes=(None, 0, 0, None)))


def estimate(
    problem: Problem,
    *,
    num_coarse: int = 24,
    num_starts: int = 2,
    num_iterations: int = 12,
    patience: int = 3,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """Coarse search over the whole range, then Gauss-Newton from its best places, all by `vmap`.

    The middle of the range is among the `num_coarse` places; the others are drawn from it with
    `key`. Ends after `num_iterations`, or `patience` of them in which no descent gained 0.1 %. A
    simulation that diverges counts as infinitely bad; when all do, raises `RuntimeError`.
    """
    began = time.perf_counter()
    places = jax.random.uniform(key, (num_coarse, problem.family.dim)).at[0].set(0.5)
    unknowns = jnp.concatenate([places, jnp.zeros((num_coarse, 4), float)], axis=1)
    losses = np.asarray(_losses(problem, unknowns))
    if not np.any(np.isfinite(losses)):
        raise RuntimeError(
            f"all {num_coarse} simulations of the coarse search diverged: check the recording's "
            "units and gripper path, or narrow the family's ranges"
        )
    best = jnp.asarray(np.argsort(losses)[:num_starts])
    descent = Descent(
        unknowns[best], _normals(problem, unknowns[best]), jnp.full(num_starts, 1e-2, float)
    )
    rows = [descent]
    for iteration in range(num_iterations):
        prior = gauss_newton.prior_weight(problem, jnp.min(descent.normal.spread))
        trial = _propose(problem, descent, prior)
        descent = _accept(problem, descent, trial, _normals(problem, trial), prior)
        rows.append(descent)
        if _stalled(rows, patience):
            break
        if progress is not None:
            progress(iteration, float(jnp.min(descent.normal.loss)))
    return _collect(problem, rows, time.perf_counter() - began)


def _stalled(rows: list[Descent], patience: int) -> bool:
    if len(rows) <= patience:
        return False
    before, now = (np.asarray(row.normal.loss) for row in (rows[-1 - patience], rows[-1]))
    return not np.any(now < 0.999 * before)


def _collect(problem: Problem, rows: list[Descent], seconds: float) -> Estimate:
    family, last = problem.family, rows[-1]
    prior = gauss_newton.prior_weight(problem, jnp.min(last.normal.spread))
    winner = int(np.argmin(_objectives(problem, last.unknown, last.normal.loss, prior)))
    best = jax.tree.map(lambda leaf: leaf[winner], last)
    unknown = best.unknown
    place = unknown[: family.dim]
    covariance = np.asarray(gauss_newton.covariance(problem, best, prior))
    covariance = covariance[: family.dim, : family.dim]
    deviation = np.sqrt(np.diag(covariance))
    # a place moves a parameter by its range: by that much, or by that ratio's logarithm
    widths = [np.log(b.high / b.low) if b.log else b.high - b.low for b in family.ranges]
    values_of = jax.vmap(jax.vmap(family.values))
    scale = np.repeat(problem.misalignment, (3, 1))
    return Estimate(
        approach="diffcloud",
        fabric=family(place),
        ranges=family.ranges,
        values=np.asarray(family.values(place)),
        deviations=deviation * np.array(widths),
        correlation=covariance / np.outer(deviation, deviation),
        misalignment=np.asarray(unknown[family.dim :]) * scale,
        loss=float(last.normal.loss[winner]),
        losses=np.stack([np.asarray(row.normal.loss) for row in rows]),
        history=np.asarray(values_of(jnp.stack([row.unknown for row in rows])[..., : family.dim])),
        seconds=seconds,
    )


STRETCH = Range("stretch multiplier", "-", 0.05, 10.0)
MASS = Range("mass multiplier", "-", 0.1, 10.0)
RECIPE = "Adam 0.2, 51 epochs, 3,500 samples, last frame"


def original(
    problem: Problem,
    assumed: Fabric,
    *,
    num_epochs: int = 51,
    learning_rate: float = 0.2,
    resolution: int = 5,
    progress: Progress | None = None,
) -> Estimate:
    """The recipe of the DIFFCLOUD paper: two multipliers of an assumed fabric, by Adam.

    One multiplies all membrane stiffness (0.05 to 10), one the mass (0.1 to 10; theirs of 20
    listed vertices, ours of all), through a sigmoid from the middle of the range. The loss is the
    mean squared distance from samples of the simulated surface (`resolution`^2 a face: 3,200 of
    theirs 3,500 on 128 faces) to the cloud of the last frame. Gives no deviations.
    """
    began = time.perf_counter()
    optimiser = optax.adam(learning_rate)
    evaluate = eqx.filter_jit(
        eqx.filter_value_and_grad(
            lambda raw, problem, assumed: _original_loss(raw, problem, assumed, resolution)
        )
    )
    raw: Any = jnp.zeros(2, float)  # optax gives back what it is given
    state = optimiser.init(raw)
    losses, history = [], []
    for epoch in range(num_epochs):
        loss, slope = evaluate(raw, problem, assumed)
        losses.append(float(loss))
        history.append(np.asarray(_multipliers(raw)))
        if not np.isfinite(losses[-1]):
            break
        update, state = optimiser.update(slope, state)
        raw = optax.apply_updates(raw, update)
        if progress is not None:
            progress(epoch, min(losses))
    best = int(np.nanargmin(losses))
    values = history[best]
    unknown = np.full(2, np.nan)
    return Estimate(
        approach=f"diffcloud_original ({RECIPE})",
        fabric=_scaled(assumed, jnp.asarray(values, float)),
        ranges=(STRETCH, MASS),
        values=values,
        deviations=unknown,
        correlation=np.full((2, 2), np.nan),
        misalignment=np.zeros(4),
        loss=losses[best],
        losses=np.array(losses)[:, None],
        history=np.stack(history)[:, None],
        seconds=time.perf_counter() - began,
    )


def _multipliers(raw: Float[Array, " 2"]) -> Float[Array, " 2"]:
    low, high = jnp.array([STRETCH.low, MASS.low]), jnp.array([STRETCH.high, MASS.high])
    return low + (high - low) * jax.nn.sigmoid(raw)


def _scaled(fabric: Fabric, multipliers: Float[Array, " 2"]) -> Fabric:
    stretch, mass = multipliers
    law = jax.tree.map(lambda c: c * stretch, fabric.membrane)
    return dataclasses.replace(fabric, density=fabric.density * mass, membrane=law)


def _original_loss(raw, problem, assumed, resolution) -> Float[Array, ""]:
    moved = motion(problem.scenario, _scaled(assumed, _multipliers(raw)))
    seen = sample(moved.x[problem.frames[-1]], problem.scenario.scene.mesh.faces, resolution)
    targets = jnp.where(problem.mask[-1][:, None], problem.points[-1], jnp.inf)
    # padding is infinitely far, so never the nearest
    return one_sided_chamfer(seen, jnp.ones(seen.shape[0], bool), targets)
