"""Estimates of density and stiffness from a few measured swings, and predictions of the others.

Errors [mm] are mean distances from the tracked points to where they are predicted. The tracker's
own error is that of the row that the bar holds, whose place is known. "Placed": the predictions are
moved by the offset of the tracker's frame, which the swings of the estimate determine.
"""

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _tables import Line, keep
from jaxtyping import Float

from r2s.estimation.estimate import Estimate
from r2s.estimation.judgement import descend
from r2s.estimation.method import Budget
from r2s.estimation.problem import Problem, default_nuisance_prior
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace
from r2s.recordings.datasets import known_bar
from r2s.recordings.recording import Recording
from r2s.recordings.swings import read_swing
from r2s.scenarios.scenario import from_recording, rollout

LEARNT = ("range030_rep01", "range060_rep04", "range090_rep02", "range120_rep01")
SHAPE = (8, 8)  # vertices, as many as are tracked
SECONDS = 5.0  # of each swing
KNOT = 0.02  # [s], between knots of the path; the arm logs poses every 0.01 to 0.1 s
DENSITY = 1.0  # relative deviation of a density that nobody measured
BUDGET = Budget(num_probes=0, frame_fractions=(0.3,))
CAPTION = "Swings predicted from four others: mean distances [mm]."

_rollout = eqx.filter_jit(rollout)


def predict_swings(
    folder: Path, space: ParameterSpace, samples: Sequence[Fabric], out: Path
) -> None:
    """Estimate from four swings, and write the table of the others."""
    swings = {file.stem: _read(file) for file in sorted(folder.glob("*.npz"))}
    if not set(LEARNT) <= set(swings):
        raise ValueError(f"{folder}: expected the swings {', '.join(LEARNT)}")
    if len(swings) == len(LEARNT):
        raise ValueError(f"{folder}: expected another swing, which those of the estimate predict")
    problems = tuple(_problem(swings.pop(name), space) for name in LEARNT)
    estimate = descend(problems, BUDGET, key=jax.random.key(0))
    offset = np.array([np.mean(_shifts(estimate, axis)) for axis in "xyz"])
    rows: dict[str, dict[str, float]] = {}
    for name, swing in swings.items():
        rows[name] = _row(swing, estimate.fabric, samples, offset)
        means = {key: np.mean([row[key] for row in rows.values()]) for key in rows[name]}
        table = [*rows.items(), ("mean", means)]
        lines = [{"swing": n} | {k: f"{v:.2f}" for k, v in row.items()} for n, row in table]
        keep(out, lines, CAPTION, _facts(estimate))


def _read(file: Path) -> Recording:
    """A swing with as many knots as any of its duration, so that one program serves all."""
    recording = read_swing(file, known_bar(), SECONDS)
    times = np.arange(0, float(recording.times[-1]) + KNOT, KNOT)
    path = np.asarray(recording.gripper_path).reshape(len(recording.gripper_times), -1)
    at = [np.interp(times, np.asarray(recording.gripper_times), column) for column in path.T]
    ends = np.stack(at, axis=1).reshape(-1, *recording.gripper_path.shape[1:])
    knots = (jnp.asarray(ends, float), jnp.asarray(times, float))
    return eqx.tree_at(lambda r: (r.gripper_path, r.gripper_times), recording, knots)


def _problem(recording: Recording, space: ParameterSpace) -> Problem:
    nuisances = default_nuisance_prior(from_recording(recording, SHAPE), recording.info.doubt)
    nuisances = nuisances._replace(density=DENSITY)
    return Problem.make(recording, space, shape=SHAPE, nuisance_prior=nuisances)


def _shifts(estimate: Estimate, axis: str) -> list[float]:
    """Offsets [m] of the tracker's frame against the arm's, of each swing."""
    return [n.value for n in estimate.nuisances if n.name.startswith(f"shift {axis}")]


def _facts(estimate: Estimate) -> Line:
    """Density and the tracker's height above the bar, for the head of the table."""
    ratio = next(n for n in estimate.nuisances if n.name == "density ratio")
    error = ratio.standard_error / ratio.value
    return {
        "density": f"{float(estimate.fabric.density):.3g} kg/m^2, {error:.0%}",
        "tracker above the bar [mm]": ", ".join(f"{1e3 * z:.1f}" for z in _shifts(estimate, "z")),
    }


def _row(
    swing: Recording, fabric: Fabric, samples: Sequence[Fabric], offset: Float[np.ndarray, " 3"]
) -> dict[str, float]:
    """Errors [mm] of the tracker, of the estimate and of the samples, as read and placed."""
    own, others = _gap(swing, fabric), [_gap(swing, sample) for sample in samples]
    row: dict[str, float] = {}
    for how, shift in {"": np.zeros(3), " placed": offset}.items():
        of_rows = _of_rows(own + shift)
        row["tracker" + how], row["estimate" + how] = of_rows[0], of_rows.mean()
        row["prior" + how] = float(np.nanmean([_of_rows(gap + shift) for gap in others]))
        row["estimate / tracker" + how] = row["estimate" + how] / row["tracker" + how]
    return row


def _gap(swing: Recording, fabric: Fabric) -> Float[np.ndarray, "frame column row 3"]:
    """From the tracked points to the predicted ones [m], rows from the bar down.

    NaN where a point was not seen, and everywhere if the simulation diverged.
    """
    moved = _rollout(from_recording(swing, SHAPE), fabric)
    assert swing.markers is not None and swing.markers_seen is not None
    seen = np.asarray(swing.markers_seen) & np.isfinite(moved.x).all()
    gap = np.where(seen[..., None], np.asarray(moved.x) - np.asarray(swing.markers), np.nan)
    return gap.reshape(len(gap), *SHAPE, 3)


def _of_rows(gap: Float[np.ndarray, "frame column row 3"]) -> Float[np.ndarray, " row"]:
    """Mean distance of each row, [mm]."""
    return 1e3 * np.nanmean(np.linalg.norm(gap, axis=-1), axis=(0, 1))
