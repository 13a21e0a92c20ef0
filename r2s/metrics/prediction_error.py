"""How near a simulated motion comes to a recording: the figures of the results table.

In numpy, for reports; for something to differentiate see `r2s.metrics.losses`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial import KDTree

from r2s.materials.fabric import Fabric
from r2s.mesh.surface import sample
from r2s.metrics.losses import to_surface
from r2s.recordings.recording import Recording, cloud
from r2s.scenarios.scenario import Scenario, SheetSolver, from_recording, rollout

Cloud = Float[np.ndarray, "_ 3"]

ALL_SAMPLES = 9**2 * 128  # of a sheet's surface: about the study's 10,000, on any mesh
METRICS = {  # of `from_surface`, `distances` and `paper_units`: unit, and what they are
    "surface": ("m", "mean distance from a recorded point to the simulated surface"),
    "chamfer_real_to_sim": ("m", "the same to the nearest of many points on it: some 2 mm more"),
    "chamfer_sim_to_real": ("m", "the reverse: large where cameras do not see the sheet"),
    "chamfer": ("m", "the mean of both"),
    "hausdorff": ("m", "the largest distance: that of one outlier, or of a part no camera sees"),
    "paper_chamfer": ("-", "of the study: sum of mean squares, each cloud scaled by its first"),
    "paper_hausdorff": ("-", "of the study: the largest distance, scaled likewise"),
}
UNITS = {name: unit for name, (unit, _) in METRICS.items() if unit != "m"}
FARTHEST, TURN = 0.03, 0.3  # [m] and [rad], of a placement: two deviations of an estimate's prior
OUTLIER = 0.02  # [m], from where on distances pull less
PLACED = 300  # points of a frame, from which a placement is fitted

_rollout = eqx.filter_jit(rollout)  # compiled once for all recordings of as many frames and knots
_sample = eqx.filter_jit(eqx.filter_vmap(sample, in_axes=(0, None, None)))


def distances(real: Cloud, simulated: Cloud) -> dict[str, float]:
    """Distances [m] between two clouds of one frame.

    `chamfer_real_to_sim` and `chamfer_sim_to_real` are mean (not squared) distances to the nearest
    point, `chamfer` is the mean of the two, and `hausdorff` the largest nearest distance of both.
    Raises `ValueError` when a cloud is empty or not finite.

    >>> real, simulated = np.zeros((1, 3)), np.array([[0, 0, 0.01], [0, 0, 0.03]])
    >>> distances(real, simulated)["chamfer_real_to_sim"], distances(real, simulated)["hausdorff"]
    (0.01, 0.03)
    """
    to_simulated, to_real = _nearest(real, simulated)
    one, other = float(np.mean(to_simulated)), float(np.mean(to_real))
    return {
        "chamfer_real_to_sim": one,
        "chamfer_sim_to_real": other,
        "chamfer": (one + other) / 2,
        "hausdorff": float(max(np.max(to_simulated), np.max(to_real))),
    }


def paper_units(
    real: Cloud, simulated: Cloud, first_real: Cloud, first_simulated: Cloud
) -> dict[str, float]:
    """The study's figures for one frame, in its normalised units [-].

    Each cloud is centred on the centroid of its own first frame, divided by the largest radius
    there, and doubled. `paper_chamfer` is the mean squared nearest distance, both directions
    summed; `paper_hausdorff` the largest nearest distance.
    """
    to_simulated, to_real = _nearest(
        _normalised(real, first_real), _normalised(simulated, first_simulated)
    )
    return {
        "paper_chamfer": float(np.mean(to_simulated**2) + np.mean(to_real**2)),
        "paper_hausdorff": float(max(np.max(to_simulated), np.max(to_real))),
    }


def _normalised(cloud: Cloud, first: Cloud) -> Cloud:
    centre = first.mean(axis=0)
    radius = np.max(np.linalg.norm(first - centre, axis=1))
    if not radius > 0:
        raise ValueError("paper units need a first frame of more than one place")
    return 2 * (cloud - centre) / radius


def _nearest(a: Cloud, b: Cloud) -> tuple[np.ndarray, np.ndarray]:
    for name, points in (("first", a), ("second", b)):
        if points.ndim != 2 or points.shape[1] != 3 or not len(points):
            raise ValueError(f"the {name} cloud must be (point, 3), not empty, got {points.shape}")
        if not np.all(np.isfinite(points)):
            raise ValueError(f"the {name} cloud has coordinates that are not finite")
    return KDTree(b).query(a)[0], KDTree(a).query(b)[0]


class Motion(NamedTuple):
    """Positions [m], NaN from where the run diverged, and why it did; "" where it did not.

    `steps`: how it was simulated, in words; "" where unknown.
    """

    x: Float[np.ndarray, "frame vertex 3"]
    failure: str
    steps: str = ""


def predict_motion(scenario: Scenario, fabric: Fabric, solver: SheetSolver | None = None) -> Motion:
    """The motion of a fabric in a scenario; by the cloth unless another solver is given."""
    moved = _rollout(scenario, fabric, solver=solver)
    ok = np.logical_and.accumulate(np.asarray(moved.ok))[:, None, None]
    return Motion(np.where(ok, np.asarray(moved.x), np.nan), moved.explain())


def against_motion(
    recording: Recording,
    x: Float[np.ndarray, "frame vertex 3"],
    every: int = 1,
    crop: bool = True,
    shape: tuple[int, int] = (9, 9),
) -> dict[str, float]:
    """Metrics of a motion against a recording, means over every n-th of the frames that count.

    - `x`: the positions of the motion, [m]. `shape`: its vertices along warp and weft.
    - `crop`: whether to add the metrics that leave out what lies below the recording, see `_frame`.

    All metrics are NaN when the motion diverged in these frames.
    """
    first, last = recording.info.frames_used
    faces = from_recording(recording, shape).scene.mesh.faces
    samples = max(round((ALL_SAMPLES / len(faces)) ** 0.5), 1)
    used = range(first, last + 1, every)
    simulated = np.asarray(_sample(jnp.asarray(x[np.array(used)]), faces, samples))
    return _mean([cloud(recording, frame) for frame in used], list(simulated), crop)


def from_surface(
    recording: Recording, x: Float[np.ndarray, "frame vertex 3"], shape: tuple[int, int] = (9, 9)
) -> Float[np.ndarray, " used"]:
    """Mean distance [m] of a recording's points from a motion's surface in each frame that counts.

    `x`: the positions of the motion, [m]; NaN where it diverged. `shape`: its vertices.
    """
    first, last = recording.info.frames_used
    faces = from_recording(recording, shape).scene.mesh.faces
    clouds = [cloud(recording, frame) for frame in range(first, last + 1)]
    return to_surface(clouds, x[first : last + 1], faces)


def against_recording(recording: Recording, other: Recording) -> dict[str, float]:
    """Metrics of another recording against this one, frame by frame."""
    first, last = recording.info.frames_used
    if len(other.times) <= last:
        raise ValueError(
            f"{other.info.name} has {len(other.times)} frames, {recording.info.name} is judged "
            f"on frames {first} to {last}"
        )
    used = range(first, last + 1)
    return _mean([cloud(recording, f) for f in used], [cloud(other, f) for f in used])


def _mean(
    real: list[np.ndarray], simulated: list[np.ndarray], crop: bool = True
) -> dict[str, float]:
    if not all(np.all(np.isfinite(points)) for points in simulated):
        return dict.fromkeys(_frame(real[0], real[0], real[0], real[0], crop), float("nan"))
    firsts = real[0], simulated[0]
    rows = [_frame(a, b, *firsts, crop) for a, b in zip(real, simulated, strict=True)]
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _frame(real, simulated, first_real, first_simulated, crop: bool) -> dict[str, float]:
    """All metrics of one frame.

    Those that end in `_cropped` leave out what lies below the recording's lowest point: recordings
    are cut off above the table, where a simulation still has a sheet.
    """
    whole = distances(real, simulated)
    metrics = whole | paper_units(real, simulated, first_real, first_simulated)
    if not crop:
        return metrics
    visible = simulated[simulated[:, 2] >= real[:, 2].min()]
    cropped = distances(real, visible) if len(visible) else {}
    return metrics | {f"{name}_cropped": cropped.get(name, float("nan")) for name in whole}


class Placement(NamedTuple):
    """A rigid motion: a `turn` [rad] about the vertical through `pivot` [m], and a `shift` [m]."""

    shift: Float[np.ndarray, "3"]
    turn: float
    pivot: Float[np.ndarray, "3"]


def placed(place: Placement, cloud: Cloud) -> Cloud:
    """A cloud [m] as it would have been recorded from there."""
    cosine, sine = np.cos(place.turn), np.sin(place.turn)
    turn = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    return (cloud - place.pivot) @ turn + place.pivot + place.shift


def best_placement(real: Sequence[Cloud], simulated: Sequence[Cloud], seed: int = 0) -> Placement:
    """The one placement of all frames of a recording that brings it nearest to a motion.

    An unknown calibration can cost as much as a wrong fabric: errors before and after distinguish
    them. `real`, `simulated`: clouds of the frames, [m]; `seed`: of the `PLACED` points that are
    drawn. At most `FARTHEST` [m] along each axis and `TURN` [rad]; distances from recording to
    motion, squared up to `OUTLIER` (soft L1). Raises `ValueError` for another number of frames,
    and for points that are not finite.
    """
    random = np.random.default_rng(seed)
    clouds = [np.asarray(points, float) for points in real]
    frames = [points[random.permutation(len(points))[:PLACED]] for points in clouds]
    trees = [KDTree(points) for points in simulated]
    pivot = np.mean(np.concatenate(frames), axis=0)
    bounds = np.array([FARTHEST, FARTHEST, FARTHEST, TURN])

    def at(share: np.ndarray) -> Placement:
        *shift, turn = share * bounds
        return Placement(np.array(shift), float(turn), pivot)

    def residuals(share: np.ndarray) -> np.ndarray:
        pairs = zip(trees, frames, strict=True)
        return np.concatenate([tree.query(placed(at(share), frame))[0] for tree, frame in pairs])

    start = np.zeros(len(bounds))
    fit = least_squares(residuals, start, bounds=(-1, 1), loss="soft_l1", f_scale=OUTLIER)
    return at(fit.x)
