"""The search for the best fabric: coarse sampling, then Gauss-Newton descents."""

import dataclasses
import itertools
import time
from pathlib import Path
from typing import Any, NamedTuple

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
    prior_terms,
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
    theta_indices,
    theta_length,
)
from r2s.estimation.problem import Problems, beginning, check_shared
from r2s.materials.fabric import Fabric

# an outlier lies beyond so many spreads, within these limits [m]. At half of that, a part of the
# sheet that the start cannot follow has no weight, and never attracts the sheet.
STRICT, SCALES = 6.0, (6e-3, 0.015)
HALVING, FEWEST = 3, 3  # iterations after which half of the descents continue; at least so many


class Stop(NamedTuple):
    """When a descent ends.

    - `close`: when the predicted gain of its next step over the prior's weight is less; two are
      about a change by one standard error.
    - `patience`, `gain`: when so many steps gained less than that, or than this share of the loss.
    - `stuck`: at this damping: not even so short a step lowers the loss.
    """

    close: float
    patience: int
    gain: float
    stuck: float


# At a tenth of a standard error; or, where another descent starts there, at a quarter (a half is
# too early: the outliers of then may hold it there); or, where more frames follow, roughly.
AT_THE_END, ON_THE_WAY = Stop(5e-3, 4, 5e-4, 10.0), Stop(0.03, 2, 3e-3, 10.0)
MORE_FRAMES = Stop(0.03, 2, 0.02, 1.0)
LIKELY = 1.25  # times the least loss, within which another end is part of the errors
ONE_ERROR = 0.5  # predicted gain over the prior's weight, of a step of one standard error
Iteration = list[Descent]  # one iteration: the descents of all starts
DEFAULT = Budget(frame_fractions=(0.25, 0.5))


class Diverged(RuntimeError):
    """All simulations of a search diverged."""


class Run(NamedTuple):
    """What the searches of an estimate share.

    - `derive`: derivatives at a theta, with a cache of the latest.
    - `checkpoint`: a file of the state after every iteration, from which the same search resumes.
    - `progress`: called with the iteration and the best loss [m^2].
    - `known`: the end of another search. A search that `leads_to` it ends.
    """

    budget: Budget
    key: PRNGKeyArray
    derive: Derive
    checkpoint: Path | None = None
    progress: Progress | None = None
    known: Descent | None = None

    def near(self, **changes: Any) -> "Run":
        """For one descent that begins near its end; `changes` of the budget."""
        one = {"num_samples": 0, "num_starts": 1, "frame_fractions": (), "warm_start": True}
        return self._replace(budget=self.budget._replace(**one | changes))

    def beside(self, suffix: str) -> "Run":
        """With a checkpoint beside this one."""
        return self._replace(checkpoint=self.checkpoint and self.checkpoint.with_suffix(suffix))


class Search(NamedTuple):
    """A finished search.

    - `rows`: all descents in every iteration. `seconds`: how long it took.
    - `reached`, `unsure`: see `r2s.estimation.estimate.Estimate`. `others`: other ends that fit
      nearly as well. `shapes`: of the meshes, where it is one of several.
    """

    problems: Problems
    rows: list[Iteration]
    seconds: float
    reached: tuple[int, int] | None = None
    unsure: str = ""
    others: tuple[Theta, ...] = ()
    shapes: tuple[tuple[int, int], ...] = ()

    @property
    def best(self) -> Descent:
        """The best descent, at its end."""
        return _best(self.rows[-1])[1]

    @property
    def theta(self) -> Theta:
        """Its end."""
        return self.best.theta

    @property
    def fabric(self) -> Fabric:
        """The fabric at its end."""
        return fabric_at(self.problems[0], self.theta[theta_indices(self.problems, 0)])


def each_alone(problems: Problems, run: Run, theta: Theta, name: str) -> list[Descent]:
    """The ends of descents in each of several recordings alone, from a theta of all of them; none
    of a single recording. `name`: of their checkpoints."""
    if len(problems) < 2:
        return []
    near, ends = run.near(is_intermediate=True), []
    for which, problem in enumerate(problems):
        words = f"recording {which + 1} of {len(problems)} alone"
        own, one = theta[theta_indices(problems, which)], near.beside(f".{name}{which + 1}.npz")
        ends.append(multi_start((problem,), one, start=own, words=words).best)
    return ends


