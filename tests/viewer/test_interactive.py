"""Sliders for a fabric: what is simulated, and what a browser shows when one is moved."""

import base64
import contextlib
import io
import json
import socket
import subprocess
import sys
import time
import urllib.request
from types import SimpleNamespace

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from browser import BROWSER, needs_browser
from matplotlib.image import imread

from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
from r2s.mesh.surface import sample
from r2s.metrics.prediction_error import distances
from r2s.recordings.recording import cloud
from r2s.scenarios import lifting, synthetic
from r2s.viewer import page
from r2s.viewer.page import Subject, move

pytest.importorskip("viser")

FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--window-size=1100,800",
    "--remote-debugging-port=0",
)  # fmt: skip
SLIDER = "document.querySelectorAll('[role=slider]')[1]"  # the frame's is before the parameters'
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


def free_port():
    with socket.socket() as tried:
        tried.bind(("127.0.0.1", 0))
        return tried.getsockname()[1]


@pytest.mark.slow(group="documents")
def test_the_error_is_the_distance_to_dense_samples_of_the_sheet(recording, subject):
    moved = move(subject, subject.place(presets.black_denim()))
    first, last = subject.frames_used
    faces = subject.scenario.scene.mesh.faces
    found = [
        distances(cloud(recording, frame), np.asarray(sample(moved.motion.x[frame], faces, 30)))
        for frame in range(first, last + 1)
    ]
    expected = np.mean([each["chamfer_real_to_sim"] for each in found])
    # samples 4 mm apart, and not all of the points
    assert float(moved.mean_error) == pytest.approx(expected, abs=1e-3)


@pytest.mark.slow(group="documents")
def test_the_true_fabric_is_nearest_and_a_softer_one_hangs_lower(subject):
    truth = subject.place(presets.grey_interlock())

    def at(u):
        return move(subject, u)

    softer = at(truth.at[0].set(0.0))
    assert at(truth).mean_error < softer.mean_error
    lowest = [each.motion.x[-1, :, 2].min() for each in (softer, at(truth))]
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
    wait_for(lambda: shown.u[2] == pytest.approx(0.9))
    after = shown.moved.motion.x
    assert np.allclose(after, move(subject, jnp.asarray(shown.u)).motion.x)
    assert not np.allclose(after, before.motion.x, atol=1e-3)


def test_a_motion_that_fails_is_said_and_the_page_goes_on(shown, monkeypatch):
    def fail(*_):
        raise RuntimeError("out of memory")

    before, whole = shown.moved, page.move
    monkeypatch.setattr(page, "move", fail)
    shown._sliders[2].value = 0.2
    wait_for(lambda: shown.u[2] == pytest.approx(0.2))
    assert shown.moved is before and "out of memory" in shown._describe(0)
    monkeypatch.setattr(page, "move", whole)
    shown._sliders[2].value = 0.3
    wait_for(lambda: shown.moved is not before)
    assert not shown.failure


def test_what_cannot_be_saved_is_said(shown):
    told = []

    def save(fabric):
        raise OSError("disk is full")

    client = SimpleNamespace(add_notification=lambda *words: told.append(words))
    shown._save(save, SimpleNamespace(client=client))
    shown._save(lambda fabric: f"{float(fabric.density):.2f}", SimpleNamespace(client=client))
    assert told == [("not saved", "disk is full"), ("saved", "0.19")]


class Browser:
    """A page in headless Chromium, by its debugging protocol."""

    def __init__(self, folder):
        from websockets.sync.client import connect

        flags = [*FLAGS, f"--user-data-dir={folder}", "about:blank"]
        self.process = subprocess.Popen(
            [str(BROWSER), *flags], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )
        port = wait_for(lambda: (folder / "DevToolsActivePort").read_text().split()[0])
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
            target = next(each for each in json.load(answer) if each["type"] == "page")
        self.socket = connect(target["webSocketDebuggerUrl"], max_size=None)
        self.count = 0

    def call(self, method, **arguments):
        self.count += 1
        self.socket.send(json.dumps({"id": self.count, "method": method, "params": arguments}))
        while True:
            answer = json.loads(self.socket.recv(timeout=60))
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]

    def evaluate(self, script):
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def press(self, key):
        for kind in ("rawKeyDown", "keyUp"):
            about = {"key": key, "code": key, "windowsVirtualKeyCode": KEYS[key]}
            self.call("Input.dispatchKeyEvent", type=kind, **about)

    def picture(self):
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def close(self):
        self.socket.close()
        self.process.terminate()
        self.process.wait()


KEYS = {"ArrowRight": 39, "Home": 36}


def wait_for(found, timeout=60.0):
    """What a function gives once it gives something and does not raise."""
    end = time.monotonic() + timeout
    while True:
        with contextlib.suppress(OSError, IndexError):
            if value := found():
                return value
        assert time.monotonic() < end, "nothing came in time"
        time.sleep(0.1)


def is_blue(png):
    """Which pixels of a picture have the colour of the cloth."""
    red, green, blue = imread(io.BytesIO(png))[..., :3].transpose(2, 0, 1)
    return (blue > 0.35) & (blue > 1.2 * green) & (blue > 2 * red)


@needs_browser
def test_a_slider_moved_in_a_browser_moves_the_cloth(shown, tmp_path):
    browser = Browser(tmp_path)
    try:
        browser.call("Page.navigate", url=shown.url)
        wait_for(lambda: browser.evaluate(f"!!{SLIDER}"))
        time.sleep(3)
        before, picture = shown.moved, browser.picture()
        browser.evaluate(f"{SLIDER}.focus()")
        browser.press("Home")
        wait_for(lambda: shown.u[0] == 0)
        after = shown.moved
        time.sleep(2)
        changed = browser.picture()
        (tmp_path / "before.png").write_bytes(picture)
        (tmp_path / "after.png").write_bytes(changed)
        assert not np.allclose(after.motion.x, before.motion.x, atol=1e-3)
        sheets = is_blue(picture), is_blue(changed)
        assert min(sheet.sum() for sheet in sheets) > 1000
        assert (sheets[0] ^ sheets[1]).sum() > 0.05 * sheets[0].sum()
    finally:
        browser.close()
