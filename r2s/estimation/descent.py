"""From anywhere in the range to the best fabric: a coarse search, then Gauss-Newton descents."""

import itertools
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.compilation import clear_in_time
from r2s.estimation import checkpoint as checkpoints
from r2s.estimation.gauss_newton import (
    MARGIN,
    Descent,
    Normal,
    accept,
    losses_at,
    normals_at,
    objective,
    prior_weight,
    propose,
    remaining,
)
from r2s.estimation.least_squares import Damping
from r2s.estimation.method import Budget, Progress, tell
from r2s.estimation.prediction import (
    Derive,
    Theta,
    explain,
    fabric_at,
    remembering,
    theta_indices,
    theta_length,
)
from r2s.estimation.problem import Problems, beginning, check_shared
from r2s.materials.fabric import Fabric

# an outlier lies beyond so many spreads, within these limits [m]. At half of it a part of the sheet
# that the start cannot follow counts for nothing, and never attracts the sheet.
STRICT, SCALES = 6.0, (6e-3, 0.015)
HALVING, FEWEST = 3, 3  # iterations, after each of which half go on, but no fewer than this


class Stop(NamedTuple):
    """When a descent ends.

    - `close`: when its next step promises to gain less, over the prior's weight, which is about
      twice the cost of a change by one standard error.
    - `patience`, `gain`: when so many steps gained less than that, or than this share of the loss.
    - `stuck`: at this damping: not even so short a step gains anything.
    """

    close: float
    patience: int
    gain: float
    stuck: float


# At a tenth of a standard error; or, where another descent goes on from there, at a quarter (a half
# is too early: outliers that are left out from there on may hold it there); or, where more frames
# follow, roughly.
AT_THE_END, ON_THE_WAY = Stop(5e-3, 4, 5e-4, 10.0), Stop(0.03, 2, 3e-3, 10.0)
MORE_FRAMES = Stop(0.03, 2, 0.02, 1.0)
Iteration = list[Descent]  # one iteration: the descents of all starts
DEFAULT = Budget(frame_fractions=(0.25, 0.5))


class Search(NamedTuple):
    """A finished search.

    - `rows`: all descents in every iteration. `seconds`: how long it took.
    - `derive`: with a cache of its latest places.
    - `reached`, `unsure`: see `r2s.estimation.estimate.Estimate`. `others`: other ends that fit
      nearly as well.
    """

    problems: Problems
    rows: list[Iteration]
    seconds: float
    derive: Derive
    reached: tuple[int, int] | None = None
    unsure: str = ""
    others: tuple[Theta, ...] = ()

    @property
    def best(self) -> Descent:
        """The best descent, at its end."""
        return self.rows[-1][self.which]

    @property
    def which(self) -> int:
        """Its index among the starts."""
        return _best(self.rows[-1])[0]

    @property
    def theta(self) -> Theta:
        """Its end."""
        return self.best.theta

    @property
    def fabric(self) -> Fabric:
        """The fabric at its end."""
        return fabric_at(self.problems[0], self.theta[theta_indices(self.problems, 0)])


def multi_start(
    problems: Problems,
    budget: Budget,
    *,
    start: Float[Array, " start"] | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    derive: Derive | None = None,
    words: str = "descents",
    key: PRNGKeyArray,
) -> Search:
    """The descents of `r2s.estimation.judgement.descend`; a `start` may be a whole theta.

    `derive`: of an earlier search in the same recordings. `words`: for the progress.
    """
    if budget.num_starts < 1:
        raise ValueError(f"an estimate needs a start or more, got {budget.num_starts}")
    fractions, probes = budget.frame_fractions, budget.num_probes
    if any(not low < high for low, high in itertools.pairwise((0.0, *fractions, 1.0))):
        raise ValueError(f"frame_fractions must rise between 0 and 1, got {fractions}")
    if probes < 0 or probes % 2:
        raise ValueError(f"num_probes: places around the end are in pairs, got {probes}")
    check_shared(problems)
    clear_in_time()
    began, derive = time.perf_counter(), derive or remembering()
    run = _run_of(problems, budget, start, key) if checkpoint else {}
    rows = _resumed(checkpoint, run, budget) if checkpoint else []
    if not rows:
        rows = [_begin(problems, budget, start, derive, progress, key)]
    tell(progress, words)
    while (row := _next(problems, budget, rows, derive)) is not None:
        rows.append(row)
        if checkpoint is not None:
            checkpoints.save(checkpoint, checkpoints.arrays_of(stacked(rows)), run)
        if progress is not None:
            progress(len(rows) - 2, float(_best(row)[1].normal.loss))
    return Search(problems, rows, time.perf_counter() - began, derive)


