"""Motions that are judged, and how far from them fabrics move."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from r2s.evaluation.prediction_error import from_surface
from r2s.fabrics.fabric import Fabric
from r2s.recordings.recording import Recording
from r2s.study import engine, verdicts
from r2s.study.cells import Cell
from r2s.study.ensembles import ensemble_of
from r2s.study.evaluations import predict
from r2s.study.sources import SyntheticRecording, read, read_start


class JudgedMotion(NamedTuple):
    """A recording, the sheet's shape [m] where it begins, and what its ensemble says of it."""

    recording: Recording
    start: Float[np.ndarray, "row column 3"] | None
    verdict: verdicts.Judged


def judged(sources: Sequence[SyntheticRecording], folder: Path) -> list[JudgedMotion]:
    """Recordings as motions that are judged; what is missing in the folder is made."""
    make([ensemble_of(each) for each in sources], folder)
    found = []
    for source in sources:
        verdict = verdicts.judged_motion(source, folder)
        assert verdict is not None, source.name
        found.append(JudgedMotion(read(source, folder), read_start(source, folder), verdict))
    return found


def floor_of(motion: JudgedMotion) -> float:
    """How well its truth is known, mean up to the horizon, [mm]."""
    return 1e3 * float(np.mean(motion.verdict.floor[motion.verdict.inside]))


def error_of(motion: JudgedMotion, fabric: Fabric, solver: str, shape: tuple[int, int]) -> float:
    """Mean distance [mm] of the recorded points from what a fabric does, up to the horizon."""
    (moved,) = predict([motion.recording], fabric, solver, [motion.start], shape)
    distances = from_surface(motion.recording, moved.x, shape)
    return 1e3 * float(np.mean(distances[motion.verdict.inside]))


def make(cells: Sequence[Cell], folder: Path) -> None:
    """Make cells, or say what failed first."""
    if failed := engine.run(cells, folder, engine.Serial()):
        raise RuntimeError(f"{next(iter(failed.values()))}")
