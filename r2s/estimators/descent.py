"""From anywhere in the range to the best fabric: a coarse search, then Gauss-Newton descents."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimators import gauss_newton
from r2s.estimators.checkpoint import fingerprint, load, save
from r2s.estimators.estimate import Condition, Estimate
from r2s.estimators.gauss_newton import Descent, Joint, Normal, part_of
from r2s.estimators.problem import OWN, SHARED, UNITS, Problem

FIRST_DAMPING = 1e-2
CLOSE = 5e-3  # of the prior's weight, which is what a change by one deviation costs, about twice
STRICT, SCALES = 3.0, (3e-3, 0.015)  # of the spread, and between [m]: what is off is an outlier
SHORTEST, PATIENCE = 4, 8  # iterations

Progress = Callable[[int, float], None]  # told the iteration and the best loss [m^2]

# compiled once in a process for all recordings of as many frames, knots and points
_losses = eqx.filter_jit(eqx.filter_vmap(gauss_newton.loss_at, in_axes=(None, 0)))
_normals = eqx.filter_jit(eqx.filter_vmap(gauss_newton.normal_at, in_axes=(None, 0, 0, None)))
_propose = eqx.filter_jit(eqx.filter_vmap(gauss_newton.propose, in_axes=(None, 0, None)))
_accept = eqx.filter_jit(eqx.filter_vmap(gauss_newton.accept, in_axes=(None, 0, 0, 0, None)))
_remaining = eqx.filter_jit(eqx.filter_vmap(gauss_newton.remaining, in_axes=(None, 0, None)))
_objectives = eqx.filter_jit(eqx.filter_vmap(gauss_newton.objective, in_axes=(None, 0, 0, None)))


class Effort(NamedTuple):
    """How much a descent may cost.

    - `coarse`: places of the range that are tried first; 0: descend from the start alone.
    - `starts`: how many of the best of them are descended from, side by side.
    - `iterations`: at most. The descents end when the best has arrived: when its next step promises
      to change no parameter by more than about a tenth of its deviation.
    - `width`: over which slopes are taken, as of `r2s.estimators.prediction.sensitivities`.
    """

    coarse: int = 24
    starts: int = 2
    iterations: int = 40
    width: float | None = None


DEFAULT = Effort()


def descend(
    problems: Problem | Joint,
    effort: Effort = DEFAULT,
    *,
    approach: str,
    start: Float[Array, " dim"] | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The fabric that explains one recording, or several of one fabric.

    `start`, by default the middle of the range, is among the coarse places; the others are drawn
    with `key`. What is there after every iteration is written to `checkpoint`, and a run with the
    same problem that finds it goes on from there. A simulation that diverges counts as infinitely
    bad; when all do, raises `RuntimeError`.
    """
    began = time.perf_counter()
    problems = (problems,) if isinstance(problems, Problem) else problems
    identity = "" if checkpoint is None else fingerprint(problems, effort, start, key)
    rows = [] if checkpoint is None else _resumed(checkpoint, identity)
    if not rows:
        rows = [_begin(problems, effort, start, key)]
    strict = bool(np.any(np.asarray(rows[-1].scale) > 0))
    last = sum(not np.any(np.asarray(row.scale) > 0) for row in rows) if strict else 0
    for iteration in range(len(rows) - 1, effort.iterations):
        descent = rows[-1]
        prior = _prior(problems, descent)
        if _arrived(problems, rows[last:], prior):
            if strict:
                break
            last, strict = len(rows), True
            rows.append(_strict(problems, effort, descent))
            continue
        trial = _propose(problems, descent, prior)
        tried = _normals(problems, trial, descent.scale, effort.width)
        rows.append(_accept(problems, descent, trial, tried, prior))
        if checkpoint is not None:
            save(checkpoint, identity, rows)
        if progress is not None:
            progress(iteration, float(jnp.min(rows[-1].normal.loss)))
    return _collect(problems, rows, approach, time.perf_counter() - began)


def _resumed(checkpoint: Path, identity: str) -> list[Descent]:
    nothing = jnp.zeros(0)
    like = Descent(nothing, Normal(*[nothing] * 5), nothing, nothing, nothing)
    return load(checkpoint, identity, like)


def _begin(problems: Joint, effort: Effort, start, key) -> Descent:
    dim, count = problems[0].family.dim, max(effort.coarse, effort.starts)
    start = jnp.full(dim, 0.5, float) if start is None else start
    places = jax.random.uniform(key, (count, dim), float).at[0].set(start)
    nothing = jnp.zeros((count, gauss_newton.size(problems) - dim), float)
    unknowns = jnp.concatenate([places, nothing], axis=1)
    if effort.coarse:
        losses = np.asarray(_losses(problems, unknowns))
        if not np.any(np.isfinite(losses)):
            raise RuntimeError(
                f"all {count} simulations of the coarse search diverged: check the recording's "
                "units and gripper path, or narrow the family's ranges"
            )
        unknowns = unknowns[jnp.asarray(np.argsort(losses))]
    chosen = unknowns[: effort.starts]
    return _fresh(problems, effort, chosen, 0.0)


