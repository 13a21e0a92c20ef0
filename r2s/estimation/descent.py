"""From anywhere in the range to the best fabric: a coarse search, then Gauss-Newton descents."""

import dataclasses
import itertools
import time
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation import checkpoint as checkpoints
from r2s.estimation import density_doubt, gauss_newton, mesh_bias
from r2s.estimation.agreement import agreement
from r2s.estimation.compiled import (
    Derive,
    loss_from,
    losses_at,
    normals_at,
    predictions_at,
    remembering,
)
from r2s.estimation.covariance import covariance_at
from r2s.estimation.estimate import Estimate
from r2s.estimation.gauss_newton import (
    Descent,
    Normal,
    Problems,
    recording_weights,
    theta_indices,
)
from r2s.estimation.law_error import law_error
from r2s.estimation.mesh_bias import OtherMesh, coarser_of
from r2s.estimation.method import Budget, Progress, tell
from r2s.estimation.misfits import left_out, misfits
from r2s.estimation.nuisances import nuisances
from r2s.estimation.prediction import Theta, explain, fabric_at
from r2s.estimation.problem import Problem, beginning, check_shared
from r2s.fabrics.fabric import Fabric
from r2s.program_memory import let_go_in_time

INITIAL_DAMPING = 1e-2
# of the spread, and between [m]: beyond lies an outlier. At half of it a part of the sheet that the
# start cannot follow counts for nothing, and never draws the sheet there.
STRICT, SCALES = 6.0, (6e-3, 0.015)
HALVING, FEWEST = 3, 3  # iterations, after each of which half go on, but no fewer than this


class Stop(NamedTuple):
    """When a descent has arrived.

    - `close`: when its next step promises to gain less, over the prior's weight, which is about
      twice what a change by one standard error costs.
    - `patience`, `gain`: when so many steps gained less than that, or than this share of the loss.
    - `stuck`: at this damping, when not even a step that is as short gains anything.
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
Row = list[Descent]  # one iteration: the descents of all starts

_propose = eqx.filter_jit(gauss_newton.propose)
_accept = eqx.filter_jit(gauss_newton.accept)
_objective = eqx.filter_jit(gauss_newton.objective)
_remaining = eqx.filter_jit(gauss_newton.remaining)
_weight = eqx.filter_jit(gauss_newton.prior_weight)


DEFAULT = Budget(shares=(0.25, 0.5))


class Search(NamedTuple):
    """- `problems`: what was searched for. - `rows`: all descents in every iteration.
    - `seconds`: how long it took. - `derive`: `remembering` where it was last.
    - `reached`: see `r2s.estimation.estimate.Estimate`. `others`: where else it fits nearly as
      well.
    """

    problems: Problems
    rows: list[Row]
    seconds: float
    derive: Derive
    reached: tuple[int, int] | None = None
    others: tuple[Theta, ...] = ()

    @property
    def best(self) -> Descent:
        """The best descent, at its end."""
        return _best(self.rows[-1])[1]

    @property
    def theta(self) -> Theta:
        """That end, see `r2s.estimation.prediction`."""
        return self.best.theta

    @property
    def fabric(self) -> Fabric:
        """The fabric there."""
        return fabric_at(self.problems[0], self.theta[theta_indices(self.problems, 0)])


def descend(
    problems: Problem | Problems,
    budget: Budget = DEFAULT,
    *,
    approach: str = "diffcloud",
    start: Float[Array, " dim"] | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The fabric that explains one recording, or several of one fabric.

    - `approach`: how the estimate names its method.
    - `start`: in the unit cube, among the coarse places; None: the mean of the space's prior.
    - `checkpoint`: a file that holds the state after every iteration. A run of the same problem
      that finds it goes on from there.
    - `progress`: called with the iteration and the best loss [m^2].
    - `key`: draws the other coarse places.

    The estimate has converged when the best descent arrived in the last stage, see `_arrived`. A
    simulation that diverges counts as infinitely bad; when all do, raises `RuntimeError`. Raises
    `ValueError` for no starts, for an odd number of places around the end, and for shares that do
    not rise between 0 and 1.
    """
    problems = (problems,) if isinstance(problems, Problem) else problems
    found = search(problems, budget, start=start, checkpoint=checkpoint, progress=progress, key=key)
    saved = {"checkpoint": checkpoint, "progress": progress, "key": key}
    return judged(found, budget, approach=approach, **saved)


