"""From a coarse mesh to one that resolves the fabric that was found.

The search over all of the range is made on the coarsest mesh. Where `r2s.scenarios.resolution`
says that the fabric found there needs a finer one, the descent goes on from it on the next, with
the nuisances that were found.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from jaxtyping import PRNGKeyArray

from r2s.estimation.descent import Search, judged, search
from r2s.estimation.estimate import Estimate
from r2s.estimation.mesh_bias import OtherMesh, factor
from r2s.estimation.method import Budget, Progress
from r2s.estimation.problem import Problem
from r2s.fabrics.parameters import ParameterSpace
from r2s.recordings.recording import Recording
from r2s.scenarios import resolution
from r2s.scenarios.resolution import Shape

Recordings = Sequence[Recording]


def descend_by_meshes(
    recordings: Recordings,
    space: ParameterSpace,
    budget: Budget,
    *,
    shape: Shape | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
    key: PRNGKeyArray,
) -> Estimate:
    """The fabric that explains some recordings, on a mesh of `shape` or on one that resolves it.

    The other arguments are those of `r2s.estimation.descent.descend`; each mesh has a checkpoint.
    Its `mesh_bias` is judged by a mesh whose cells are half as long, or twice as long where that
    would be finer than all of `r2s.scenarios.resolution.LADDER`.
    """

    def climb(shape: Shape, before: Search | None, path: Path | None) -> Search:
        start, more = (None, budget) if before is None else (before.theta, near(budget))
        problems = _problems(recordings, space, shape)
        return search(problems, more, start=start, checkpoint=path, progress=progress, key=key)

    rungs = [shape] if shape else ladder(recordings)
    found = climb(rungs[0], None, checkpoint)
    last = rungs[0]
    for finer in rungs[1:]:
        if not is_too_coarse(recordings, found, last):
            break
        path = checkpoint and checkpoint.with_suffix(f".{finer[0]}x{finer[1]}.npz")
        found, last = climb(finer, found, path), finer
    other = _other_mesh(recordings, space, last)
    return dataclasses.replace(judged(found, budget, other_mesh=other, key=key), shape=last)


def ladder(recordings: Recordings) -> list[Shape]:
    """The meshes to go by, from coarse to fine: those of the largest sheet."""
    return resolution.ladder(max((each.info.sheet.size for each in recordings), key=max))


def is_too_coarse(recordings: Recordings, found: Search, shape: Shape) -> bool:
    """Whether a mesh does not resolve the fabric that was found on it, in some recording."""
    return any(resolution.warning(found.fabric, *_motion(each, shape)) for each in recordings)


def near(budget: Budget) -> Budget:
    """The budget of a descent that begins near its end."""
    return budget._replace(coarse=0, starts=1, shares=())


def _motion(recording: Recording, shape: Shape):
    return recording.info.sheet.size, shape, recording.info.scenario


def _problems(recordings: Recordings, space: ParameterSpace, shape: Shape) -> tuple[Problem, ...]:
    return tuple(Problem.make(each, space, shape=shape) for each in recordings)


def _other_mesh(recordings: Recordings, space: ParameterSpace, shape: Shape) -> OtherMesh:
    """The mesh by which that of `shape` is judged."""
    is_finest = max(shape) >= max(resolution.LADDER)
    rows, columns = (((n - 1) // 2 if is_finest else 2 * (n - 1)) + 1 for n in shape)
    problems = _problems(recordings, space, (rows, columns))
    return OtherMesh(problems, factor(2.0 if is_finest else 0.5))