def _fresh(problems: Joint, effort: Effort, unknown, scale: float) -> Descent:
    """Descents that begin at unknowns."""
    fill = lambda value: jnp.full(effort.starts, value, float)
    normal = _normals(problems, unknown, fill(scale), effort.width)
    return Descent(unknown, normal, fill(FIRST_DAMPING), fill(gauss_newton.GROWTH), fill(scale))


def _strict(problems: Joint, effort: Effort, descent: Descent) -> Descent:
    """The descents go on with outliers left out, from what the best of them leaves unexplained.

    Outliers lie to one side of a sheet, so that even a small pull of theirs biases the estimate.
    """
    best = int(np.argmin(np.asarray(descent.normal.loss)))
    scale = float(np.clip(STRICT * float(descent.normal.spread[best]), *SCALES))
    return _fresh(problems, effort, descent.unknown, scale)


def _prior(problems: Joint, descent: Descent) -> Float[Array, ""]:
    """The weight of the prior, at the start of the least loss."""
    best = jnp.argmin(descent.normal.loss)
    return gauss_newton.prior_weight(problems, jax.tree.map(lambda a: a[best], descent.normal))


def _arrived(problems: Joint, rows: list[Descent], prior) -> bool:
    """Whether the best descent is at its end, or none gained in the last `PATIENCE` iterations."""
    now = rows[-1]
    value = np.asarray(_objectives(problems, now.unknown, now.normal.loss, prior))
    promised = np.asarray(_remaining(problems, now, prior))
    if len(rows) > SHORTEST and promised[np.argmin(value)] < CLOSE * float(prior):
        return True
    if len(rows) <= PATIENCE:
        return False
    before = rows[-1 - PATIENCE]
    earlier = np.asarray(_objectives(problems, before.unknown, before.normal.loss, prior))
    return not np.any(value < earlier - CLOSE * float(prior))


def _collect(problems: Joint, rows: list[Descent], approach: str, seconds: float) -> Estimate:
    family, last = problems[0].family, rows[-1]
    prior = _prior(problems, last)
    winner = int(np.argmin(_objectives(problems, last.unknown, last.normal.loss, prior)))
    best = jax.tree.map(lambda leaf: leaf[winner], last)
    unknown = best.unknown
    whole = np.asarray(gauss_newton.covariance(problems, best, prior))
    covariance = whole[: family.dim, : family.dim]
    deviation = np.sqrt(np.diag(covariance))
    # a place moves a parameter by its range: by that much, or by that ratio's logarithm
    widths = [np.log(b.high / b.low) if b.log else b.high - b.low for b in family.ranges]
    values_of = jax.vmap(jax.vmap(family.values))
    return Estimate(
        approach=approach,
        fabric=family(unknown[: family.dim]),
        ranges=family.ranges,
        values=np.asarray(family.values(unknown[: family.dim])),
        deviations=deviation * np.array(widths),
        correlation=covariance / np.outer(deviation, deviation),
        conditions=conditions(problems, np.asarray(unknown), np.sqrt(np.diag(whole))),
        loss=float(last.normal.loss[winner]),
        losses=np.stack([np.asarray(row.normal.loss) for row in rows]),
        history=np.asarray(values_of(jnp.stack([row.unknown for row in rows])[..., : family.dim])),
        seconds=seconds,
    )


def conditions(
    problems: Joint, unknown: np.ndarray, deviation: np.ndarray
) -> tuple[Condition, ...]:
    """What an unknown says of the recordings, where they were in doubt."""
    found = []
    for which, problem in enumerate(problems):
        number = f" {which + 1}" if len(problems) > 1 else ""
        places = part_of(problems, which)[problem.family.dim :]
        rows = zip((*SHARED, *OWN), problem.doubt.scales, places, strict=True)
        for name, scale, place in rows:
            if not scale or (name in SHARED and which):
                continue
            value, spread = scale * float(unknown[place]), scale * float(deviation[place])
            if name in SHARED:  # the logarithm of a ratio
                value, spread = float(np.exp(value)), float(np.exp(value)) * spread
            label = f"{name} ratio" if name in SHARED else name + number
            found.append(Condition(label, UNITS.get(name, "-"), value, spread))
    return tuple(found)