def search(
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
    """The descents of `descend`, whose arguments these are; a `start` may be a whole theta.

    `derive`: of an earlier search in the same recordings, whose end need not be derived again.
    `words`: what the progress says.
    """
    if budget.starts < 1:
        raise ValueError(f"an estimate needs a start or more, got {budget.starts}")
    if any(not low < high for low, high in itertools.pairwise((0.0, *budget.shares, 1.0))):
        raise ValueError(f"shares of the frames must rise between 0 and 1, got {budget.shares}")
    if budget.around < 0 or budget.around % 2:
        raise ValueError(f"places around the end are in pairs: an even number, got {budget.around}")
    check_shared(problems)
    let_go_in_time()
    began, derive = time.perf_counter(), derive or remembering()
    run = _run_of(problems, budget, start, key) if checkpoint else {}
    rows = _resumed(checkpoint, run, budget) if checkpoint else []
    if not rows:
        rows = [_begin(problems, budget, start, derive, progress, key)]
    tell(progress, words)
    while (row := _next(problems, budget, rows, derive)) is not None:
        rows.append(row)
        if checkpoint is not None:
            checkpoints.save(checkpoint, checkpoints.arrays_of(_stacked(rows)), run)
        if progress is not None:
            progress(len(rows) - 2, float(_best(row)[1].normal.loss))
    return Search(problems, rows, time.perf_counter() - began, derive)


def judged(
    found: Search,
    budget: Budget,
    *,
    approach: str = "diffcloud",
    other_mesh: OtherMesh | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The estimate at the end of a search, with its standard errors, which hold what a constant
    stiffness is off that at small strain (`r2s.estimation.law_error`).

    `checkpoint`: of the search; a descent for the density (`r2s.estimation.density_doubt`) is kept
    beside it. `progress`: as in `descend`.

    `other_mesh`: by which its bias is judged, which the standard errors hold (`mesh_bias.settled`).
    If it is coarser, places around the end, each recording alone and a density are tried on it.
    """
    began, problems = time.perf_counter(), found.problems
    which, best = _best(found.rows[-1])
    stage, prior = _rows_of_stage(found.rows, int(best.stage)), _weight(problems, best.normal)
    predicted = found.derive(problems, best.theta, budget.width)
    coarse, beside = coarser_of(problems, other_mesh)
    around = {"tried_on": coarse, "derive": found.derive}
    covariance = covariance_at(problems, budget, best, jax.random.fold_in(key, 1), **around)
    if found.others:  # of one valley, or of several fabrics that little tells apart
        off = np.asarray(jnp.stack(found.others) - best.theta[None], np.float64)
        covariance = covariance + off.T @ off / len(off)
    of_law, seen = law_error(problems, best, prior, predicted), [each for each, _ in predicted]
    covariance, bias = covariance + np.outer(of_law, of_law), None
    if other_mesh is not None:
        led = mesh_bias.mesh_bias(problems, other_mesh, best, prior, predicted)
        theta, covariance, bias = mesh_bias.settled(
            problems, other_mesh, best, prior, covariance, led
        )
        if theta is not best.theta:
            best, seen = dataclasses.replace(best, theta=theta), predictions_at(problems, theta)
    rows = [*found.rows[:-1], [best if i == which else row for i, row in enumerate(found.rows[-1])]]
    seconds = found.seconds + time.perf_counter() - began
    converged = _arrived(problems, stage, which, prior, _stop(budget, int(best.stage)))
    converged = converged and (found.reached is None or found.reached[0] > 1)
    told = covariance, approach, seconds, converged, loss_from(problems, seen), bias
    estimate = collect(problems, rows, *told)
    try:
        alone = each_alone(coarse, budget, best.theta, key, found.derive, progress)
    except RuntimeError as error:  # on the coarser mesh, of a fabric of the finer one
        if isinstance(error, jax.errors.JaxRuntimeError):  # out of memory, say
            raise
        tell(progress, "a recording alone diverged: not compared")
        alone = []
    shares = tuple(float(each) for each in recording_weights(problems)) if alone else ()
    biases = mesh_bias.alone(coarse, beside, alone, found.derive, budget.width)
    agreed = agreement(coarse, alone, biases) if alone else None
    missed = misfits(problems, best.theta, seen)
    if density_doubt.is_asked(problems, agreed, missed):
        path = checkpoint and checkpoint.with_suffix(".density.npz")
        saved = {"checkpoint": path, "progress": progress, "key": key}
        agreed = _with_density(agreed, coarse, budget, best.theta, **saved)
    return dataclasses.replace(
        estimate,
        agreement=agreed,
        shares=shares,
        misfits=missed,
        left_out=left_out(problems, seen, float(best.scale)),
        reached=found.reached,
    )


def each_alone(
    problems: Problems,
    budget: Budget,
    theta: Theta,
    key: PRNGKeyArray,
    derive: Derive | None = None,
    progress: Progress | None = None,
) -> list[Descent]:
    """The ends of descents in each of several recordings alone, from a theta of all of them."""
    if len(problems) < 2:
        return []
    saved = {"derive": derive, "progress": progress, "key": key}
    alone = budget._replace(coarse=0, starts=1, shares=(), near=True, leads_on=True)
    ends = []
    for which, problem in enumerate(problems):
        start = theta[theta_indices(problems, which)]
        words = f"recording {which + 1} of {len(problems)} alone"
        ends.append(search((problem,), alone, start=start, words=words, **saved).best)
    return ends


def _with_density(agreed, problems: Problems, budget: Budget, theta: Theta, **saved):
    """The agreement with the density that all recordings lead to; as it is where they diverge."""
    loose, start = density_doubt.freed(problems, theta)
    free = budget._replace(coarse=0, starts=1, shares=(), near=True, leads_on=False)
    try:
        end = search(loose, free, start=start, words="which density would fit", **saved).best
    except RuntimeError:
        return agreed
    return density_doubt.with_density(agreed, loose, end)


def _begin(problems: Problems, budget: Budget, start, derive: Derive, progress, key) -> Row:
    dim, count = problems[0].space.dim, max(budget.coarse, budget.starts)
    usual = jnp.clip(problems[0].space.prior()[0], gauss_newton.MARGIN, 1 - gauss_newton.MARGIN)
    start = usual if start is None else start
    places = jax.random.uniform(key, (count, dim), float)
    nothing = jnp.zeros((count, gauss_newton.theta_length(problems) - dim), float)
    thetas = jnp.concatenate([places, nothing], axis=1).at[0, : len(start)].set(start)
    if budget.coarse:
        losses = losses_at(_seen(problems, budget, 0), thetas, progress)
        if not np.any(np.isfinite(losses)):
            raise _diverged(f"all {count} simulations of the coarse search", problems, thetas[0])
        thetas = thetas[np.argsort(losses)]
    tell(progress, "compiling the derivatives")
    row = _fresh(problems, budget, list(thetas[: budget.starts]), 0.0, 0, derive)
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
    shares = (*budget.shares, 1.0)
    return (shares[0], *shares)[stage]


def _seen(problems: Problems, budget: Budget, stage: int) -> Problems:
    """The problems with what was seen in the frames that count in a stage."""
    share = _share(budget, stage)
    return problems if share == 1 else tuple(beginning(p, share) for p in problems)


def _fresh(
    problems: Problems, budget: Budget, thetas: list, scale: float, stage: int, derive: Derive
) -> Row:
    """Descents that begin at some thetas, in a stage."""
    damping, growth, limit = (
        jnp.asarray(number, float) for number in (INITIAL_DAMPING, gauss_newton.GROWTH, scale)
    )
    seen = _seen(problems, budget, stage)
    normals = normals_at(seen, thetas, [limit] * len(thetas), budget.width, derive)
    return [
        Descent(theta, normal, damping, growth, limit, jnp.asarray(stage))
        for theta, normal in zip(thetas, normals, strict=True)
    ]


def _next(problems: Problems, budget: Budget, rows: list[Row], derive: Derive) -> Row | None:
    """The next iteration; None at the end."""
    row = rows[-1]
    _, best = _best(row)
    now = int(best.stage)
    stage = _rows_of_stage(rows, now)
    prior = _weight(problems, best.normal)
    stop = _stop(budget, now)
    kept_on = _kept(row, len(stage))
    moving = [i for i in kept_on if not _arrived(problems, stage, i, prior, stop)]
    is_passed = budget.near and now < _last_stage(budget)
    if is_passed or not moving or len(stage) > budget.iterations:
        return _later(problems, budget, row, derive)
    seen = _seen(problems, budget, now)
    trials = [_propose(problems, row[i], prior) for i in moving]
    tried = normals_at(seen, trials, [row[i].scale for i in moving], budget.width, derive)
    after = list(row)
    for i, trial, normal in zip(moving, trials, tried, strict=True):
        after[i] = _accept(problems, row[i], trial, normal, prior)
    return after


def _rows_of_stage(rows: list[Row], stage: int) -> list[Row]:
    return [row for row in rows if int(_best(row)[1].stage) == stage]


def _kept(row: Row, iteration: int) -> list[int]:
    """Indices of the descents of the latest stage that go on.

    Of many, the better half goes on every few iterations (successive halving, Jamieson and
    Talwalkar 2016). A descent that diverged is the worst.
    """
    now = max(int(descent.stage) for descent in row)
    there = [i for i, descent in enumerate(row) if int(descent.stage) == now]
    count = max(FEWEST, len(there) >> (iteration - 1) // HALVING)
    losses = [np.nan_to_num(float(descent.normal.loss), nan=np.inf) for descent in row]
    return sorted(sorted(there, key=losses.__getitem__)[:count])


def _later(problems: Problems, budget: Budget, row: Row, derive: Derive) -> Row | None:
    """The next stage, to which only the best descent goes on; None after the last. Where that
    diverges in the frames that count then, the next best does, of those that earlier stages left
    too; `RuntimeError` where all diverge.

    From the second stage on outliers are left out, beyond a scale that follows from the distances
    left: outliers lie to one side of a sheet, so that even a small weight of theirs biases the
    estimate.
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


def _best(row: Row) -> tuple[int, Descent]:
    """The descent of the least loss in the latest stage, and its index."""
    last = max(int(descent.stage) for descent in row)
    losses = [float(d.normal.loss) if int(d.stage) == last else np.inf for d in row]
    which = int(np.argmin(losses))
    return which, row[which]


def _last_stage(budget: Budget) -> int:
    return len(budget.shares) + 1


def _stop(budget: Budget, stage: int) -> Stop:
    if stage < _last_stage(budget):
        return MORE_FRAMES
    return ON_THE_WAY if budget.leads_on else AT_THE_END


def _arrived(problems: Problems, stage: list[Row], start: int, prior, stop: Stop) -> bool:
    """Whether a descent is at its end.

    It is when its next step promises to gain next to nothing, when its latest steps have gained
    next to nothing, when not even a short step gains anything, or when it diverged. A step that was
    refused is none: the next is shorter, and may gain.
    """
    now = stage[-1][start]
    if not np.isfinite(float(now.normal.loss)):
        return True
    least = stop.close * float(prior)
    if len(stage) > 1 and float(_remaining(problems, now, prior)) < least:
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
        float(_objective(problems, d.theta, d.normal.loss, prior))
        for d in (before[-stop.patience], now)
    )
    return not value < then - max(least, stop.gain * float(now.normal.loss))


def _stacked(rows: list[Row]) -> Descent:
    """All descents of some iterations, with the leading axes (iteration, start)."""
    flat = [descent for row in rows for descent in row]
    shape = (len(rows), len(rows[0]))
    return jax.tree.map(
        lambda *leaves: np.stack(leaves).reshape(*shape, *np.shape(leaves[0])), *flat
    )


def _run_of(problems: Problems, budget: Budget, start, key) -> dict[str, str]:
    """What tells one run from another, for its checkpoint."""
    return {"kind": "descent", "run": checkpoints.fingerprint(problems, budget, start, key)}


def _resumed(checkpoint: Path, run: dict[str, str], budget: Budget) -> list[Row]:
    """The iterations in a checkpoint; none when there is no file (then what was built on another
    run's is of no use, and removed)."""
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
        [jax.tree.map(lambda leaf, i=i, j=j: leaf[i, j], stored) for j in range(budget.starts)]
        for i in range(len(stored.stage))
    ]


