"""From a mesh to one that resolves the estimated fabric, and searches from other starts.

The search is made on the mesh before the finest; with several recordings from what the coarsest led
to. Where `r2s.scenarios.resolution` says that the fabric needs the finest, the descent continues
there. A loss over a motion has several minima, so the search is repeated from other starts
(`look_again`).
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation.descent import Search, multi_start
from r2s.estimation.estimate import Estimate
from r2s.estimation.gauss_newton import FINEST, MARGIN, Descent, loss_from
from r2s.estimation.judgement import each_alone, with_uncertainty
from r2s.estimation.mesh_bias import OtherMesh, factor
from r2s.estimation.method import Budget, Progress, tell
from r2s.estimation.prediction import Derive, Theta, remembering
from r2s.estimation.problem import Problem, Problems
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace
from r2s.recordings.recording import Recording
from r2s.scenarios import resolution
from r2s.scenarios.resolution import Shape
from r2s.scenarios.scenario import Scenario

Recordings = Sequence[Recording]

# [s], on the finest mesh: in the scenario's own, of 25 ms at most, a lift of grey interlock is
# 7.3 mm off one in explicit steps, in these 0.7
FINEST_STEP = 1 / 180
ALIKE = 1.02  # times the least loss, within which two ends fit alike
LIKELY = 1.25  # times that, within which the distance of two ends is part of the errors
MOST = 3  # searches, where the first two differ


def descend_by_meshes(
    recordings: Recordings,
    space: ParameterSpace,
    budget: Budget,
    *,
    shape: Shape | None = None,
    finest: bool = False,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The fabric that explains some recordings, on a mesh of `shape` or on one that resolves it.

    Several recordings are weighted by how well each can be followed alone on the coarsest mesh
    (`weights`). Its `mesh_bias` is judged by a mesh whose cells are half as long, or twice as long
    where that would be finer than all of `r2s.scenarios.resolution.LADDER`, or diverged. Where all
    diverges on the finer mesh, the estimate is that of the coarser, and `refused` says why.

    - `finest`: from the first mesh to the finest, whichever fabric is found (where that diverges it
      is an error); not with a `shape`.
    - `checkpoint`: each mesh has its own beside it.
    """
    levels = [[shape] * len(recordings)] if shape else _levels(recordings)
    if finest:
        levels = [levels[0], levels[-1]]
    problems_on = functools.cache(partial(_problems, recordings, space))
    run = _Run(recordings, problems_on, budget, remembering(), checkpoint, progress, key)
    run, at = _first(run, levels[0], leads_on=len(levels) > 1)
    at, refused = _refined(run, at, levels[1:], finest)
    tell(progress, "standard errors")
    ratio = 2.0 if refused else _ratio(at.shapes)
    estimate = with_uncertainty(
        at.found,
        budget,
        other_mesh=OtherMesh(run.problems(_others(at.shapes, ratio)), factor(ratio)),
        checkpoint=checkpoint,
        progress=progress,
        key=key,
    )
    return dataclasses.replace(estimate, shape=_named(recordings, at.shapes), refused=refused)


class Level(NamedTuple):
    """A search on meshes of some shapes, one for each recording."""

    shapes: list[Shape]
    found: Search


class _Run(NamedTuple):
    """What all searches of an estimate share.

    - `problems_on`: the problems of the recordings on meshes of given shapes.
    - `weights`: of the recordings, [1/m^2]; none: all frames count alike.
    """

    recordings: Recordings
    problems_on: Callable[[tuple[Shape, ...]], tuple[Problem, ...]]
    budget: Budget
    derive: Derive
    checkpoint: Path | None
    progress: Progress | None
    key: PRNGKeyArray
    weights: Sequence[Array] = ()

    def problems(self, shapes: Sequence[Shape]) -> tuple[Problem, ...]:
        found = self.problems_on(tuple(shapes))
        return _weighted(found, self.weights) if self.weights else found

    def search(self, shapes: list[Shape], start: Theta | None, leads_on: bool) -> Level:
        """A search on some meshes, near a `start` where there is one."""
        budget, path = self.budget, self.checkpoint
        name = _words(max(shapes))  # of a pull the last mesh is that of the level before
        if start is not None:
            budget = near(budget)
            suffix = f".{name.replace(' ', '')}{'' if leads_on else '.end'}.npz"
            path = path and path.with_suffix(suffix)
        found = multi_start(
            self.problems(shapes),
            budget._replace(is_intermediate=leads_on),
            start=start,
            checkpoint=path,
            progress=self.progress,
            derive=self.derive,
            words=f"descents on {name} vertices",
            key=self.key,
        )
        return Level(shapes, found)

    def look_again(self, at: Level) -> Level:
        found = look_again(at.found, self.budget, progress=self.progress, key=self.key)
        return at._replace(found=found)