def multi_start(
    problems: Problems,
    run: Run,
    *,
    start: Float[Array, " start"] | None = None,
    words: str = "descents",
) -> Search:
    """The descents of `r2s.estimation.judgement.descend`; a `start` may be a whole theta.

    `words`: for the progress.
    """
    budget, checkpoint, settings = run.budget, run.checkpoint, {}
    if budget.num_starts < 1:
        raise ValueError(f"an estimate needs a start or more, got {budget.num_starts}")
    fractions, probes = budget.frame_fractions, budget.num_probes
    if any(not low < high for low, high in itertools.pairwise((0.0, *fractions, 1.0))):
        raise ValueError(f"frame_fractions must rise between 0 and 1, got {fractions}")
    if probes < 0 or probes % 2:
        raise ValueError(f"num_probes: places around the end are in pairs, got {probes}")
    check_shared(problems)
    clear_in_time()
    began, rows = time.perf_counter(), []
    if checkpoint is not None:
        run_hash = checkpoints.fingerprint(problems, budget, start, run.key)
        settings = {"kind": "descent", "run": run_hash}
        rows = _resumed(checkpoint, settings, budget)
    if not rows:
        rows = [_begin(problems, run, start)]
    tell(run.progress, words)
    while (row := _next(problems, run, rows)) is not None:
        rows.append(row)
        if checkpoint is not None:
            checkpoints.save(checkpoint, checkpoints.arrays_of(stacked(rows)), settings)
        if run.progress is not None:
            run.progress(len(rows) - 2, float(_best(row)[1].normal.loss))
    return Search(problems, rows, time.perf_counter() - began)


def _begin(problems: Problems, run: Run, start: Float[Array, " start"] | None) -> Iteration:
    budget, space = run.budget, problems[0].space
    dim, count = space.dim, max(budget.num_samples, budget.num_starts)
    if start is None:
        start = jnp.clip(space.prior()[0], MARGIN, 1 - MARGIN)
    places = jax.random.uniform(run.key, (count, dim), float)
    nuisances = jnp.zeros((count, theta_length(problems) - dim), float)
    thetas = jnp.concatenate([places, nuisances], axis=1).at[0, : len(start)].set(start)
    if budget.num_samples:
        losses = losses_at(_seen(problems, budget, 0), thetas, run.progress)
        if not np.any(np.isfinite(losses)):
            raise _diverged(f"all {count} simulations of the coarse search", problems, thetas[0])
        thetas = thetas[np.argsort(losses)]
    tell(run.progress, "compiling the derivatives")
    row = _fresh(problems, run, list(thetas[: budget.num_starts]), 0.0, 0)
    if not np.any(np.isfinite(_losses(row))):
        raise _diverged("all starts of the descents", problems, thetas[0])
    return row


def _losses(row: Iteration) -> list[float]:
    return [float(descent.normal.loss) for descent in row]


def _diverged(what: str, problems: Problems, theta: Theta) -> Diverged:
    reasons = (explain(p, theta[theta_indices(problems, i)]) for i, p in enumerate(problems))
    return Diverged(
        f"{what} diverged, the first {next(filter(None, reasons), '')} Check the recording's units "
        "and gripper path, or narrow the space's ranges."
    )


def _shares(budget: Budget) -> tuple[float, ...]:
    """The share of the frames that count in each stage."""
    shares = (*budget.frame_fractions, 1.0)
    return (shares[0], *shares)


def _seen(problems: Problems, budget: Budget, stage: int) -> Problems:
    """The problems with the observations of the frames that count in a stage."""
    share = _shares(budget)[stage]
    return problems if share == 1 else tuple(beginning(p, share) for p in problems)


def _fresh(problems: Problems, run: Run, thetas: list, scale: float, stage: int) -> Iteration:
    """Descents that begin at some thetas, in a stage."""
    damping, limits = Damping.initial(), [jnp.asarray(scale, float)] * len(thetas)
    seen = _seen(problems, run.budget, stage)
    normals = normals_at(seen, thetas, limits, run.budget.secant_width, run.derive)
    return [
        Descent(theta, normal, damping.value, damping.growth, limit, jnp.asarray(stage))
        for theta, normal, limit in zip(thetas, normals, limits, strict=True)
    ]


def _next(problems: Problems, run: Run, rows: list[Iteration]) -> Iteration | None:
    """The next iteration; None at the end."""
    row, budget = rows[-1], run.budget
    _, best = _best(row)
    now = int(best.stage)
    stage = _rows_of_stage(rows, now)
    prior = prior_weight(problems, best.normal)
    stop = _stop(budget, now)
    kept = _kept(row, len(stage))
    moving = [i for i in kept if not _arrived(problems, stage, i, prior, stop)]
    is_last = now == len(_shares(budget)) - 1
    if is_last and run.known is not None and leads_to(problems, best, run.known):
        return None
    is_passed = budget.warm_start and not is_last
    if is_passed or not moving or len(stage) > budget.max_iterations:
        return _next_stage(problems, run, row)
    seen = _seen(problems, budget, now)
    trials = [propose(problems, row[i], prior) for i in moving]
    scales = [row[i].scale for i in moving]
    tried = normals_at(seen, trials, scales, budget.secant_width, run.derive)
    after = list(row)
    for i, trial, normal in zip(moving, trials, tried, strict=True):
        after[i] = accept(problems, row[i], trial, normal, prior)
    return after


def _rows_of_stage(rows: list[Iteration], stage: int) -> list[Iteration]:
    return [row for row in rows if int(_best(row)[1].stage) == stage]


