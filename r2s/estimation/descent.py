"""From anywhere in the range to the best fabric: a coarse search, then Gauss-Newton descents."""

import dataclasses
import itertools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation import gauss_newton, standard_errors
from r2s.estimation.checkpoint import fingerprint, load, save
from r2s.estimation.estimate import Estimate, Nuisance
from r2s.estimation.gauss_newton import Descent, Joint, Normal, part_of
from r2s.estimation.prediction import fabric_at
from r2s.estimation.problem import OWN, SHARED, UNITS, Problem, beginning

Progress = Callable[[int, float], None]  # told the iteration and the best loss [m^2]

FIRST_DAMPING = 1e-2
CLOSE = 5e-3  # of the prior's weight, which is what a change by one deviation costs, about twice
STRICT, SCALES = 3.0, (3e-3, 0.015)  # of the spread, and between [m]: what is off is an outlier
PATIENCE = 6  # iterations without a gain
HALVING, FEWEST = 3, 3  # iterations, after each of which half go on, but no fewer than this
ROUGH = 3.0  # deviations, by which places around an end lead apart

Row = list[Descent]  # of every start

# compiled once in a process for all recordings of as many frames, knots and points
_loss = eqx.filter_jit(gauss_newton.loss_at)
_normal = eqx.filter_jit(gauss_newton.normal_at)
_losses = eqx.filter_jit(eqx.filter_vmap(gauss_newton.loss_at, in_axes=(None, 0)))
_normals = eqx.filter_jit(eqx.filter_vmap(gauss_newton.normal_at, in_axes=(None, 0, 0, None)))
_propose = eqx.filter_jit(gauss_newton.propose)
_accept = eqx.filter_jit(gauss_newton.accept)
_objective = eqx.filter_jit(gauss_newton.objective)
_remaining = eqx.filter_jit(gauss_newton.remaining)
_weight = eqx.filter_jit(gauss_newton.prior_weight)
_covariance = eqx.filter_jit(standard_errors.covariance)
_apart = eqx.filter_jit(standard_errors.apart)
_around = eqx.filter_jit(standard_errors.around)


class Budget(NamedTuple):
    """How much a descent may cost.

    - `coarse`: places of the range that are tried first; 0: descend from the start alone.
    - `starts`: how many of the best of them are descended from, side by side; of more than three
      the better half go on every three iterations, until three are left.
    - `iterations`: at most, of each stage: of all starts, until each has arrived, when its next
      step promises to change no parameter by more than about a tenth of its deviation; and then of
      the best one with outliers left out.
    - `width`: over which slopes are taken, as of `r2s.estimation.prediction.sensitivities`.
    - `shares`: of the frames, from the first, that count before all of them do: all starts descend
      on the first share, and then the best one, outliers left out, on each and on all frames. The
      end of a long motion can depend on the fabric so steeply that a loss over all of it is low
      nowhere but near the truth; that of its beginning leads there.
    - `around`: places, an even number, that are looked at around the end: by how far they would
      lead away from it the deviations are larger, see `spread_of`.
    """

    coarse: int = 24
    starts: int = 3
    iterations: int = 25
    width: float | None = None
    shares: tuple[float, ...] = ()
    around: int = 8


DEFAULT = Budget(shares=(0.25, 0.5))


