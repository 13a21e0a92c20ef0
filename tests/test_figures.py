"""The pictures of a study are images with something on them, also of runs that went wrong."""

import sys

import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("matplotlib")

from PIL import Image  # noqa: E402

from r2s.fabrics.parameters import Range  # noqa: E402
from r2s.study.report import figures  # noqa: E402

RANGES = (
    Range("C11", "N/m", 3.0, 3000.0),
    Range("coupling", "-", -0.9, 0.9, log=False),
    Range("bending", "N m", 1e-7, 1e-3),
)
TRUTH = np.array([100.0, 0.2, 1e-5])
TIMES = np.linspace(0.0, 1.0, 5)


def picture(path):
    """The picture as (row, column, 3)."""
    with Image.open(path) as image:
        assert image.format == "PNG"
        return np.asarray(image.convert("RGB"), int)


def pixels(path, colour, part=(0.0, 1.0)):
    """How many pixels of a band are near a colour."""
    array = picture(path)
    band = array[int(part[0] * len(array)) : int(part[1] * len(array))]
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return int((np.abs(band - wanted).max(axis=-1) < 12).sum())


def check(path, width=600, height=350):
    array = picture(path)
    assert array.shape[0] >= height and array.shape[1] >= width
    assert max(array.shape) < 4000
    share = (array < 250).any(axis=-1).mean()
    assert 0.01 < share < 0.7  # neither blank nor filled


def cloth(height):
    """A sheet of 6 x 5 vertices [m], one corner at a height [m], and its triangles."""
    x, y = np.meshgrid(np.linspace(0, 0.5, 6), np.linspace(0, 0.4, 5), indexing="ij")
    vertices = np.stack([x, y, height * (1 - x / 0.5) * (1 - y / 0.4)], -1).reshape(-1, 3)
    at = np.arange(30).reshape(6, 5)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[:-1, 1:], at[1:, 1:]))
    return vertices, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])


@pytest.fixture(scope="module")
def scene():
    before = np.stack([cloth(0.1 * time)[0] for time in TIMES])
    after = np.stack([cloth(0.4 * time)[0] for time in TIMES])
    generator = np.random.default_rng(0)
    clouds = [frame[generator.integers(0, 30, 300)] for frame in after]
    clouds = [cloud + generator.normal(0, 0.003, cloud.shape) for cloud in clouds]
    return clouds, before, after, cloth(0.0)[1]


def test_overlay(tmp_path, scene):
    clouds, before, after, faces = scene
    path = figures.overlay(tmp_path / "a.png", clouds, before, after, faces, TIMES, "lift")
    assert path == tmp_path / "a.png"
    check(path, width=1500, height=600)
    assert pixels(path, figures.VERMILION, (0.0, 0.5)) > 300
    assert pixels(path, figures.VERMILION, (0.5, 1.0)) > 300


def test_overlay_of_outliers_and_a_cloth_that_flew_off(tmp_path, scene):
    clouds, before, after, faces = scene
    flown = before.copy()
    flown[3], flown[4] = 1e6, np.nan
    stray = [np.concatenate([cloud, [[50.0, 50.0, 50.0]]]) for cloud in clouds]
    path = figures.overlay(tmp_path / "a.png", stray, flown, after, faces, TIMES, "lift")
    check(path, width=1500, height=600)
    # Were the picture shrunk to hold these, the dots would be a spot.
    assert pixels(path, figures.VERMILION, (0.5, 1.0)) > 300


def test_limits_hold_the_cloth_but_not_what_strays():
    generator = np.random.default_rng(0)
    dots = generator.uniform(0, 1, (1000, 3))
    dots[:3] = 40.0
    vertices = np.array([[1.2, 0.5, 0.5], [0.5, -0.3, 0.5], [9.0, 9.0, 9.0], [np.nan, 0, 0]])
    low, high = figures.limits(dots, vertices)
    assert 1.2 <= high[0] < 1.3 and -0.4 < low[1] <= -0.3
    assert high[2] < 1.1 and (high < 2).all()


def test_overlay_needs_a_cloud_per_frame(tmp_path, scene):
    clouds, before, after, faces = scene
    with pytest.raises(ValueError, match="one cloud per frame, found 4 for 5"):
        figures.overlay(tmp_path / "a.png", clouds[:4], before, after, faces, TIMES, "lift")


def test_traces(tmp_path):
    fall = np.exp(-np.arange(12) / 4)[:, None, None]
    values = TRUTH * (1 + fall * np.array([1.0, 2.0, 0.5])[:, None] * np.ones(3))
    losses = 1e-5 * (1 + fall[..., 0] * np.array([9.0, 7.0, 5.0]))
    losses[4, 1], losses[5, 2] = np.nan, np.inf
    path = figures.traces(tmp_path / "a.png", losses, values, RANGES, TRUTH, "towel")
    check(path)
    assert pixels(path, figures.BLUE) > 300 and pixels(path, figures.VERMILION) > 100
    without = figures.traces(tmp_path / "b.png", losses, values, RANGES)
    assert pixels(without, figures.VERMILION) == 0
    one = figures.traces(tmp_path / "c.png", losses[:1, :1], values[:1, :1], RANGES)
    check(one)


def test_loss_lines_mark_what_diverged(tmp_path):
    at = TRUTH * 1.1
    places = jnp.linspace(0.0, 1.0, 9)
    losses = 1e-5 + np.linspace(0.0, 1.0, 9) ** 2
    lines = [(bound, bound.from_unit(places), losses.copy()) for bound in RANGES]
    path = figures.loss_lines(tmp_path / "a.png", lines, at, TRUTH, "towel")
    check(path)
    crosses = pixels(path, figures.GREY)
    lines[0][2][:4] = np.inf
    lines[1][2][:] = np.nan
    with_lost = figures.loss_lines(tmp_path / "b.png", lines, at, TRUTH, "towel")
    check(with_lost)
    assert pixels(with_lost, figures.GREY) > crosses + 100
    with pytest.raises(ValueError):
        figures.loss_lines(tmp_path / "c.png", lines, at[:2])


def test_bars(tmp_path):
    groups = {"estimate": [10.0, 12.0], "default": [30.0, np.inf], "repeatability": [np.nan, 4.0]}
    names = ["towel_1", "a long name of a fabric"]
    path = figures.bars(tmp_path / "a.png", names, groups, "distance [mm]", "fold")
    check(path)
    blue, orange = pixels(path, figures.BLUE), pixels(path, figures.ORANGE)
    assert orange / blue == pytest.approx(30 / 22, rel=0.1)  # one orange bar, two blue ones
    with pytest.raises(ValueError, match="estimate: expected 3 values"):
        figures.bars(tmp_path / "b.png", [*names, "c"], groups, "distance [mm]", "fold")


def test_without_matplotlib_the_extra_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "r2s.study.report.figures")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"pip install 'r2s\[study\]'"):
        import r2s.study.report.figures  # noqa: F401