def collect(
    problems: Problems,
    rows: list[Row],
    covariance: Float[np.ndarray, "theta theta"],
    approach: str,
    seconds: float,
    converged: bool | None,
    loss: float,
    bias: Float[np.ndarray, " theta"] | None = None,
) -> Estimate:
    """The estimate of the best descent in the last of some iterations, from its covariance.

    `bias` is that of its mesh, which the covariance holds already.
    """
    space = problems[0].space
    _, best = _best(rows[-1])
    of_fabric = covariance[: space.dim, : space.dim]
    deviation = np.sqrt(np.diag(of_fabric))
    descents = _stacked(rows)
    values_of = jax.vmap(jax.vmap(space.values))
    widths = np.array([bound.width for bound in space.ranges])
    return Estimate(
        approach=approach,
        fabric=fabric_at(problems[0], best.theta[theta_indices(problems, 0)]),
        ranges=space.ranges,
        values=np.asarray(space.values(best.theta[: space.dim])),
        standard_errors=deviation * widths,
        mesh_bias=None if bias is None else np.abs(bias[: space.dim]) * widths,
        correlation=of_fabric / np.outer(deviation, deviation),
        nuisances=nuisances(problems, np.asarray(best.theta), np.sqrt(np.diag(covariance))),
        loss=loss,
        losses=np.asarray(descents.normal.loss),
        history=np.asarray(values_of(jnp.asarray(descents.theta[..., : space.dim]))),
        seconds=seconds,
        converged=converged,
    )
