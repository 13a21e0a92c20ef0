"""From a mesh to one that resolves the fabric that was found.

The search is made on the mesh before the finest, of several recordings from what the coarsest led
to. Where `r2s.scenarios.resolution` says that the fabric found there needs the finest, the descent
goes on from it there, with the nuisances that were found.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from r2s._util.threads import background
from r2s.compilation import is_kept
from r2s.estimation.compiled import Derive, prepare, remembering
from r2s.estimation.descent import Search, search
from r2s.estimation.estimate import Estimate
from r2s.estimation.gauss_newton import FINEST, Descent, Problems
from r2s.estimation.judgement import each_alone, judged
from r2s.estimation.mesh_bias import OtherMesh, factor
from r2s.estimation.method import Budget, Progress, tell
from r2s.estimation.prediction import Theta
from r2s.estimation.problem import Problem
from r2s.estimation.second_look import LIKELY, look_again
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

    Of several recordings each counts by how well it can be followed alone on the coarsest mesh
    (`weights`), from the end of a search in which all frames count alike.

    `finest`: from the first mesh straight to the finest of `r2s.scenarios.resolution.LADDER`,
    whichever fabric is found; not with a `shape`.

    The other arguments are those of `r2s.estimation.judgement.descend`; each mesh has a checkpoint.
    Where a mesh is too coarse, but on the finer one all diverges, the estimate is that of the end
    on the coarser mesh, and `refused` says why (with `finest` it is an error).

    The `shape` of the estimate is the finest, of a sheet that is not taut where there is one.
    Its `mesh_bias` is judged by a mesh whose cells are half as long, or twice as long where that
    would be finer than all of `r2s.scenarios.resolution.LADDER`, or diverged.
    """
    rungs = [[shape] * len(recordings)] if shape else _rungs(recordings)
    if finest:
        rungs = [rungs[0], rungs[-1]]
    on = functools.cache(partial(_problems, recordings, space))
    on(tuple(rungs[0]))  # which both threads would make, else
    run = _Run(recordings, on, budget, remembering(), checkpoint, progress, key)
    with background(_programs(run, rungs, finest) if is_kept() else ()):
        run, at = _first(run, rungs[0], leads_on=len(rungs) > 1)
        at, refused = _refined(run, at, rungs[1:], finest)
        tell(progress, "standard errors")
        ratio = 2.0 if refused else _ratio(at.shapes)
        estimate = judged(
            at.found,
            budget,
            other_mesh=OtherMesh(run.problems(_others(at.shapes, ratio)), factor(ratio)),
            checkpoint=checkpoint,
            progress=progress,
            key=key,
        )
    return dataclasses.replace(estimate, shape=_told(recordings, at.shapes), refused=refused)


class _Rung(NamedTuple):
    """What was found on the meshes of some shapes, one for each recording."""

    shapes: list[Shape]
    found: Search

    @property
    def fabric(self) -> tuple[Fabric, list[Shape]]:
        """The fabric that was found, and on which meshes."""
        return self.found.fabric, self.shapes