def _first(run: _Run, shapes: list[Shape], leads_on: bool) -> tuple[_Run, Level]:
    """The search on the first meshes; of several recordings a second one, by their weights."""
    at = run.search(shapes, None, leads_on)
    if len(run.recordings) == 1:
        return run, at
    theta = at.found.theta
    alone = each_alone(at.found.problems, run.budget, theta, run.key, run.derive, run.progress)
    run = run._replace(weights=weights(alone))
    return run, run.search(shapes, theta, leads_on)


def _refined(run: _Run, at: Level, finer: list[list[Shape]], finest: bool) -> tuple[Level, str]:
    """The search on meshes that resolve the fabric, and why finer ones were refused, or "".

    Before the last level the search is completed, which may end at a softer fabric, and repeated
    from other starts.
    """
    if not finer:
        return run.look_again(at), ""
    for shapes in finer:
        is_last = shapes is finer[-1]
        if is_last and not finest:
            at = run.look_again(run.search(at.shapes, at.found.theta, leads_on=False))
            if not is_too_coarse(run.recordings, at.found.fabric, at.shapes):
                break
        try:
            at = _went_on(at, run.search(shapes, at.found.theta, leads_on=not is_last))
        except RuntimeError as error:
            if finest or isinstance(error, jax.errors.JaxRuntimeError):  # out of memory, say
                raise
            tell(run.progress, f"the finer mesh diverged: back to {_words(max(at.shapes))}")
            refused = f"{_words(max(shapes))} vertices, which it needs: {error}"
            if not is_last:
                at = run.look_again(run.search(at.shapes, at.found.theta, leads_on=False))
            return at, refused
    return at, ""


def _went_on(before: Level, finer: Level) -> Level:
    """A finer level with what is known of the one before. Where it fits worse, its search ended in
    another minimum."""
    old, new = before.found, finer.found
    fits = float(new.best.normal.loss) <= LIKELY * float(old.best.normal.loss)
    worse = f"{_words(max(finer.shapes))} vertices fit worse than {_words(max(before.shapes))} did"
    found = new._replace(reached=old.reached, unsure=old.unsure if fits else worse)
    return finer._replace(found=found)


def look_again(
    found: Search, budget: Budget, *, progress: Progress | None = None, key: PRNGKeyArray
) -> Search:
    """The best of a search and of others from samples of the prior, with how many fit as well.

    There is a third search where the first two differ. All losses count the same points, by the
    outlier scale of the best fit. Ends that lie apart but fit nearly alike are part of the standard
    errors (`others`). A search that diverges counts as one that ended elsewhere. A killed run
    repeats all of this.
    """
    problems, ends, count = found.problems, [found], 1
    once = budget._replace(num_samples=0, num_starts=1, warm_start=False, is_intermediate=True)
    again = partial(multi_start, problems, derive=found.derive, progress=progress, key=key)
    while count < MOST:
        start = _sample(problems[0].space, jr.fold_in(key, count))
        count += 1
        try:
            ends.append(again(once, start=start, words=f"search {count}, from another start"))
        except RuntimeError as error:
            if isinstance(error, jax.errors.JaxRuntimeError):  # out of memory, say
                raise
            tell(progress, f"search {count} diverged")
        losses = _losses(ends, budget)
        best = ends[int(np.argmin(losses))]
        alike = sum(loss <= ALIKE * min(losses) for loss in losses)
        if alike > 1:
            break
    likely = [e for e, loss in zip(ends, losses, strict=True) if loss <= LIKELY * min(losses)]
    others = tuple(each.theta for each in likely if each is not best)
    if best is not found:
        to_the_end = once._replace(frame_fractions=(), warm_start=True, is_intermediate=False)
        best = again(to_the_end, start=best.theta, words="its end")
        ends.append(best)
    lost = f"none of {count - 1} searches from other starts fits as well"
    return best._replace(
        seconds=sum(each.seconds for each in ends),
        others=others,
        reached=(alike, count),
        unsure="" if alike > 1 else lost,
    )


def _sample(space: ParameterSpace, key: PRNGKeyArray) -> Float[Array, " dim"]:
    """A sample of the prior."""
    mean, precision = space.prior()
    normal = jr.normal(key, mean.shape, float)
    place = mean + jnp.linalg.solve(jnp.linalg.cholesky(precision).T, normal)
    return jnp.clip(place, MARGIN, 1 - MARGIN)


def _losses(ends: list[Search], budget: Budget) -> list[float]:
    """The losses [m^2] of some ends, all by one outlier scale."""
    scale = min((each.best.scale for each in ends), key=float)
    predicted = [each.derive(each.problems, each.theta, budget.secant_width) for each in ends]
    return [
        loss_from(each.problems, [seen for seen, _ in pairs], scale)
        for each, pairs in zip(ends, predicted, strict=True)
    ]