def _begin(problems: Problems, budget: Budget, start, derive: Derive, progress, key) -> Iteration:
    dim, count = problems[0].space.dim, max(budget.num_samples, budget.num_starts)
    if start is None:
        start = jnp.clip(problems[0].space.prior()[0], MARGIN, 1 - MARGIN)
    places = jax.random.uniform(key, (count, dim), float)
    nothing = jnp.zeros((count, theta_length(problems) - dim), float)
    thetas = jnp.concatenate([places, nothing], axis=1).at[0, : len(start)].set(start)
    if budget.num_samples:
        losses = losses_at(_seen(problems, budget, 0), thetas, progress)
        if not np.any(np.isfinite(losses)):
            raise _diverged(f"all {count} simulations of the coarse search", problems, thetas[0])
        thetas = thetas[np.argsort(losses)]
    tell(progress, "compiling the derivatives")
    row = _fresh(problems, budget, list(thetas[: budget.num_starts]), 0.0, 0, derive)
    if not any(_is_finite(each) for each in row):
        raise _diverged("all starts of the descents", problems, thetas[0])
    return row


def _is_finite(descent: Descent) -> bool:
    return bool(np.isfinite(float(descent.normal.loss)))


def _diverged(what: str, problems: Problems, theta: Theta) -> RuntimeError:
    reasons = (
        explain(problem, theta[theta_indices(problems, which)])
        for which, problem in enumerate(problems)
    )
    return RuntimeError(
        f"{what} diverged, the first {next(filter(None, reasons), '')} Check the recording's units "
        "and gripper path, or narrow the space's ranges."
    )


def _share(budget: Budget, stage: int) -> float:
    """The share of the frames that count in a stage."""
    shares = (*budget.frame_fractions, 1.0)
    return (shares[0], *shares)[stage]


def _seen(problems: Problems, budget: Budget, stage: int) -> Problems:
    """The problems with what was seen in the frames that count in a stage."""
    share = _share(budget, stage)
    return problems if share == 1 else tuple(beginning(p, share) for p in problems)


def _fresh(
    problems: Problems, budget: Budget, thetas: list, scale: float, stage: int, derive: Derive
) -> Iteration:
    """Descents that begin at some thetas, in a stage."""
    damping, limit = Damping.initial(), jnp.asarray(scale, float)
    seen = _seen(problems, budget, stage)
    normals = normals_at(seen, thetas, [limit] * len(thetas), budget.secant_width, derive)
    return [
        Descent(theta, normal, damping.value, damping.growth, limit, jnp.asarray(stage))
        for theta, normal in zip(thetas, normals, strict=True)
    ]


def _next(
    problems: Problems, budget: Budget, rows: list[Iteration], derive: Derive
) -> Iteration | None:
    """The next iteration; None at the end."""
    row = rows[-1]
    _, best = _best(row)
    now = int(best.stage)
    stage = _rows_of_stage(rows, now)
    prior = prior_weight(problems, best.normal)
    stop = _stop(budget, now)
    kept_on = _kept(row, len(stage))
    moving = [i for i in kept_on if not _arrived(problems, stage, i, prior, stop)]
    is_passed = budget.warm_start and now < _last_stage(budget)
    if is_passed or not moving or len(stage) > budget.max_iterations:
        return _next_stage(problems, budget, row, derive)
    seen = _seen(problems, budget, now)
    trials = [propose(problems, row[i], prior) for i in moving]
    tried = normals_at(seen, trials, [row[i].scale for i in moving], budget.secant_width, derive)
    after = list(row)
    for i, trial, normal in zip(moving, trials, tried, strict=True):
        after[i] = accept(problems, row[i], trial, normal, prior)
    return after


def _rows_of_stage(rows: list[Iteration], stage: int) -> list[Iteration]:
    return [row for row in rows if int(_best(row)[1].stage) == stage]


