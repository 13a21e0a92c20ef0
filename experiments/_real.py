"""Real recordings beside what their cameras would have seen of simulated sheets."""

import json
from collections.abc import Iterable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from _tables import Line
from scipy import stats

from r2s._util.files import write_json
from r2s.estimation.estimate import Estimate, as_json, from_json
from r2s.estimation.methods import DiffCloud
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import InformedSpace, ParameterSpace
from r2s.metrics import prediction_error
from r2s.metrics.prediction_error import distances
from r2s.recordings import manifest
from r2s.recordings.recording import Recording, RecordingInfo, gripper_positions, load
from r2s.recordings.views import observed
from r2s.scenarios.scenario import from_recording, resized

SIZE = "size ratio"  # the nuisance that belongs to the fabric
GROUPS = ("own lift", "other trial's lift", "other fabrics' lifts", "fold itself")
Clouds = list[np.ndarray]


def recordings_in(folder: Path, scenario: str) -> list[Recording]:
    """Read the recordings of a scenario that lie in a folder.

    The folder holds NPZ files of r2s, or folders of clouds with a `manifest.json`. Raises
    `ValueError` when it holds none of this scenario.
    """
    files = sorted(folder.glob("*.npz"))
    if files and not (folder / "manifest.json").exists():
        recordings = [
            recording for recording in map(load, files) if recording.info.scenario == scenario
        ]
    else:
        rules = manifest.manifest_for(folder)
        names = manifest.read_recordings(folder, rules, [scenario])
        recordings = [manifest.read_recording(folder, rules, name) for name in names]
    if not recordings:
        raise ValueError(f"{folder}: no recording of {scenario}")
    return recordings


def estimated(
    recording: Recording, space: ParameterSpace, shape: tuple[int, int], kept: Path
) -> Estimate:
    """DIFFCLOUD's estimate from a recording; taken from the folder `kept` when it is there."""
    known = ".prior" if isinstance(space, InformedSpace) else ""
    file = kept / f"{recording.info.name}.{shape[0]}x{shape[1]}{known}.json"
    if file.exists():
        return from_json(json.loads(file.read_text(encoding="utf-8")))
    estimate = DiffCloud(shape=shape).estimate([recording], space, key=jax.random.key(0))
    kept.mkdir(parents=True, exist_ok=True)
    write_json(file, as_json(estimate))
    return estimate


def group_of(fold: RecordingInfo, source: RecordingInfo) -> str:
    """What the recording of an estimate is to a fold; "": another fold, from which none is used."""
    if source.scenario == fold.scenario:
        return "fold itself" if source == fold else ""
    if source.fabric != fold.fabric:
        return "other fabrics' lifts"
    return "own lift" if source.trial == fold.trial else "other trial's lift"


def frames_of(recording: Recording) -> range:
    """The numbers of the frames that count."""
    return range(recording.info.frames_used[0], recording.info.frames_used[1] + 1)


def size_of(estimate: Estimate) -> float:
    """How much longer the sheet is than was written down, as far as an estimate says."""
    return next((each.value for each in estimate.nuisances if each.name == SIZE), 1.0)


def observed_of(
    recording: Recording, fabric: Fabric, shape: tuple[int, int], size: float = 1.0
) -> Clouds | None:
    """What the recording's cameras would have seen of a fabric in the frames that count, [m].

    `size`: of the sheet, relative. Without what the robot hid. None: the simulation diverged.
    """
    scenario, views = from_recording(recording, shape), recording.info.views
    if views is None:
        raise ValueError(f"{recording.info.name}: its manifest says nothing of its cameras")
    moved = prediction_error.predict_motion(resized(scenario, jnp.asarray(size)), fabric)
    used = np.array(frames_of(recording))
    if not np.isfinite(moved.x[used]).all():
        return None
    faces, clouds = np.asarray(scenario.scene.mesh.faces), []
    places = gripper_positions(recording)
    for frame in used:
        points = observed(views, moved.x[frame], faces, frame)
        away = np.linalg.norm(points[:, None] - places[frame], axis=-1).min(axis=1)
        clouds.append(points[away > views.hidden])
    return clouds


def beside(
    fold: Recording,
    made: Iterable[tuple[RecordingInfo, Estimate]],
    samples: list[Fabric],
    shape: tuple[int, int],
) -> dict[str, list[Clouds | None]]:
    """What a fold's cameras would have seen of the estimates and of samples of the prior."""
    clouds: dict[str, list[Clouds | None]] = {name: [] for name in GROUPS}
    for info, estimate in made:
        if group := group_of(fold.info, info):
            clouds[group].append(observed_of(fold, estimate.fabric, shape, size_of(estimate)))
    return clouds | {"prior": [observed_of(fold, fabric, shape) for fabric in samples]}


def errors(real: Clouds, others: list[Clouds | None]) -> tuple[float, float]:
    """Mean distance [mm] both ways, as read and placed; infinite where a simulation diverged."""
    pairs = []
    for other in others:
        if other is None or not all(len(points) for points in other):
            pairs.append((np.inf, np.inf))
            continue
        place = prediction_error.best_placement(real, other)
        moved = [prediction_error.placed(place, points) for points in real]
        pairs.append((_both_ways(real, other), _both_ways(moved, other)))
    as_read, placed = np.mean(pairs, axis=0)
    return float(as_read), float(placed)


def _both_ways(real: Clouds, other: Clouds) -> float:
    pairs = zip(real, other, strict=True)
    return 1e3 * float(np.mean([distances(a, b)["chamfer"] for a, b in pairs]))


def compared(
    table: dict[str, dict[str, float]], fabrics: list[str], one: str, other: str
) -> list[Line]:
    """Whether one column of a table [mm] is below another: mean difference and p by sign flips.

    Of the recordings that have both; no line where none has.

    `table`: the columns of each recording, whose `fabrics` are given. Flipped are the signs of all
    recordings of a fabric together, since they are alike, and of every recording alone.
    """
    pairs = zip(table.values(), fabrics, strict=True)
    both = [(row[one] - row[other], fabric) for row, fabric in pairs if {one, other} <= row.keys()]
    if not both:
        return []
    differences, whose = (np.array(column) for column in zip(*both, strict=True))
    by_fabric = np.array([differences[whose == name].mean() for name in sorted(set(whose))])
    line = {
        "compared": f"{one} less {other}",
        "mean": f"{differences.mean():.1f}",
        "better": f"{int(np.sum(differences < 0))} of {len(differences)}",
        "p of fabrics": f"{_sign_flips(by_fabric):.3f}",
        "p of recordings": f"{_sign_flips(differences):.3f}",
    }
    return [line]


def _sign_flips(differences: np.ndarray) -> float:
    """Two-sided p of the mean of differences that could as well have had the other sign; one alone
    says nothing."""
    if len(differences) < 2:
        return 1.0
    test = stats.permutation_test(
        (differences,), np.mean, permutation_type="samples", n_resamples=10_000
    )
    return float(test.pvalue)
