"""From a mesh to one that resolves the estimated fabric, and searches from other starts.

The search is made on the mesh before the finest; with several recordings from the end of one on the
coarsest. Where `r2s.scenarios.resolution` says that the fabric needs the finest, the descent
continues there. A loss over a motion has several minima, so the search is repeated from other
starts (`look_again`).
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from r2s.estimation.descent import (
    LIKELY,
    Diverged,
    Run,
    Search,
    each_alone,
    leads_to,
    multi_start,
)
from r2s.estimation.estimate import Estimate
from r2s.estimation.gauss_newton import FINEST, MARGIN, Descent, loss_from
from r2s.estimation.judgement import with_uncertainty
from r2s.estimation.method import tell
from r2s.estimation.prediction import Theta
from r2s.estimation.problem import Problem, Problems, problems_on_mpm
from r2s.estimation.standard_errors import OtherMesh, factor
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace
from r2s.recordings.recording import Recording
from r2s.scenarios import resolution
from r2s.scenarios.resolution import Shape
from r2s.scenarios.scenario import Scenario

Recordings = Sequence[Recording]
Shapes = tuple[Shape, ...]  # of the meshes, one for each recording

# [s], on the finest mesh: in the scenario's own, of 25 ms at most, a lift of grey interlock is
# 7.3 mm off one in explicit steps, in these 0.7
FINEST_STEP = 1 / 180
ALIKE = 1.02  # times the least loss, within which two ends fit equally well
MOST = 3  # searches, where the first two differ


def descend_by_meshes(
    recordings: Recordings,
    space: ParameterSpace,
    run: Run,
    shape: Shape | None = None,
    finest: bool = False,
) -> Estimate:
    """The fabric that explains some recordings, on a mesh of `shape` or on one that resolves it.

    Several recordings are weighted by how well each can be followed alone on the coarsest mesh
    (`weights`). Its `mesh_bias` is judged by a mesh whose cells are half as long, or twice as long
    where that would be finer than all of `r2s.scenarios.resolution.LADDER`, or diverged. Where all
    diverges on the finer mesh, the estimate is that of the coarser, and `refused` says why. Each
    mesh has its own checkpoint.

    - `finest`: from the first mesh to the finest, whatever the fabric (where that diverges it is an
      error); not with a `shape`.
    """
    levels = [(shape,) * len(recordings)] if shape else _levels(recordings)
    if finest:
        levels = [levels[0], levels[-1]]
    problems_on = functools.cache(partial(_problems, recordings, space))
    meshes = _Meshes(recordings, problems_on, run, levels[0])
    meshes, search = _first(meshes, levels[0], leads_on=len(levels) > 1)
    search, refused = _refined(meshes, search, levels[1:], finest)
    tell(run.progress, "standard errors")
    ratio = 2.0 if refused or _is_finest(search.shapes) else 0.5
    other_mesh = OtherMesh(meshes.problems(_others(search.shapes, ratio)), factor(ratio))
    estimate = with_uncertainty(search, run, other_mesh=other_mesh)
    return dataclasses.replace(estimate, shape=_named(recordings, search.shapes), refused=refused)


def descend_on_mpm(
    recordings: Recordings, space: ParameterSpace, run: Run, shape: Shape
) -> Estimate:
    """The fabric that explains some recordings, simulated by material points of a mesh of `shape`
    vertices; several are weighted by `weights`."""
    problems = problems_on_mpm(recordings, space, shape)
    shapes = (shape,) * len(recordings)
    meshes = _Meshes(recordings, lambda _: problems, run, shapes)
    _, search = _first(meshes, shapes, leads_on=False)
    return dataclasses.replace(with_uncertainty(search, run, "diffcp"), shape=shape)


class _Meshes(NamedTuple):
    """The searches of an estimate on several meshes.

    - `problems_on`: the problems of the recordings on meshes of given shapes.
    - `coarsest`: the first of these.
    - `weights`: of the recordings, [1/m^2]; none: all frames have the same.
    - `first`: of several recordings, the weighted search on the coarsest.
    """

    recordings: Recordings
    problems_on: Callable[[Shapes], Problems]
    run: Run
    coarsest: Shapes
    weights: Sequence[Array] = ()
    first: Search | None = None

    def problems(self, shapes: Shapes) -> Problems:
        problems = self.problems_on(shapes)
        if not self.weights:
            return problems
        pairs = zip(problems, self.weights, strict=True)
        return tuple(dataclasses.replace(problem, weight=weight) for problem, weight in pairs)

    def search(self, shapes: Shapes, start: Theta | None, leads_on: bool) -> Search:
        """A search on some meshes, near a `start` if there is one."""
        run, name = self.run, _words(shapes)
        if start is not None:
            run = run.near().beside(f".{name.replace(' ', '')}{'' if leads_on else '.end'}.npz")
        run = run._replace(budget=run.budget._replace(is_intermediate=leads_on))
        words = f"descents on {name} vertices"
        search = multi_start(self.problems(shapes), run, start=start, words=words)
        return search._replace(shapes=shapes)

    def completed(self, search: Search) -> Search:
        """A search from the end of another, and from other starts: of several recordings these
        begin on the coarsest mesh, where they take a quarter of the time."""
        end = self.search(search.shapes, search.theta, leads_on=False)
        end = end._replace(unsure=search.unsure)
        return look_again(end, self.run, None if search.shapes == self.coarsest else self.first)


def _first(meshes: _Meshes, shapes: Shapes, leads_on: bool) -> tuple[_Meshes, Search]:
    """The search on the first meshes; of several recordings a second one, by their weights."""
    search = meshes.search(shapes, None, leads_on)
    if len(meshes.recordings) == 1:
        return meshes, search
    alone = each_alone(search.problems, meshes.run, search.theta, "alone")
    meshes = meshes._replace(weights=weights(alone))
    first = meshes.search(shapes, search.theta, leads_on)
    return meshes._replace(first=first), first


def _refined(
    meshes: _Meshes, search: Search, finer: Sequence[Shapes], finest: bool
) -> tuple[Search, str]:
    """The search on meshes that resolve the fabric, and why finer ones were refused, or "".

    Before the last level the search is completed, which may end at a softer fabric, and repeated
    from other starts.
    """
    if not finer:
        return look_again(search, meshes.run), ""
    for shapes in finer:
        is_last = shapes is finer[-1]
        if is_last and not finest:
            search = meshes.completed(search)
            if not is_too_coarse(meshes.recordings, search.fabric, search.shapes):
                break
        try:
            on_finer = meshes.search(shapes, search.theta, leads_on=not is_last)
            search = _continued(search, on_finer, meshes.run)
        except Diverged as error:
            if finest:
                raise
            tell(meshes.run.progress, f"the finer mesh diverged: back to {_words(search.shapes)}")
            search = search if is_last else meshes.completed(search)
            return search, f"{_words(shapes)} vertices, which it needs: {error}"
    return search, ""


def _continued(before: Search, finer: Search, run: Run) -> Search:
    """A finer search, with what other searches said of the one before. Where it fits worse, by one
    outlier scale, it ended in another minimum."""
    old, new = _losses([before, finer], run)
    worse = f"{_words(finer.shapes)} vertices fit worse than {_words(before.shapes)} did"
    unsure = before.unsure if new <= LIKELY * old else worse
    return finer._replace(reached=before.reached, others=before.others, unsure=unsure)


def look_again(search: Search, run: Run, coarse: Search | None = None) -> Search:
    """The best of a search and of others from samples of the prior, with how many fit as well.

    There is a third search where the first two differ. All losses count the same points, by the
    outlier scale of the best fit. Ends that lie apart but fit nearly as well are part of the
    standard errors (`others`). A search that leads to the first one's end ends there; one that
    diverges counts as one that ended elsewhere.

    - `coarse`: that on a coarser mesh from which the first came. The others begin there; None: on
      the mesh of the first.
    """
    problems, ends, losses, count, close = search.problems, [search], [0.0], 1, 0
    while count < MOST and close < 2:
        count += 1
        try:
            ends.append(_from_another_start(search, run, coarse, count))
        except Diverged:
            tell(run.progress, f"search {count} diverged")
        losses = _losses(ends, run)
        close = sum(loss <= ALIKE * min(losses) for loss in losses)
    best = ends[int(np.argmin(losses))]
    likely = [end for end, loss in zip(ends, losses, strict=True) if loss <= LIKELY * min(losses)]
    others = tuple(end.theta for end in likely if end is not best)
    unsure = search.unsure if best is search else ""  # of an earlier mesh
    if best is not search:
        to_the_end = run.near(is_intermediate=False).beside(".best.npz")
        best = multi_start(problems, to_the_end, start=best.theta, words="its end")
        ends.append(best)
    alone = f"none of {count - 1} searches from other starts fits as well"
    return best._replace(
        seconds=sum(end.seconds for end in ends),
        others=others,
        reached=(close, count),
        unsure=unsure if close > 1 else alone,
        shapes=search.shapes,
    )


def _from_another_start(search: Search, run: Run, coarse: Search | None, number: int) -> Search:
    """Another search, that of some `number`; the first, with the time of this, where it leads to
    its end."""
    words, seconds = f"search {number}, from another start", 0.0
    start = _sample(search.problems[0].space, jr.fold_in(run.key, number - 1))
    one = {"num_samples": 0, "num_starts": 1, "warm_start": False, "is_intermediate": True}
    again = run._replace(budget=run.budget._replace(**one)).beside(f".search{number}.npz")
    end = run.near(is_intermediate=True).beside(f".search{number}.end.npz")
    steps = [(search, again)] if coarse is None else [(coarse, again), (search, end)]
    for known, own in steps:
        problems, own = known.problems, own._replace(known=known.best)
        found = multi_start(problems, own, start=start, words=words)
        start, seconds = found.theta, seconds + found.seconds
        if leads_to(problems, found.best, known.best):
            return search._replace(seconds=seconds)
    return found._replace(seconds=seconds)


def _sample(space: ParameterSpace, key: PRNGKeyArray) -> Float[Array, " dim"]:
    """A sample of the prior."""
    mean, precision = space.prior()
    normal = jr.normal(key, mean.shape, float)
    place = mean + jnp.linalg.solve(jnp.linalg.cholesky(precision).T, normal)
    return jnp.clip(place, MARGIN, 1 - MARGIN)


def _losses(ends: list[Search], run: Run) -> list[float]:
    """The losses [m^2] of some ends, all by one outlier scale."""
    scale = min((end.best.scale for end in ends), key=float)
    predicted = [run.derive(end.problems, end.theta, run.budget.secant_width) for end in ends]
    return [
        loss_from(end.problems, [prediction for prediction, _ in pairs], scale)
        for end, pairs in zip(ends, predicted, strict=True)
    ]


def weights(alone: Sequence[Descent]) -> list[Float[Array, ""]]:
    """Weight of each recording, from the end of a descent in it alone: one over its mean squared
    distance, [1/m^2], of noise or of what the model cannot follow.

    Markers and a load cell err by tenths of a millimetre, points of a cloud by millimetres. (A step
    of feasible generalized least squares.)
    """
    losses = [max(float(end.normal.loss), FINEST**2) for end in alone]
    return [jnp.asarray(1 / loss, float) for loss in losses]


def _levels(recordings: Recordings) -> list[Shapes]:
    """The meshes to use, from coarse to fine: on each level that of every recording.

    The coarsest is for the weights of several recordings, and for one of a taut sheet. The last
    level has no finer mesh of a taut sheet: it does not fold, and 17 x 17 vertices leave errors of
    1 to 5 % of its force and 0.5 mm of its markers' places (grey interlock, pulled at 0, 45 and 90
    degrees to the warp).
    """
    ladders = []
    for recording in recordings:
        *coarse, finest = resolution.ladder(recording.info.sheet.size)
        ladders.append([*coarse, coarse[-1] if _is_taut(recording) else finest])
    first, *rest = zip(*ladders, strict=True)
    if len(recordings) > 1:
        return [first, *rest]
    return [first, rest[0]] if _is_taut(recordings[0]) else rest


def _is_taut(recording: Recording) -> bool:
    return recording.info.scenario in resolution.TAUT


def is_too_coarse(recordings: Recordings, fabric: Fabric, shapes: Shapes) -> bool:
    """Whether a mesh does not resolve a fabric, in some recording."""
    infos = (recording.info for recording in recordings)
    return any(
        resolution.warning(fabric, info.sheet.size, shape, info.scenario)
        for info, shape in zip(infos, shapes, strict=True)
    )


def _named(recordings: Recordings, shapes: Shapes) -> Shape:
    """The mesh of an estimate: the finest, of a sheet that is not taut where there is one."""
    pairs = zip(recordings, shapes, strict=True)
    loose = [shape for recording, shape in pairs if not _is_taut(recording)]
    return max(loose or shapes, key=max)


def _problems(recordings: Recordings, space: ParameterSpace, shapes: Shapes) -> Problems:
    """The problems of recordings on meshes, in the steps that `in_mesh_steps` gives."""
    problems = []
    for recording, shape in zip(recordings, shapes, strict=True):
        problem = Problem.make(recording, space, shape=shape)
        scenario = in_mesh_steps(problem.scenario, recording.info.scenario, shape)
        if _is_taut(recording) and scenario.turn is None:  # pulls at all angles are one program
            scenario = dataclasses.replace(scenario, turn=jnp.zeros((), float))
        problems.append(dataclasses.replace(problem, scenario=scenario))
    return tuple(problems)


def in_mesh_steps(scenario: Scenario, name: str, shape: Shape) -> Scenario:
    """A scenario of some `name`, on the finest mesh in steps of `FINEST_STEP` at most.

    Not a taut sheet, whose motion does not depend on the step, nor wind, whose error is larger.
    """
    if scenario.wind is not None or name in resolution.TAUT or not _is_finest((shape,)):
        return scenario
    steps = math.ceil(scenario.interval / FINEST_STEP - 1e-9)
    return dataclasses.replace(scenario, substeps=max(scenario.substeps, steps))


def _words(shapes: Shapes) -> str:
    """The finest mesh; of pulls the last one is that of the level before."""
    rows, columns = max(shapes)
    return f"{rows} x {columns}"


def _is_finest(shapes: Shapes) -> bool:
    return max(map(max, shapes)) >= max(resolution.LADDER)


def _others(shapes: Shapes, ratio: float) -> Shapes:
    """Meshes whose cells are `ratio` times as long."""
    pairs = ((max(int((count - 1) / ratio), 1) + 1 for count in shape) for shape in shapes)
    return tuple((rows, columns) for rows, columns in pairs)
