"""What several experiments share: recordings of a folder or of a known fabric, and their points."""

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from r2s import scenarios
from r2s.estimation.estimate import Estimate
from r2s.estimation.gauss_newton import loss_at, theta_length
from r2s.estimation.problem import Problem
from r2s.evaluation import prediction_error
from r2s.fabrics import presets
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import OrthotropicSpace, ParameterSpace
from r2s.geometry.surface import sample
from r2s.recordings import manifest
from r2s.recordings.recording import Recording, cloud, load
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import from_recording


def recordings_in(folder: Path, *scenarios: str) -> list[Recording]:
    """Read the recordings of some scenarios (all, when none is named) that lie in a folder.

    The folder holds NPZ files of r2s, or folders of clouds with a `manifest.json`. Raises
    `ValueError` when it holds none of these scenarios.
    """
    files = sorted(folder.glob("*.npz"))
    if files and not (folder / "manifest.json").exists():
        found = [r for r in map(load, files) if not scenarios or r.info.scenario in scenarios]
    else:
        rules = manifest.manifest_for(folder)
        names = manifest.read_recordings(folder, rules, scenarios or tuple(rules.scenarios))
        found = [manifest.read_recording(folder, rules, name) for name in names]
    if not found:
        raise ValueError(f"{folder}: no recording of {', '.join(scenarios) or 'any scenario'}")
    return found


def synthetic_problem(
    preset: str, scenario: str, seed: int = 0
) -> tuple[Fabric, ParameterSpace, Problem]:
    """A preset, the space of its density, and its synthetic recording as an estimator sees it."""
    truth, key = presets.FIVE[preset](), jax.random.key(seed)
    recording = synthetic.record(scenarios.SIX[scenario](), truth, preset, key=key)
    space = OrthotropicSpace.make(float(truth.density))
    return truth, space, Problem.make(recording, space, seed=seed)


def relative_errors(space: ParameterSpace, truth: Fabric, values: np.ndarray) -> np.ndarray:
    """Errors of parameters: relative where the range is logarithmic, else absolute."""
    true = np.asarray(space.values(space.to_unit(truth)))
    logarithmic = np.array([bound.log for bound in space.ranges])
    return (np.asarray(values) - true) / np.where(logarithmic, true, 1.0)


def by_fabric(recordings: Sequence[Recording]) -> dict[str, list[Recording]]:
    """The recordings of each fabric."""
    found: dict[str, list[Recording]] = {}
    for recording in recordings:
        found.setdefault(recording.info.fabric, []).append(recording)
    return found


def values_of(found: Estimate) -> dict[str, str]:
    """An estimate as a line of a table: values with standard errors, and whether it converged.

    Values that are not identifiable are in brackets. Standard errors are relative where the range
    of the parameter is logarithmic.
    """
    line = {}
    numbers = zip(
        found.ranges, found.values, found.standard_errors, found.identifiable, strict=True
    )
    for bound, value, error, known in numbers:
        text = f"{value:.4g}" + (
            "" if np.isnan(error) else f" ± {error:.1%}" if bound.log else f" ± {error:.2g}"
        )
        line[f"{bound.name} [{bound.unit}]"] = text if known else f"({text})"
    return line | {"converged": "yes" if found.converged else "no"}


def fitted_to_truth(space: ParameterSpace, truth: Fabric, found: Estimate) -> dict[str, str]:
    """An estimate beside the truth as a line of a table, as `values_of`.

    Parameters on a logarithmic scale are divided by the truth, of others the truth is subtracted.
    """
    line, true = {}, np.asarray(space.values(space.to_unit(truth)))
    numbers = zip(
        found.ranges, true, found.values, found.standard_errors, found.identifiable, strict=True
    )
    for bound, expected, value, error, known in numbers:
        text = f"{value / expected:.3f}" if bound.log else f"{value - expected:+.3f}"
        text += f" ± {error:.3f}"
        line[bound.name] = text if known else f"({text})"
    if found.mesh_bias is not None:
        names = [bound.name for bound in found.ranges]
        line |= {
            f"mesh: {name}": f"{bias:.3f}"
            for name, bias in zip(names, found.mesh_bias, strict=True)
        }
    return line | {"converged": "yes" if found.converged else "no"}


def loss_of(
    recording: Recording, space: ParameterSpace, fabric: Fabric, shape: tuple[int, int]
) -> float:
    """The loss [m^2] of a fabric on a mesh."""
    problems = (Problem.make(recording, space, shape=shape),)
    theta = jnp.zeros(theta_length(problems), float).at[: space.dim].set(space.to_unit(fabric))
    return float(eqx.filter_jit(loss_at)(problems, theta))


def frames_of(recording: Recording) -> range:
    """The numbers of the frames that count."""
    return range(recording.info.frames_used[0], recording.info.frames_used[1] + 1)


def recorded_points(recording: Recording, frames: range) -> list[np.ndarray]:
    """The clouds [m] of some frames."""
    return [cloud(recording, frame) for frame in frames]


def simulated_points(recording: Recording, fabric: Fabric) -> list[np.ndarray]:
    """Points [m] of the surface of a fabric that moves as in a recording, in frames that count."""
    x = prediction_error.predict(recording, fabric)
    faces = from_recording(recording).scene.mesh.faces
    at = jax.vmap(lambda x: sample(x, faces, prediction_error.SAMPLES))
    return list(np.asarray(at(jnp.asarray(x[np.array(frames_of(recording))]))))