class _Run(NamedTuple):
    """What all searches of an estimate by meshes share.

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
        return _weighed(found, self.weights) if self.weights else found


def _programs(run: _Run, rungs: list[list[Shape]], finest: bool) -> Iterator[Callable[[], None]]:
    """Compilations in the order in which the estimate will most likely need them."""
    likely = rungs if finest else rungs[: 2 if len(run.recordings) > 1 else 1]
    others, width = _others(likely[-1], _ratio(likely[-1])), run.budget.width
    for shapes in likely:
        yield lambda shapes=shapes: prepare(run.problems(shapes), width)
    yield lambda: prepare(run.problems(others), derivatives=False)
    if finest:  # else that of the rung before
        yield lambda: prepare(run.problems(others), width)


def _first(run: _Run, shapes: list[Shape], leads_on: bool) -> tuple[_Run, _Rung]:
    """The search on the first meshes; of several recordings a second one, by their weights."""
    at = _searched(run, shapes, None, leads_on)
    if len(run.recordings) == 1:
        return run, at
    theta = at.found.theta
    alone = each_alone(at.found.problems, run.budget, theta, run.key, run.derive, run.progress)
    run = run._replace(weights=weights(alone))
    return run, _searched(run, shapes, theta, leads_on)


def _refined(run: _Run, at: _Rung, finer: list[list[Shape]], finest: bool) -> tuple[_Rung, str]:
    """The end on the meshes that resolve the fabric, and why finer ones were refused, or ""."""
    if not finer:
        return _looked_again(run, at), ""
    for shapes in finer:
        is_last = shapes is finer[-1]
        if is_last and not finest:
            at = _at_its_end(run, at)
            if not is_too_coarse(run.recordings, *at.fabric):
                break
        try:
            at = _gone_on(at, _searched(run, shapes, at.found.theta, leads_on=not is_last))
        except RuntimeError as error:
            if finest or isinstance(error, jax.errors.JaxRuntimeError):  # out of memory, say
                raise
            tell(run.progress, f"the finer mesh diverged: back to {_named(max(at.shapes))}")
            refused = f"{_named(max(shapes))} vertices, which it needs: {error}"
            return at if is_last else _at_its_end(run, at), refused
    return at, ""


def _searched(run: _Run, shapes: list[Shape], start: Theta | None, leads_on: bool) -> _Rung:
    """A search on some meshes, near a `start` where there is one."""
    budget, path = run.budget, run.checkpoint
    name = _named(max(shapes))  # a pull's is that of the rung before on the last one
    if start is not None:
        budget = near(budget)
        short = name.replace(" ", "")
        path = path and path.with_suffix(f".{short}{'' if leads_on else '.end'}.npz")
    found = search(
        run.problems(shapes),
        budget._replace(leads_on=leads_on),
        start=start,
        checkpoint=path,
        progress=run.progress,
        derive=run.derive,
        words=f"descents on {name} vertices",
        key=run.key,
    )
    return _Rung(shapes, found)


def _at_its_end(run: _Run, at: _Rung) -> _Rung:
    """A rung at its end, where it may be softer, and after another look from elsewhere."""
    return _looked_again(run, _searched(run, at.shapes, at.found.theta, leads_on=False))


def _looked_again(run: _Run, at: _Rung) -> _Rung:
    found = look_again(at.found, run.budget, progress=run.progress, key=run.key)
    return at._replace(found=found)


def descend_weighed(
    problems: Problems,
    budget: Budget,
    *,
    approach: str,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """`r2s.estimation.judgement.descend` on the meshes that the problems have; of several
    recordings each counts by how well it can be followed alone (`weights`)."""
    found = search(problems, budget, checkpoint=checkpoint, progress=progress, key=key)
    if len(problems) > 1:
        alone = each_alone(problems, budget, found.theta, key, found.derive, progress)
        found = search(
            _weighed(problems, weights(alone)),
            near(budget),
            start=found.theta,
            checkpoint=checkpoint and checkpoint.with_suffix(".weighed.npz"),
            progress=progress,
            derive=found.derive,
            key=key,
        )
    return judged(
        found, budget, approach=approach, checkpoint=checkpoint, progress=progress, key=key
    )


def _gone_on(at: _Rung, finer: _Rung) -> _Rung:
    """A finer rung with what was said of the one before, and whether it fits worse than that: then
    the search ended in another minimum there."""
    found, before = finer.found, at.found
    less = float(found.best.normal.loss) <= LIKELY * float(before.best.normal.loss)
    worse = f"{_named(max(finer.shapes))} vertices fit worse than {_named(max(at.shapes))} did"
    unsure = before.unsure if less else worse
    return finer._replace(found=found._replace(reached=before.reached, unsure=unsure))


def weights(alone: Sequence[Descent]) -> list[Float[Array, ""]]:
    """Of each recording, from the end of a descent in it alone: one over the squared distances that
    are left, [1/m^2], of noise or of what the model cannot follow.

    Markers and a load cell err by tenths of a millimetre where points of a cloud err by
    millimetres, and a lift that buckles elsewhere by more: weighed alike, a lift would outweigh
    what pulls tell of the membrane. (A step of feasible generalized least squares.)
    """
    left = [max(float(end.normal.loss), FINEST**2) for end in alone]
    return [jnp.asarray(1 / each, float) for each in left]


def _weighed(problems: Problems, counts: Sequence[Float[Array, ""]]) -> tuple[Problem, ...]:
    pairs = zip(problems, counts, strict=True)
    return tuple(dataclasses.replace(each, weight=count) for each, count in pairs)


def ladder(recordings: Recordings) -> list[list[Shape]]:
    """The meshes to go by, from coarse to fine: on each rung that of every recording.

    The last rung has no finer mesh of a stretching than the one before: a taut sheet does not fold.
    17 x 17 vertices leave 1 to 5 % of its force and 0.5 mm of its markers' places (grey interlock,
    pulled at 0, 45 and 90 degrees to the warp), and the mesh bias of an estimate holds that.
    """
    return [list(rung) for rung in zip(*map(_meshes, recordings), strict=True)]


def _rungs(recordings: Recordings) -> list[list[Shape]]:
    """The part of the ladder that is climbed.

    The coarsest is for the weights of several recordings, and for one of a taut sheet. What it
    finds of another is far off (25 x 33 vertices of MuJoCo's sheet, found on 7 x 9: shear 0.15
    times, damping 16 times the truth).
    """
    first, *rest = ladder(recordings)
    if len(recordings) > 1:
        return [first, *rest]
    return [first, rest[0]] if _is_taut(recordings[0]) else rest


def is_too_coarse(recordings: Recordings, fabric: Fabric, shapes: Sequence[Shape]) -> bool:
    """Whether a mesh does not resolve a fabric, in some recording."""
    pairs = zip(recordings, shapes, strict=True)
    return any(resolution.warning(fabric, *_motion(each, shape)) for each, shape in pairs)


def near(budget: Budget) -> Budget:
    """The budget of a descent that begins near its end."""
    return budget._replace(coarse=0, starts=1, shares=(), near=True)


def _motion(recording: Recording, shape: Shape):
    return recording.info.sheet.size, shape, recording.info.scenario


def _meshes(recording: Recording) -> list[Shape]:
    *coarse, finest = resolution.ladder(recording.info.sheet.size)
    return [*coarse, coarse[-1] if _is_taut(recording) else finest]


def _is_taut(recording: Recording) -> bool:
    return recording.info.scenario in resolution.TAUT


def _told(recordings: Recordings, shapes: Sequence[Shape]) -> Shape:
    """The mesh by which an estimate is named: a taut sheet's says little of how the others fold."""
    pairs = zip(recordings, shapes, strict=True)
    loose = [shape for each, shape in pairs if not _is_taut(each)]
    return max(loose or shapes, key=max)


