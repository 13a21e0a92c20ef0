"""What swings say of a fabric, and how far predictions of other swings are from their trackers."""

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from r2s.estimation.estimate import Estimate
from r2s.estimation.judgement import descend
from r2s.estimation.method import Budget
from r2s.estimation.problem import NuisancePrior, Problem, default_nuisance_prior
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import ParameterSpace
from r2s.recordings.datasets import known_bar
from r2s.recordings.readers.swings import read_swing
from r2s.recordings.recording import Recording
from r2s.scenarios.scenario import from_recording, rollout

SHAPE = (8, 8)  # vertices, as many as are tracked
KNOT = 0.02  # [s], between knots of the path; the arm logs poses every 0.01 to 0.1 s
DENSITY = 1.0  # relative deviation of a density that nobody measured
BUDGET = Budget(coarse=24, starts=3, iterations=25, around=0, shares=(0.3,))

_rollout = eqx.filter_jit(rollout)


def swings(folder: Path, names: Sequence[str], duration: float) -> list[Recording]:
    """Some recordings of a folder, or all where no names are given."""
    bar = known_bar()
    files = sorted(folder.glob("*.npz"))
    chosen = [file for file in files if file.stem in names] if names else files
    if not chosen:
        raise ValueError(f"{folder}: no recording of {', '.join(names) or 'any name'}")
    return [_alike(read_swing(file, bar, duration)) for file in chosen]


def _alike(recording: Recording) -> Recording:
    """With as many knots as any of its duration, so that one program serves all of them."""
    end = float(recording.times[-1]) + KNOT
    times = np.arange(0, end, KNOT)
    path = np.asarray(recording.handle_path).reshape(len(recording.handle_times), -1)
    at = [np.interp(times, np.asarray(recording.handle_times), column) for column in path.T]
    ends = np.stack(at, axis=1).reshape(-1, *recording.handle_path.shape[1:])
    knots = (jnp.asarray(ends, float), jnp.asarray(times, float))
    return eqx.tree_at(lambda r: (r.handle_path, r.handle_times), recording, knots)


def estimated(recordings: Sequence[Recording], space: ParameterSpace) -> Estimate:
    """The fabric of some swings, its density in doubt by `DENSITY`; the air is taken as known."""
    problems = tuple(_problem(each, space) for each in recordings)
    return descend(problems, BUDGET, key=jax.random.key(0))


def _problem(recording: Recording, space: ParameterSpace) -> Problem:
    scenario = from_recording(recording, SHAPE)
    prior: NuisancePrior = default_nuisance_prior(scenario, recording.info.doubt)
    return Problem.make(
        recording, space, shape=SHAPE, nuisance_prior=prior._replace(density=DENSITY)
    )


def learnt_offset(found: Estimate) -> Float[np.ndarray, " 3"]:
    """Where the tracker's frame lies against the arm's, [m]: the mean over the swings learnt."""
    told = {
        axis: [n.value for n in found.nuisances if n.name.startswith(f"shift {axis}")]
        for axis in "xyz"
    }
    return np.array([np.mean(values) for values in told.values()])


def facts(found: Estimate) -> dict[str, str]:
    """What the swings learnt tell, for the head of a table."""
    shifts = ", ".join(f"{1e3 * n.value:.1f}" for n in found.nuisances if "shift z" in n.name)
    ratio = next(n for n in found.nuisances if n.name == "density ratio")
    density = f"{float(found.fabric.density):.3g} kg/m^2, {ratio.standard_error / ratio.value:.0%}"
    return {"density": density, "tracker above the bar [mm]": shifts}


def errors(
    recording: Recording, fabric: Fabric, offset: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "2 row"]:
    """Mean distance [m] from the tracked points to where a fabric predicts them, row by row from
    the bar down, in the arm's frame and in one that is shifted by an offset [m]; the first row is
    the bar's own. NaN: the simulation diverged."""
    moved = _rollout(from_recording(recording, SHAPE), fabric)
    if not np.isfinite(moved.x).all():
        return np.full((2, SHAPE[1]), np.nan)
    assert recording.markers is not None and recording.markers_seen is not None
    gap = np.asarray(moved.x) - np.asarray(recording.markers)
    seen = np.asarray(recording.markers_seen)
    found = []
    for shift in (np.zeros(3), offset):
        away = np.where(seen, np.linalg.norm(gap + shift, axis=-1), np.nan)
        found.append(np.nanmean(away.reshape(-1, *SHAPE), axis=(0, 1)))
    return np.stack(found)
