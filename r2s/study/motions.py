"""Judged recordings beside the motions that were simulated for them: what pictures are made of."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer

from r2s.mesh.mesh import rectangle
from r2s.metrics.horizon import within
from r2s.recordings.recording import cloud
from r2s.study.configuration import MOTIONS, ON_CLOTH, as_configuration, is_reference
from r2s.study.evaluations import EvaluationCell, read_distances, read_motions
from r2s.study.sources import Source, read
from r2s.study.verdicts import Judged, judged_motion

DRAWN = 13  # vertices a side that pictures have, at most

Group = dict[str, list[EvaluationCell]]


class Motion(NamedTuple):
    """A recording with the motions that were simulated for it, at the frames that count.

    - `times`: of the frames, [s]. `clouds`: the points of each frame, [m].
    - `faces`: the triangles of each configuration's sheet, by its label.
    - `vertices`: of each configuration, [m]; not finite where it diverged. Of several runs
      (estimates, or draws of the default) one.
    - `errors`: the distances of the points from the sheets of all runs, [m].
    - `floor`: the accuracy of the recording, [m]. `horizon`: until when it tells fabrics apart,
      [s]. None: not known.
    """

    fabric: str
    evaluated_on: str
    recording: str
    times: Float[np.ndarray, " frame"]
    clouds: Sequence[Float[np.ndarray, "_ 3"]]
    faces: Mapping[str, Integer[np.ndarray, "face 3"]]
    vertices: Mapping[str, Float[np.ndarray, "frame vertex 3"]]
    errors: Mapping[str, Float[np.ndarray, "run frame"]]
    floor: Float[np.ndarray, " frame"] | None = None
    horizon: float | None = None

    @property
    def inside(self) -> Bool[np.ndarray, " frame"]:
        """Which frames are before the horizon; all, where none is known."""
        return within(self.times, np.inf if self.horizon is None else self.horizon)

    @property
    def mean_errors(self) -> dict[str, Float[np.ndarray, " frame"]]:
        """The mean over runs, [m]; infinite where one of them has diverged."""
        return {
            label: np.where(np.isfinite(runs), runs, np.inf).mean(axis=0)
            for label, runs in self.errors.items()
        }


def judged_recordings(cells: Iterable[EvaluationCell], folder: Path) -> list[Motion]:
    """The first recording of each fabric and motion with its simulations by all configurations,
    references and defaults that are made, in the order of `MOTIONS`.

    Of several estimates, or draws, the sheet is that of the one with the median error within the
    horizon. Estimates come first, the default last.
    """
    groups: dict[Source, Group] = defaultdict(lambda: defaultdict(list))
    for cell in cells:
        if not cell.other and cell.is_made(folder):
            label = as_configuration(cell.configuration, cell.baseline).label
            groups[cell.recordings[0]][label].append(cell)
    found: dict[tuple[str, str], Motion] = {}
    for source, group in groups.items():
        if (source.fabric, source.scenario) not in found:
            found[source.fabric, source.scenario] = _motion(source, group, folder)
    order = {motion: i for i, motion in enumerate(MOTIONS)}
    return sorted(found.values(), key=lambda each: order.get(each.evaluated_on, len(order)))


def _motion(source: Source, group: Group, folder: Path) -> Motion:
    recording = read(source, folder)
    first, last = recording.info.frames_used
    judged = judged_motion(source, folder)
    rank = {"": 0, ON_CLOTH: 0, "true": 1, "middle": 2, "default": 3}
    ordered = sorted(group.items(), key=lambda each: rank[each[1][0].baseline])
    errors, vertices, faces = {}, {}, {}
    for label, cells in ordered:
        runs = np.stack([read_distances(cell, folder)[source.name] for cell in cells])
        chosen = cells[median_run(runs, judged)]
        x = read_motions(chosen, folder)[source.name][first : last + 1]
        errors[label] = runs
        vertices[label], shape = thinned(x, chosen.shape)
        faces[label] = np.asarray(rectangle(recording.info.sheet.size, shape).faces)
    return Motion(
        fabric=source.fabric,
        evaluated_on=source.scenario,
        recording=source.name,
        times=np.asarray(recording.times)[first : last + 1],
        clouds=tuple(cloud(recording, frame) for frame in range(first, last + 1)),
        faces=faces,
        vertices=vertices,
        errors=errors,
        floor=None if judged is None else judged.floor,
        horizon=None if judged is None else judged.horizon,
    )


def median_run(runs: Float[np.ndarray, "run frame"], judged: Judged | None) -> int:
    """Which run has the median mean error within the horizon; what diverged is last."""
    if judged is not None and judged.inside.any():
        runs = runs[:, judged.inside]
    means = np.where(np.isfinite(runs), runs, np.inf).mean(axis=1)
    return int(np.argsort(means, kind="stable")[(len(means) - 1) // 2])


def thinned(
    x: Float[np.ndarray, "frame vertex 3"], shape: Sequence[int]
) -> tuple[Float[np.ndarray, "frame _ 3"], tuple[int, int]]:
    """Every second or further vertex of a sheet of a shape, and the shape that is left."""
    largest = max(shape) - 1
    strides = [n for n in range(1, largest + 1) if all((side - 1) % n == 0 for side in shape)]
    stride = next((n for n in strides if largest // n < DRAWN), 1)
    grid = x.reshape(len(x), *shape, 3)[:, ::stride, ::stride]
    return grid.reshape(len(x), -1, 3), (grid.shape[1], grid.shape[2])


def deciding_frame(motion: Motion) -> int:
    """The frame before the horizon at which what is compared is farthest apart in error.

    Those are the configurations, where there are two or more, else all that there is. What has
    diverged does not count, nor do clouds with less than half of the points of the largest. The
    first frame where none is left.
    """
    counts = np.array([len(cloud) for cloud in motion.clouds])
    allowed = motion.inside & (2 * counts >= counts.max())
    every = motion.mean_errors
    estimates = [label for label in every if not is_reference(label)]
    rivals = np.array([every[label] for label in (estimates if len(estimates) > 1 else every)])
    largest = np.where(np.isfinite(rivals), rivals, -np.inf).max(axis=0)
    apart = largest - rivals.min(axis=0) if len(rivals) > 1 else largest
    return int(np.argmax(np.where(allowed & np.isfinite(apart), apart, -1.0)))