def _problems(
    recordings: Recordings, space: ParameterSpace, shapes: Sequence[Shape]
) -> tuple[Problem, ...]:
    return tuple(
        _problem(each, space, shape) for each, shape in zip(recordings, shapes, strict=True)
    )


def _problem(recording: Recording, space: ParameterSpace, shape: Shape) -> Problem:
    """The problem of a recording on a mesh, in the steps that it is worth."""
    problem = Problem.make(recording, space, shape=shape)
    scenario = in_steps_worth(problem.scenario, recording.info.scenario, shape)
    return dataclasses.replace(problem, scenario=scenario)


def in_steps_worth(scenario: Scenario, name: str, shape: Shape) -> Scenario:
    """A scenario of some `name` in the steps that a mesh of `shape` is worth: those that it has,
    or, on the finest mesh, of `FINEST_STEP` at most.

    A taut sheet moves alike in longer ones, and wind leaves more than they do.
    """
    if scenario.wind is not None or name in resolution.TAUT or not _is_finest([shape]):
        return scenario
    steps = math.ceil(scenario.interval / FINEST_STEP - 1e-9)
    return dataclasses.replace(scenario, substeps=max(scenario.substeps, steps))


def _named(shape: Shape) -> str:
    return f"{shape[0]} x {shape[1]}"


def _is_finest(shapes: Sequence[Shape]) -> bool:
    return max(map(max, shapes)) >= max(resolution.LADDER)


def _ratio(shapes: Sequence[Shape]) -> float:
    """How long the cells are of the meshes by which those of `shapes` are judged, over theirs."""
    return 2.0 if _is_finest(shapes) else 0.5


def _others(shapes: Sequence[Shape], ratio: float) -> list[Shape]:
    """Meshes whose cells are `ratio` times as long."""

    def other(count: int) -> int:
        return max(int((count - 1) / ratio), 1) + 1

    return [(other(rows), other(columns)) for rows, columns in shapes]