def _kept(row: Iteration, iteration: int) -> list[int]:
    """Indices of the descents of the latest stage that continue: of many, the better half every few
    iterations (successive halving, Jamieson and Talwalkar 2016)."""
    now = max(int(descent.stage) for descent in row)
    latest = [i for i, descent in enumerate(row) if int(descent.stage) == now]
    count = max(FEWEST, len(latest) >> (iteration - 1) // HALVING)
    losses = np.nan_to_num(_losses(row), nan=np.inf)
    return sorted(sorted(latest, key=losses.__getitem__)[:count])


def _next_stage(problems: Problems, run: Run, row: Iteration) -> Iteration | None:
    """The next stage, of the best descent alone, or the next best where that diverges in the frames
    that count then; None after the last. Raises `Diverged` where all do.

    From the second stage on outliers are left out, beyond a scale that follows from the distances:
    outliers lie to one side of a sheet, so that even a small weight of theirs biases the estimate.
    """
    stage, shares = int(_best(row)[1].stage) + 1, _shares(run.budget)
    if stage == len(shares):
        return None
    finite = [i for i, loss in enumerate(_losses(row)) if np.isfinite(loss)]
    for which in sorted(finite, key=lambda i: (-int(row[i].stage), float(row[i].normal.loss))):
        loose = best = row[which]
        if shares[stage] != shares[stage - 1]:
            (loose,) = _fresh(problems, run, [best.theta], 0.0, stage)
        if np.isfinite(loose.normal.loss):
            break
    else:
        raise _diverged("all descents", problems, _best(row)[1].theta)
    scale = float(np.clip(STRICT * float(loose.normal.widest), *SCALES))
    after = list(row)
    (after[which],) = _fresh(problems, run, [best.theta], scale, stage)
    return after


def _best(row: Iteration) -> tuple[int, Descent]:
    """The descent of the least loss in the latest stage, and its index."""
    stages = np.array([int(descent.stage) for descent in row])
    which = int(np.argmin(np.where(stages == stages.max(), _losses(row), np.inf)))
    return which, row[which]


def _stop(budget: Budget, stage: int) -> Stop:
    if stage < len(_shares(budget)) - 1:
        return MORE_FRAMES
    return ON_THE_WAY if budget.is_intermediate else AT_THE_END


def has_arrived(search: Search) -> bool:
    """Whether the best descent of a search is at its end, and was not ended by its budget."""
    which, best = _best(search.rows[-1])
    now, prior = int(best.stage), prior_weight(search.problems, best.normal)
    stage = _rows_of_stage(search.rows, now)
    return _arrived(search.problems, stage, which, prior, AT_THE_END)


def leads_to(problems: Problems, descent: Descent, known: Descent) -> bool:
    """Whether a descent fits about as well as a known end, and its next step would end within a
    standard error of it."""
    if not float(descent.normal.loss) <= LIKELY * float(known.normal.loss):
        return False
    undamped = dataclasses.replace(descent, damping=jnp.zeros_like(descent.damping))
    off = propose(problems, undamped, prior_weight(problems, descent.normal)) - known.theta
    prior = prior_weight(problems, known.normal)
    matrix = known.normal.matrix + prior * prior_terms(problems, known.theta)[1]
    return bool(off @ matrix @ off / 2 <= ONE_ERROR * prior)


def is_stuck(search: Search) -> bool:
    """Whether no step lowers the loss at the end of a search, though its derivative says that the
    minimum is more than a standard error away."""
    best, prior = search.best, prior_weight(search.problems, search.best.normal)
    is_far = float(remaining(search.problems, best, prior)) > ONE_ERROR * float(prior)
    return float(best.damping) >= AT_THE_END.stuck and is_far


def _arrived(problems: Problems, stage: list[Iteration], start: int, prior, stop: Stop) -> bool:
    """Whether a descent is at its end by a criterion of `stop`, or diverged. Rejected steps do not
    count: the next is shorter, and may lower the loss."""
    now = stage[-1][start]
    if not np.isfinite(now.normal.loss) or float(now.damping) >= stop.stuck:
        return True
    least = stop.close * float(prior)
    if len(stage) > 1 and float(remaining(problems, now, prior)) < least:
        return True
    before = [
        row[start]
        for row, after in itertools.pairwise(stage)
        if not np.array_equal(row[start].theta, after[start].theta)
    ]
    if len(before) < stop.patience:
        return False
    old, new = (
        float(objective(problems, descent.theta, descent.normal.loss, prior))
        for descent in (before[-stop.patience], now)
    )
    return not new < old - max(least, stop.gain * float(now.normal.loss))


def stacked(rows: list[Iteration]) -> Descent:
    """All descents of some iterations, with the leading axes (iteration, start)."""
    flat = [descent for row in rows for descent in row]
    shape = (len(rows), len(rows[0]))
    return jax.tree.map(
        lambda *leaves: np.stack(leaves).reshape(*shape, *np.shape(leaves[0])), *flat
    )


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
