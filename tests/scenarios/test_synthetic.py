"""Synthetic recordings: what the cameras see."""

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from scipy.spatial import KDTree

from r2s import scenarios
from r2s.materials import presets
from r2s.mesh.surface import sample
from r2s.recordings.cameras import Camera
from r2s.recordings.recording import cloud
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import from_recording, rollout


def test_a_camera_sees_the_nearer_of_two_sheets():
    plane = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 40), np.linspace(-0.1, 0.1, 40)), -1)
    near = np.concatenate([plane.reshape(-1, 2), np.full((1600, 1), 0.5)], axis=1)
    far = near - [0, 0, 0.2]
    camera = Camera(jnp.array([0.0, -0.01, 1.5]), jnp.array([0.0, 0.0, 0.0]))
    seen = np.asarray(camera.sees(jnp.asarray(np.concatenate([near, far]))))
    assert seen[:1600].mean() > 0.99
    assert seen[1600:].mean() < 0.1  # but for the far sheet's edge


@pytest.fixture(scope="module")
def recording():
    return synthetic.record(scenarios.lifting(), presets.grey_interlock(), "grey", key=jr.key(0))


@pytest.mark.slow(group="motions")
def test_the_cloud_lies_on_the_sheet_but_for_noise_and_outliers(recording):
    moved = rollout(from_recording(recording), presets.grey_interlock())
    assert bool(jnp.all(moved.ok))
    faces = from_recording(recording).scene.mesh.faces
    surface = np.asarray(sample(moved.x[45], faces, 12))
    distance = KDTree(surface).query(cloud(recording, 45))[0]
    stray = np.mean(distance > 0.01)
    assert 0.002 < stray < 0.02  # one point in a hundred is an outlier
    # 3-D noise of 1 mm, of which the surface takes up what lies along it
    assert 0.5e-3 < np.median(distance) < 2.5e-3
    hidden = KDTree(cloud(recording, 45)).query(surface)[0] > 0.02
    assert 0.05 < hidden.mean() < 0.95


SHAPE = (5, 5)


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize("kind", ["cloth", "mpm"])
@pytest.mark.parametrize("name", scenarios.SCENARIOS)
def test_every_scenario_is_recorded_by_either_solver(name, kind):
    """On another mesh and with smaller steps than the estimators' own."""
    solver = scenarios.mpm_cloth if kind == "mpm" else None
    finer = {"shape": (13, 13), "max_step": 1 / 90, "solver": solver}
    record = synthetic.record(
        scenarios.SCENARIOS[name](), presets.black_denim(), "denim", **finer, key=jr.key(0)
    )
    assert len(record.times) == 60
    x = np.asarray(rollout(from_recording(record), presets.black_denim()).x)
    faces = from_recording(record).scene.mesh.faces
    distance = KDTree(np.asarray(sample(jnp.asarray(x[-1]), faces, 12))).query(cloud(record, 59))[0]
    # two models of one fabric; where it is laid on itself, one of them lets it pass through
    assert np.median(distance) < (0.05 if name in ("folding", "fling") else 0.02)
    if name == "stretching":
        assert record.force is not None and record.markers is not None
        assert record.markers.shape == (60, 81, 3)
        strain = np.ptp(np.asarray(record.markers)[..., 0], axis=1) / (0.45 * 8 / 9) - 1
        assert strain[-1] == pytest.approx(0.04, abs=0.003) and abs(strain[0]) < 0.003
        # between that of a free and of a wholly prevented contraction
        assert 0.9 * 0.04 * 210 * 0.45 < record.force[-1, 0] < 1.2 * 0.04 * 210 * 0.45
