"""Sliders for a fabric: what is simulated, and what the page shows when one is moved."""

import socket
import sys
import time
from types import SimpleNamespace

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
from r2s.mesh.surface import sample
from r2s.metrics.prediction_error import distances
from r2s.recordings.recording import cloud
from r2s.scenarios import lifting, synthetic
from r2s.viewer import page
from r2s.viewer.page import Subject, move

pytest.importorskip("viser")

SHAPE = (5, 5)


@pytest.fixture(scope="module")
def recording():
    experiment = lifting(num_frames=8, interval=0.1, moving=0.6)
    fabric = presets.grey_interlock()
    return synthetic.record(experiment, fabric, "grey", shape=SHAPE, key=jr.key(0))


@pytest.fixture(scope="module")
def subject(recording):
    space = OrthotropicSpace.make(float(presets.grey_interlock().density))
    return Subject.of_recording(recording, space, SHAPE)


@pytest.fixture
def shown(subject):
    start = subject.place(presets.grey_interlock())
    made = page.Page(subject, start, port=free_port())
    yield made
    made.close()


def wait_until(holds, timeout=60.0):
    end = time.monotonic() + timeout
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.1)


def free_port():
    with socket.socket() as tried:
        tried.bind(("127.0.0.1", 0))
        return tried.getsockname()[1]


@pytest.mark.slow(group="documents")
def test_the_error_is_the_distance_to_dense_samples_of_the_sheet(recording, subject):
    moved = move(subject, subject.place(presets.black_denim()))
    first, last = subject.frames_used
    faces = subject.scenario.scene.mesh.faces
    expected = []
    for frame in range(first, last + 1):
        points = np.asarray(sample(moved.motion.x[frame], faces, 30))
        expected.append(distances(cloud(recording, frame), points)["chamfer_real_to_sim"])
    # samples 4 mm apart, and not all of the points
    assert float(moved.mean_error) == pytest.approx(np.mean(expected), abs=1e-3)


@pytest.mark.slow(group="documents")
def test_the_true_fabric_is_nearest_and_a_softer_one_hangs_lower(subject):
    truth = subject.place(presets.grey_interlock())
    right, softer = (move(subject, u) for u in (truth, truth.at[0].set(0.0)))
    assert right.mean_error < softer.mean_error
    lowest = [moved.motion.x[-1, :, 2].min() for moved in (softer, right)]
    assert lowest[0] <= lowest[1] + 1e-4


@pytest.mark.slow(group="documents")
def test_without_a_recording_there_is_no_error():
    experiment = lifting(num_frames=3, moving=0.1)
    subject = Subject.of_experiment(experiment, OrthotropicSpace.make(0.2), (3, 3))
    moved = move(subject, jnp.full(subject.space.dim, 0.5))
    assert bool(moved.motion.ok.all()) and np.isnan(np.asarray(moved.error)).all()


def test_without_viser_the_extra_is_named(monkeypatch, subject):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"sliders: viser is missing: pip install 'r2s\[viz\]'"):
        page.Page(subject, jnp.full(subject.space.dim, 0.5))


def test_a_taken_port_is_said(subject, shown):
    with pytest.raises(OSError, match=f"port {shown.server.get_port()}"):
        page.Page(subject, jnp.asarray(shown.u), port=shown.server.get_port())


def test_only_the_last_place_of_a_slider_is_shown(subject, shown):
    before = shown.moved
    for value in np.linspace(0.1, 0.9, 9):
        shown._sliders[2].value = float(value)
    wait_until(lambda: shown.u[2] == pytest.approx(0.9))
    after = shown.moved.motion.x
    assert np.allclose(after, move(subject, jnp.asarray(shown.u)).motion.x)
    assert not np.allclose(after, before.motion.x, atol=1e-3)


def test_a_motion_that_fails_is_said_and_the_page_goes_on(shown, monkeypatch):
    def fail(*_):
        raise RuntimeError("out of memory")

    before, whole = shown.moved, page.move
    monkeypatch.setattr(page, "move", fail)
    shown._sliders[2].value = 0.2
    wait_until(lambda: shown.u[2] == pytest.approx(0.2))
    assert shown.moved is before and "out of memory" in shown._describe(0)
    monkeypatch.setattr(page, "move", whole)
    shown._sliders[2].value = 0.3
    wait_until(lambda: shown.moved is not before)
    assert not shown.failure


def test_what_cannot_be_saved_is_said(shown):
    def save(fabric):
        raise OSError("disk is full")

    notes = []
    client = SimpleNamespace(add_notification=lambda *words: notes.append(words))
    for function in (save, lambda fabric: f"{float(fabric.density):.2f}"):
        shown._save(function, SimpleNamespace(client=client))
    assert notes == [("not saved", "disk is full"), ("saved", "0.19")]