def _kept(row: Iteration, iteration: int) -> list[int]:
    """Indices of the descents of the latest stage that go on: of many, the better half every few
    iterations (successive halving, Jamieson and Talwalkar 2016)."""
    now = max(int(descent.stage) for descent in row)
    there = [i for i, descent in enumerate(row) if int(descent.stage) == now]
    count = max(FEWEST, len(there) >> (iteration - 1) // HALVING)
    losses = [np.nan_to_num(float(descent.normal.loss), nan=np.inf) for descent in row]
    return sorted(sorted(there, key=losses.__getitem__)[:count])


def _next_stage(
    problems: Problems, budget: Budget, row: Iteration, derive: Derive
) -> Iteration | None:
    """The next stage, of the best descent alone, or the next best where that diverges in the frames
    that count then; None after the last. Raises `RuntimeError` where all diverge.

    From the second stage on outliers are left out, beyond a scale that follows from the distances:
    outliers lie to one side of a sheet, so that even a small weight of theirs biases the estimate.
    """
    now = int(_best(row)[1].stage)
    stage = now + 1
    if stage > _last_stage(budget):
        return None
    there = [i for i, each in enumerate(row) if _is_finite(each)]
    for which in sorted(there, key=lambda i: (-int(row[i].stage), float(row[i].normal.loss))):
        loose = best = row[which]
        if _share(budget, stage) != _share(budget, stage - 1):
            (loose,) = _fresh(problems, budget, [best.theta], 0.0, stage, derive)
        if _is_finite(loose):
            break
    else:
        raise _diverged("all descents", problems, _best(row)[1].theta)
    scale = float(np.clip(STRICT * float(loose.normal.widest), *SCALES))
    after = list(row)
    (after[which],) = _fresh(problems, budget, [best.theta], scale, stage, derive)
    return after


def _best(row: Iteration) -> tuple[int, Descent]:
    """The descent of the least loss in the latest stage, and its index."""
    last = max(int(descent.stage) for descent in row)
    losses = [float(d.normal.loss) if int(d.stage) == last else np.inf for d in row]
    which = int(np.argmin(losses))
    return which, row[which]


def _last_stage(budget: Budget) -> int:
    return len(budget.frame_fractions) + 1


def _stop(budget: Budget, stage: int) -> Stop:
    if stage < _last_stage(budget):
        return MORE_FRAMES
    return ON_THE_WAY if budget.is_intermediate else AT_THE_END


def has_arrived(found: Search, budget: Budget) -> bool:
    """Whether the best descent of a search is at its end, see `_arrived`."""
    now, prior = int(found.best.stage), prior_weight(found.problems, found.best.normal)
    stage = _rows_of_stage(found.rows, now)
    return _arrived(found.problems, stage, found.which, prior, _stop(budget, now))


def _arrived(problems: Problems, stage: list[Iteration], start: int, prior, stop: Stop) -> bool:
    """Whether a descent is at its end by a criterion of `stop`, or diverged. Rejected steps do not
    count: the next is shorter, and may gain."""
    now = stage[-1][start]
    if not np.isfinite(float(now.normal.loss)):
        return True
    least = stop.close * float(prior)
    if len(stage) > 1 and float(remaining(problems, now, prior)) < least:
        return True
    if float(now.damping) >= stop.stuck:
        return True
    before = [
        row[start]
        for row, after in itertools.pairwise(stage)
        if not np.array_equal(row[start].theta, after[start].theta)
    ]
    if len(before) < stop.patience:
        return False
    then, value = (
        float(objective(problems, d.theta, d.normal.loss, prior))
        for d in (before[-stop.patience], now)
    )
    return not value < then - max(least, stop.gain * float(now.normal.loss))


def stacked(rows: list[Iteration]) -> Descent:
    """All descents of some iterations, with the leading axes (iteration, start)."""
    flat = [descent for row in rows for descent in row]
    shape = (len(rows), len(rows[0]))
    return jax.tree.map(
        lambda *leaves: np.stack(leaves).reshape(*shape, *np.shape(leaves[0])), *flat
    )


def _run_of(problems: Problems, budget: Budget, start, key) -> dict[str, str]:
    """What tells one run from another, for its checkpoint."""
    return {"kind": "descent", "run": checkpoints.fingerprint(problems, budget, start, key)}


def _resumed(checkpoint: Path, run: dict[str, str], budget: Budget) -> list[Iteration]:
    """The iterations in a checkpoint. Without a file none, and files built on an older one are
    removed."""
    if not checkpoint.exists():
        checkpoints.forget(checkpoint)
    arrays = checkpoints.load(checkpoint, run)
    if arrays is None:
        return []
    none, vector, square = (jnp.zeros((0,) * dims) for dims in (2, 3, 4))
    normal = Normal(none, none, none, vector, square, square)
    like = Descent(vector, normal, none, none, none, jnp.zeros((0, 0), int))
    stored = checkpoints.tree_from(arrays, like)
    return [
        [jax.tree.map(lambda leaf, i=i, j=j: leaf[i, j], stored) for j in range(budget.num_starts)]
        for i in range(len(stored.stage))
    ]