def descend_weighted(
    problems: Problems,
    budget: Budget,
    *,
    approach: str,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """`r2s.estimation.judgement.descend`, several recordings weighted by `weights`."""
    found = multi_start(problems, budget, checkpoint=checkpoint, progress=progress, key=key)
    if len(problems) > 1:
        alone = each_alone(problems, budget, found.theta, key, found.derive, progress)
        found = multi_start(
            _weighted(problems, weights(alone)),
            near(budget),
            start=found.theta,
            checkpoint=checkpoint and checkpoint.with_suffix(".weighed.npz"),
            progress=progress,
            derive=found.derive,
            key=key,
        )
    return with_uncertainty(
        found, budget, approach=approach, checkpoint=checkpoint, progress=progress, key=key
    )


def weights(alone: Sequence[Descent]) -> list[Float[Array, ""]]:
    """Weight of each recording, from the end of a descent in it alone: one over its mean squared
    distance, [1/m^2], of noise or of what the model cannot follow.

    Markers and a load cell err by tenths of a millimetre, points of a cloud by millimetres. (A step
    of feasible generalized least squares.)
    """
    left = [max(float(end.normal.loss), FINEST**2) for end in alone]
    return [jnp.asarray(1 / each, float) for each in left]


def _weighted(problems: Problems, counts: Sequence[Float[Array, ""]]) -> tuple[Problem, ...]:
    pairs = zip(problems, counts, strict=True)
    return tuple(dataclasses.replace(each, weight=count) for each, count in pairs)


def near(budget: Budget) -> Budget:
    """The budget of a descent that begins near its end."""
    return budget._replace(num_samples=0, num_starts=1, frame_fractions=(), warm_start=True)


def _levels(recordings: Recordings) -> list[list[Shape]]:
    """The meshes to use, from coarse to fine: on each level that of every recording.

    The coarsest is for the weights of several recordings, and for one of a taut sheet; another one
    of its own would end far off there. The last level has no finer mesh of a taut sheet: it does
    not fold, and 17 x 17 vertices leave 1 to 5 % of its force and 0.5 mm of its markers' places
    (grey interlock, pulled at 0, 45 and 90 degrees to the warp).
    """
    first, *rest = (list(level) for level in zip(*map(_meshes, recordings), strict=True))
    if len(recordings) > 1:
        return [first, *rest]
    return [first, rest[0]] if _is_taut(recordings[0]) else rest


def _meshes(recording: Recording) -> list[Shape]:
    *coarse, finest = resolution.ladder(recording.info.sheet.size)
    return [*coarse, coarse[-1] if _is_taut(recording) else finest]


def _is_taut(recording: Recording) -> bool:
    return recording.info.scenario in resolution.TAUT


def is_too_coarse(recordings: Recordings, fabric: Fabric, shapes: Sequence[Shape]) -> bool:
    """Whether a mesh does not resolve a fabric, in some recording."""
    return any(
        resolution.warning(fabric, each.info.sheet.size, shape, each.info.scenario)
        for each, shape in zip(recordings, shapes, strict=True)
    )


def _named(recordings: Recordings, shapes: Sequence[Shape]) -> Shape:
    """The mesh of an estimate: the finest, of a sheet that is not taut where there is one."""
    pairs = zip(recordings, shapes, strict=True)
    loose = [shape for each, shape in pairs if not _is_taut(each)]
    return max(loose or shapes, key=max)


def _problems(
    recordings: Recordings, space: ParameterSpace, shapes: Sequence[Shape]
) -> tuple[Problem, ...]:
    """The problems of recordings on meshes, in the steps that `in_mesh_steps` gives."""
    found = []
    for recording, shape in zip(recordings, shapes, strict=True):
        problem = Problem.make(recording, space, shape=shape)
        scenario = in_mesh_steps(problem.scenario, recording.info.scenario, shape)
        found.append(dataclasses.replace(problem, scenario=scenario))
    return tuple(found)


def in_mesh_steps(scenario: Scenario, name: str, shape: Shape) -> Scenario:
    """A scenario of some `name`, on the finest mesh in steps of `FINEST_STEP` at most.

    Not a taut sheet, which moves alike in longer steps, nor wind, whose error is larger.
    """
    if scenario.wind is not None or name in resolution.TAUT or not _is_finest([shape]):
        return scenario
    steps = math.ceil(scenario.interval / FINEST_STEP - 1e-9)
    return dataclasses.replace(scenario, substeps=max(scenario.substeps, steps))


def _words(shape: Shape) -> str:
    return f"{shape[0]} x {shape[1]}"


def _is_finest(shapes: Sequence[Shape]) -> bool:
    return max(map(max, shapes)) >= max(resolution.LADDER)


def _ratio(shapes: Sequence[Shape]) -> float:
    """Cell size of the meshes by which the bias of `shapes` is judged, over theirs."""
    return 2.0 if _is_finest(shapes) else 0.5


def _others(shapes: Sequence[Shape], ratio: float) -> list[Shape]:
    """Meshes whose cells are `ratio` times as long."""

    def other(count: int) -> int:
        return max(int((count - 1) / ratio), 1) + 1

    return [(other(rows), other(columns)) for rows, columns in shapes]