def descend(
    problems: Problem | Joint,
    budget: Budget = DEFAULT,
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
    bad; when all do, raises `RuntimeError`. Raises `ValueError` for no starts, for
    places around the end that are no pairs, and for shares that do not rise between 0 and 1.
    """
    if budget.starts < 1:
        raise ValueError(f"an estimate needs a start or more, got {budget.starts}")
    if any(not low < high for low, high in itertools.pairwise((0.0, *budget.shares, 1.0))):
        raise ValueError(f"shares of the frames must rise between 0 and 1, got {budget.shares}")
    if budget.around < 0 or budget.around % 2:
        raise ValueError(f"places around the end are in pairs: an even number, got {budget.around}")
    began = time.perf_counter()
    problems = (problems,) if isinstance(problems, Problem) else problems
    identity = "" if checkpoint is None else fingerprint(problems, budget, start, key)
    rows = [] if checkpoint is None else _resumed(checkpoint, identity, budget)
    if not rows:
        rows = [_begin(problems, budget, start, key)]
    while (row := _next(problems, budget, rows)) is not None:
        rows.append(row)
        if checkpoint is not None:
            save(checkpoint, identity, [_stacked(row) for row in rows])
        if progress is not None:
            progress(len(rows) - 2, float(_best(row)[1].normal.loss))
    _, best = _best(rows[-1])
    spread = spread_of(problems, budget, best, jax.random.fold_in(key, 1))
    return collect(problems, rows, spread, approach, time.perf_counter() - began)


def _begin(problems: Joint, budget: Budget, start, key) -> Row:
    dim, count = problems[0].space.dim, max(budget.coarse, budget.starts)
    start = jnp.full(dim, 0.5, float) if start is None else start
    places = jax.random.uniform(key, (count, dim), float).at[0].set(start)
    nothing = jnp.zeros((count, gauss_newton.size(problems) - dim), float)
    unknowns = jnp.concatenate([places, nothing], axis=1)
    if budget.coarse:
        losses = losses_of(_seen(problems, budget, 0), unknowns)
        if not np.any(np.isfinite(losses)):
            raise RuntimeError(
                f"all {count} simulations of the coarse search diverged: check the recording's "
                "units and gripper path, or narrow the space's ranges"
            )
        unknowns = unknowns[np.argsort(losses)]
    return _fresh(problems, budget, list(unknowns[: budget.starts]), 0.0, 0)


def losses_of(problems: Joint, unknowns: Float[Array, "start unknown"]) -> np.ndarray:
    """The losses [m^2] of many unknowns: together, or on a CPU, which gains nothing by that, one
    by one."""
    if jax.default_backend() != "cpu":
        return np.asarray(_losses(problems, unknowns))
    return np.array([float(_loss(problems, unknown)) for unknown in unknowns])


def _normals_of(problems: Joint, unknowns: list, scales: list, width: float | None) -> list[Normal]:
    """As `losses_of`; together in numbers that are powers of two, so that few are compiled."""
    if jax.default_backend() == "cpu" or len(unknowns) == 1:
        pairs = zip(unknowns, scales, strict=True)
        return [_normal(problems, unknown, scale, width) for unknown, scale in pairs]
    more = 2 ** math.ceil(math.log2(len(unknowns))) - len(unknowns)
    fill = lambda parts: jnp.stack([*parts, *[parts[-1]] * more])
    found = _normals(problems, fill(unknowns), fill(scales), width)
    return [jax.tree.map(lambda leaf, i=i: leaf[i], found) for i in range(len(unknowns))]


def _share(budget: Budget, stage: int) -> float:
    """Of the frames that count in a stage."""
    shares = (*budget.shares, 1.0)
    return (shares[0], *shares)[stage]


def _seen(problems: Joint, budget: Budget, stage: int) -> Joint:
    """The problems with those frames seen that count in a stage."""
    share = _share(budget, stage)
    return problems if share == 1 else tuple(beginning(p, share) for p in problems)


def _fresh(problems: Joint, budget: Budget, unknowns: list, scale: float, stage: int) -> Row:
    """Descents that begin at unknowns."""
    value = lambda number: jnp.asarray(number, float)
    seen, scales = _seen(problems, budget, stage), [value(scale)] * len(unknowns)
    normals = _normals_of(seen, unknowns, scales, budget.width)
    rest = value(FIRST_DAMPING), value(gauss_newton.GROWTH), value(scale), jnp.asarray(stage)
    return [Descent(u, normal, *rest) for u, normal in zip(unknowns, normals, strict=True)]


def _next(problems: Joint, budget: Budget, rows: list[Row]) -> Row | None:
    """The next iteration; None at the end."""
    row = rows[-1]
    _, best = _best(row)
    now = int(best.stage)
    stage = [r for r in rows if int(_best(r)[1].stage) == now]
    prior = _weight(problems, best.normal)
    moving = [i for i in _kept(row, len(stage)) if not _arrived(problems, stage, i, prior)]
    if not moving or len(stage) > budget.iterations:
        return _later(problems, budget, row)
    seen = _seen(problems, budget, now)
    trials = [_propose(problems, row[i], prior) for i in moving]
    tried = _normals_of(seen, trials, [row[i].scale for i in moving], budget.width)
    after = list(row)
    for i, trial, normal in zip(moving, trials, tried, strict=True):
        after[i] = _accept(problems, row[i], trial, normal, prior)
    return after


def _kept(row: Row, iteration: int) -> list[int]:
    """Which of the descents in the latest stage go on: of many, the best half every few iterations.

    (Successive halving, Jamieson and Talwalkar 2016.)
    """
    now = max(int(descent.stage) for descent in row)
    there = [i for i, descent in enumerate(row) if int(descent.stage) == now]
    count = max(FEWEST, len(there) >> (iteration - 1) // HALVING)
    loss = lambda i: np.nan_to_num(float(row[i].normal.loss), nan=np.inf)
    return sorted(sorted(there, key=loss)[:count])


def _later(problems: Joint, budget: Budget, row: Row) -> Row | None:
    """The next stage, to which only the best descent goes on; None after the last.

    From the second on outliers are left out, by what is unexplained: they lie to one side of a
    sheet, so that even a small pull of theirs biases the estimate.
    """
    which, best = _best(row)
    stage = int(best.stage) + 1
    if stage > len(budget.shares) + 1:
        return None
    loose = best
    if _share(budget, stage) != _share(budget, stage - 1):
        (loose,) = _fresh(problems, budget, [best.unknown], 0.0, stage)
    scale = float(np.clip(STRICT * float(loose.normal.spread), *SCALES))
    after = list(row)
    (after[which],) = _fresh(problems, budget, [best.unknown], scale, stage)
    return after


def spread_of(
    problems: Joint, budget: Budget, end: Descent, key: PRNGKeyArray, true: bool = False
) -> Float[np.ndarray, "unknown unknown"]:
    """The covariance of the unknown at the end of a descent, see `r2s.estimation.standard_errors`.

    From as many of the frames as agree. If the places around it lead apart, the end of the motion
    depends on the fabric so steeply that its derivatives say nothing, and the effort's shares of
    the frames are asked, the largest first. If these do not agree either, it is that of all frames.
    """
    found = []
    for share in (1.0, *reversed(budget.shares)):
        seen, here = problems, end
        if share < 1:
            seen = tuple(beginning(problem, share) for problem in problems)
            normal = _normal(seen, end.unknown, end.scale, budget.width)
            here = dataclasses.replace(end, normal=normal)
        prior = _weight(problems, here.normal)
        near = _look_around(seen, budget, here, prior, key)
        found.append(np.asarray(_covariance(problems, here, prior, near, true)))
        if not near or float(_apart(problems, here, prior, near)) < ROUGH:
            return found[-1]
    return found[0]


def _look_around(problems: Joint, budget: Budget, end: Descent, prior, key) -> standard_errors.Near:
    """The normal equations at places around the end of a descent."""
    if not budget.around:
        return []
    places = list(_around(problems, end, prior, budget.around, key))
    normals = _normals_of(problems, places, [end.scale] * len(places), budget.width)
    return list(zip(places, normals, strict=True))


def _best(row: Row) -> tuple[int, Descent]:
    """Of the descents in the latest stage, that of the least loss."""
    last = max(int(descent.stage) for descent in row)
    losses = [float(d.normal.loss) if int(d.stage) == last else np.inf for d in row]
    which = int(np.argmin(losses))
    return which, row[which]


def _arrived(problems: Joint, stage: list[Row], start: int, prior) -> bool:
    """Whether a start's next step promises nothing, or its last ones have brought nothing."""
    now = stage[-1][start]
    if not np.isfinite(float(now.normal.loss)):
        return True
    least = CLOSE * float(prior)
    if len(stage) > 1 and float(_remaining(problems, now, prior)) < least:
        return True
    if len(stage) <= PATIENCE:
        return False
    values = [
        float(_objective(problems, d.unknown, d.normal.loss, prior))
        for d in (stage[-1 - PATIENCE][start], now)
    ]
    return not values[1] < values[0] - least


def _stacked(row: Row) -> Descent:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *row)


