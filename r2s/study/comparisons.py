"""What pictures of a study are made of: recordings beside what was simulated for them."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from r2s.geometry.mesh import rectangle
from r2s.recordings.recording import cloud
from r2s.study.configuration import ON_CLOTH, as_configuration
from r2s.study.evaluations import EvaluationCell, read_distances, read_motions
from r2s.study.report.motions import MotionComparison
from r2s.study.sources import Source, read
from r2s.study.verdicts import Judged, judged_motion

DRAWN = 13  # vertices a side that pictures have, at most

Group = dict[str, list[EvaluationCell]]


def motion_comparisons(cells: Iterable[EvaluationCell], folder: Path) -> list[MotionComparison]:
    """The first recording of each fabric and scenario with its simulations by all configurations,
    references and defaults that are made, at the frames that count.

    Of several estimates, or draws, the sheet is that of the one in the middle, by its error within
    the horizon. Estimates come first, the default last.
    """
    groups: dict[Source, Group] = defaultdict(lambda: defaultdict(list))
    for cell in cells:
        if not cell.other and cell.is_made(folder):
            groups[cell.recordings[0]][label_of(cell)].append(cell)
    found: dict[tuple[str, str], MotionComparison] = {}
    for source, group in groups.items():
        if (source.fabric, source.scenario) not in found:
            found[source.fabric, source.scenario] = _compared(source, group, folder)
    return list(found.values())


def label_of(cell: EvaluationCell) -> str:
    """What pictures and tables call the fabric that a cell judges."""
    return as_configuration(cell.configuration, cell.baseline).label


def _compared(source: Source, group: Group, folder: Path) -> MotionComparison:
    recording = read(source, folder)
    first, last = recording.info.frames_used
    judged = judged_motion(source, folder)
    rank = {"": 0, ON_CLOTH: 0, "true": 1, "middle": 2, "default": 3}
    ordered = sorted(group.items(), key=lambda each: rank[each[1][0].baseline])
    errors, motions, faces = {}, {}, {}
    for label, cells in ordered:
        runs = np.stack([read_distances(cell, folder)[source.name] for cell in cells])
        chosen = cells[_middle(runs, judged)]
        x = read_motions(chosen, folder)[source.name][first : last + 1]
        errors[label] = runs
        motions[label], shape = _thinned(x, chosen.shape)
        faces[label] = np.asarray(rectangle(recording.info.sheet.size, shape).faces)
    return MotionComparison(
        fabric=source.fabric,
        evaluated_on=source.scenario,
        recording=source.name,
        times=np.asarray(recording.times)[first : last + 1],
        clouds=tuple(cloud(recording, frame) for frame in range(first, last + 1)),
        faces=faces,
        motions=motions,
        errors=errors,
        floor=None if judged is None else judged.floor,
        horizon=None if judged is None else judged.horizon,
    )


def _middle(runs: Float[np.ndarray, "run frame"], judged: Judged | None) -> int:
    """Which run is in the middle by its mean error within the horizon; what diverged is last."""
    if judged is not None and judged.inside.any():
        runs = runs[:, judged.inside]
    means = np.where(np.isfinite(runs), runs, np.inf).mean(axis=1)
    return int(np.argsort(means, kind="stable")[(len(means) - 1) // 2])


def _thinned(
    x: Float[np.ndarray, "frame vertex 3"], shape: Sequence[int]
) -> tuple[Float[np.ndarray, "frame _ 3"], tuple[int, int]]:
    """Every second or further vertex of a sheet of a shape, and the shape that is left."""
    largest = max(shape) - 1
    strides = [n for n in range(1, largest + 1) if all((side - 1) % n == 0 for side in shape)]
    fitting = [n for n in strides if largest // n < DRAWN]
    stride = fitting[0] if fitting else 1
    grid = x.reshape(len(x), *shape, 3)[:, ::stride, ::stride]
    return grid.reshape(len(x), -1, 3), (grid.shape[1], grid.shape[2])
