"""How well a fabric predicts a recorded motion: the figures of the results table."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from r2s.materials.fabric import Fabric
from r2s.mesh.surface import sample
from r2s.metrics.distances import distances, paper_units
from r2s.metrics.surface_distance import to_surface
from r2s.recordings.recording import Recording, cloud
from r2s.scenarios.scenario import Scenario, SheetSolver, from_recording, rollout

SAMPLES = 9  # squared, on each face: 10,368 points on 128 faces, the study's 10,000
ALL_SAMPLES = SAMPLES**2 * 128  # about as many on any mesh
UNITS = {"paper_chamfer": "-", "paper_hausdorff": "-"}  # all others are in metres

_rollout = eqx.filter_jit(rollout)  # compiled once for all recordings of as many frames and knots
_sample = eqx.filter_jit(eqx.filter_vmap(sample, in_axes=(0, None, None)))


class Motion(NamedTuple):
    """Positions [m], NaN from where the run diverged, and why it did; "" where it did not.

    `steps`: how it was simulated, in words; "" where that is not told.
    """

    x: Float[np.ndarray, "frame vertex 3"]
    failure: str
    steps: str = ""


def predict(recording: Recording, fabric: Fabric) -> Float[np.ndarray, "frame vertex 3"]:
    """Positions [m] of a fabric in the motion of a recording; NaN from where it diverged."""
    return predict_motion(from_recording(recording), fabric).x


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
    """Metrics of a motion against a recording, means over the frames that count.

    - `x`: the positions of the motion, [m]. `shape`: its vertices along warp and weft.
    - `every`: 1 compares all frames that count, 3 every third.
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
    found = whole | paper_units(real, simulated, first_real, first_simulated)
    if not crop:
        return found
    visible = simulated[simulated[:, 2] >= real[:, 2].min()]
    cropped = distances(real, visible) if len(visible) else {}
    return found | {f"{name}_cropped": cropped.get(name, float("nan")) for name in whole}