def _resumed(checkpoint: Path, identity: str, budget: Budget) -> list[Row]:
    none, vector, square = (jnp.zeros((0,) * dims) for dims in (1, 2, 3))
    normal = Normal(none, none, vector, square, square)
    like = Descent(vector, normal, none, none, none, jnp.zeros(0, int))
    each = lambda row: [jax.tree.map(lambda a, i=i: a[i], row) for i in range(budget.starts)]
    return [each(row) for row in load(checkpoint, identity, like)]


def collect(
    problems: Joint,
    rows: list[Row],
    spread: Float[np.ndarray, "unknown unknown"],
    approach: str,
    seconds: float,
) -> Estimate:
    """The estimate of the best descent of the last of some iterations, of a covariance."""
    space = problems[0].space
    _, best = _best(rows[-1])
    unknown = best.unknown
    covariance = spread[: space.dim, : space.dim]
    deviation = np.sqrt(np.diag(covariance))
    # a place moves a parameter by its range: by that much, or by that ratio's logarithm
    widths = [np.log(b.high / b.low) if b.log else b.high - b.low for b in space.ranges]
    values_of = jax.vmap(jax.vmap(space.values))
    places = jnp.stack([_stacked(row).unknown[:, : space.dim] for row in rows])
    return Estimate(
        approach=approach,
        fabric=fabric_at(problems[0], unknown[part_of(problems, 0)]),
        ranges=space.ranges,
        values=np.asarray(space.values(unknown[: space.dim])),
        standard_errors=deviation * np.array(widths),
        correlation=covariance / np.outer(deviation, deviation),
        nuisances=nuisances(problems, np.asarray(unknown), np.sqrt(np.diag(spread))),
        loss=float(_loss(problems, unknown)),
        losses=np.stack([np.asarray(_stacked(row).normal.loss) for row in rows]),
        history=np.asarray(values_of(places)),
        seconds=seconds,
    )


def nuisances(problems: Joint, unknown: np.ndarray, deviation: np.ndarray) -> tuple[Nuisance, ...]:
    """What an unknown says of the recordings, where they were in doubt."""
    found, told = [], set()
    for which, problem in enumerate(problems):
        number = f" {which + 1}" if len(problems) > 1 else ""
        places = part_of(problems, which)[problem.space.dim :]
        rows = zip((*SHARED, *OWN), problem.nuisance_prior.scales, places, strict=True)
        for name, scale, place in rows:
            if not scale or place in told:
                continue
            told.add(place)
            value, spread = scale * float(unknown[place]), scale * float(deviation[place])
            if name in SHARED:  # the logarithm of a ratio
                value, spread = float(np.exp(value)), float(np.exp(value)) * spread
            label = f"{name} ratio" if name in SHARED else name + number
            found.append(Nuisance(label, UNITS.get(name, "-"), value, spread))
    return tuple(found)
