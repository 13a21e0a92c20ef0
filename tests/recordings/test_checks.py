"""What `r2s check` finds: every fault that is put into a recording, and nothing in one without."""

import dataclasses
import json
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from r2s import scenarios
from r2s.cli.main import main as cli
from r2s.materials import presets
from r2s.mesh.mesh import rectangle
from r2s.recordings.cameras import DepthCamera, look_at, rows_of
from r2s.recordings.checks import Finding, check, mean_distance, point_noise
from r2s.recordings.clouds import Cleaning
from r2s.recordings.recording import Recording, RecordingInfo, SheetPlacement, make_recording, save
from r2s.recordings.rgbd import Rig, read_clouds
from r2s.recordings.synthetic_rgbd import write_rgbd
from r2s.scenarios import synthetic

SIDE, RATE = 0.4, 10.0
SHEET = rectangle((SIDE, SIDE), (17, 17))
TIMES = np.arange(16) / RATE
PLACE = SheetPlacement((SIDE, SIDE), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), ("origin",))
BOX = ((-0.3, -0.3, -0.1), (0.7, 0.7, 0.6))


def height(times: np.ndarray) -> np.ndarray:
    """Of the corner that is lifted [m]: at rest, and then up and down and up again."""
    moving = np.clip(times - 0.3, 0, None)
    return 0.25 * np.sin(2.6 * moving) ** 2


def positions(lifted: float, longer: float = 1.0) -> np.ndarray:
    """A sheet [m] whose corner is lifted along an arc; `longer` is how much it is stretched."""
    rest = longer * np.asarray(SHEET.rest)
    along = rest.sum(axis=1) / np.sqrt(2)  # from the corner along the diagonal
    across = (rest[:, 0] - rest[:, 1]) / np.sqrt(2)
    share = np.clip(1 - along / 0.35, 0, 1)
    up = lifted * share**2
    diagonal = along + 0.5 * lifted * share
    x, y = (diagonal + across) / np.sqrt(2), (diagonal - across) / np.sqrt(2)
    return np.column_stack([x, y, up])


def camera(position: tuple[float, float, float]) -> DepthCamera:
    pose = look_at(position, (0.2, 0.2, 0.05))
    return DepthCamera((160, 120), (140.0, 140.0), (79.5, 59.5), pose, 1e-3)


RIG = Rig(
    {"left": camera((-0.4, -0.2, 0.7)), "right": camera((0.7, 0.1, 0.8))},
    Cleaning(BOX, voxel=0.005),
)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Callable[[float], Path]:
    """Folders of images of a sheet that stretches by some factor while it is lifted."""

    @cache
    def folder(longer: float) -> Path:
        made = tmp_path_factory.mktemp("rgbd")
        factors = 1 + (longer - 1) * np.arange(len(TIMES)) / len(TIMES)
        x = np.stack([positions(*pair) for pair in zip(height(TIMES), factors, strict=True)])
        write_rgbd(made, RIG, x, np.asarray(SHEET.faces), TIMES)
        return made

    return folder


def made_up(clouds, times, path, knots, **info: Any) -> Recording:
    about = RecordingInfo(
        *("made_up", "lift", "none", "1", "made up", (min(5, len(times) - 1), len(times) - 1)),
        *(PLACE, 0.0, None),
    )
    return make_recording(clouds, times, path, knots, dataclasses.replace(about, **info))


def read(folder: Path, rig: Rig = RIG, late: float = 0.0, rate: float = 1.0, **info: Any):
    """A recording of the images, with a rig and a clock that may be wrong."""
    times, clouds = read_clouds(folder, rig)
    times = times[0] + (times - times[0]) * rate + late
    knots = np.linspace(0, 2 * TIMES[-1] + 1, 400)
    path = np.stack([positions(h)[0] for h in height(np.minimum(knots, TIMES[-1]))])
    return made_up(clouds, times, path, knots, **info)


def suspicious(recording: Recording) -> set[str]:
    return {finding.check for finding in check(recording) if finding.is_suspicious}


def moved_cameras(scale: float = 1.0, degrees: float = 0.0, **clean: Any) -> Rig:
    """A rig with a wrong calibration: of the scale of all, or of gravity; and of the cleaning."""
    angle = np.radians(degrees)
    turn = np.eye(4)
    turn[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    cameras = {}
    for name, camera in RIG.cameras.items():
        pose = turn @ np.array(camera.to_world)
        pose[:3, 3] *= scale
        changes = {"to_world": rows_of(pose), "depth_scale": scale * camera.depth_scale}
        cameras[name] = dataclasses.replace(camera, **changes)
    return dataclasses.replace(RIG, cameras=cameras, clean=dataclasses.replace(RIG.clean, **clean))


def test_nothing_is_suspicious_in_a_good_recording(rendered):
    findings = check(read(rendered(1.0)))
    assert [finding.describe() for finding in findings if finding.is_suspicious] == []
    shown = {finding.check for finding in findings if np.isfinite(finding.figure)}
    assert {"scale, warp", "gravity", "table", "reach", "clock", "points", "stretch"} <= shown


SMALL = dataclasses.replace(PLACE, size=(0.38, 0.38))
CUT = ((-0.3, -0.3, -0.1), (0.33, 0.7, 0.6))


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"rig": moved_cameras(scale=1.04)}, "scale, warp"),
        ({"rig": moved_cameras(scale=0.96)}, "scale, weft"),
        ({"rig": moved_cameras(degrees=3.0)}, "gravity"),
        ({"late": 0.15}, "clock"),
        ({"late": -0.15}, "clock"),
        ({"rate": 2.0}, "clock rate"),
        ({"rate": 0.001}, "rate"),  # milliseconds
        ({"rig": moved_cameras(workspace=CUT)}, "crop x"),
        ({"rig": moved_cameras(max_points=60)}, "points"),
        ({"sheet": SMALL}, "scale, warp"),
        ({"table_height": -0.03}, "table"),
    ],
)
def test_every_fault_that_is_put_in_is_found(rendered, options, expected):
    assert expected in suspicious(read(rendered(1.0), **options))


@pytest.mark.slow(group="motions")
def test_a_sheet_that_stretches_is_found(rendered):
    assert suspicious(read(rendered(1.15))) & {"stretch", "reach"}


@pytest.mark.slow(group="motions")
def test_markers_that_move_apart_are_found():
    pulled = synthetic.record(
        scenarios.stretching(num_frames=6, interval=0.2, moving=0.8),
        presets.grey_interlock(),
        "grey",
        key=jax.random.key(0),
    )
    assert "markers" not in suspicious(pulled)
    assert pulled.markers is not None
    middle = pulled.markers[:, :1]
    longer = dataclasses.replace(pulled, markers=middle + 1.2 * (pulled.markers - middle))
    assert longer.markers is not None
    away = dataclasses.replace(longer, markers=longer.markers.at[0].set(pulled.markers[0]))
    assert "markers" in suspicious(away)


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize("name", list(scenarios.SCENARIOS))
@pytest.mark.parametrize("fabric", list(presets.FIVE))
def test_nothing_is_suspicious_in_the_study_s_recordings(name, fabric):
    made = synthetic.record(
        scenarios.SCENARIOS[name](), presets.FIVE[fabric](), fabric, key=jax.random.key(0)
    )
    assert suspicious(made) == set()


def test_a_figure_that_nothing_shows_is_not_suspicious():
    unknown = Finding("scale", np.nan, "-", 0.9, 1.1, "no frame shows it", "look")
    assert not unknown.is_suspicious and unknown.describe().startswith("not shown")
    wrong = unknown._replace(figure=1.2)
    assert wrong.is_suspicious and "1.2, expected 0.9 to 1.1: look" in wrong.describe()


def test_the_command_says_what_it_found_and_how_it_went(rendered, tmp_path: Path, capsys):
    save(read(rendered(1.0)), tmp_path / "good.npz")
    save(read(rendered(1.0), late=0.2), tmp_path / "late.npz")
    assert cli(["check", str(tmp_path / "good.npz")]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == "nothing suspicious; 1 of 20 checks were not possible"
    assert cli(["check", str(tmp_path / "late.npz"), "--json"]) == 1
    printed = json.loads(capsys.readouterr().out)
    assert printed["suspicious"] >= 1 and printed["findings"][0]["check"] == "clock"


def test_a_sheet_of_which_no_point_lies_on_the_table_is_not_shown_and_no_warning():
    away = positions(0.0) + np.array([0, 0, 0.5])
    path = np.broadcast_to(away[:1], (len(TIMES), 1, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        findings = check(made_up([away] * len(TIMES), TIMES, path, TIMES))
    figures = {finding.check: finding.figure for finding in findings}
    shown = [figures[name] for name in ("scale, warp", "scale, weft", "gravity", "table")]
    assert np.isnan(shown).all()


@pytest.mark.parametrize("markers", [1, 2])
def test_points_far_apart_and_single_markers_are_not_shown_and_no_warning(markers):
    hangs = dataclasses.replace(PLACE, weft=(0.0, 0.0, -1.0))
    corners = 0.2 * np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(-1, 3)
    clouds, path = [corners] * 7, np.zeros((7, 1, 3))
    places = np.full((7, markers, 3), 0.1)
    places[0, 0] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = made_up(clouds, TIMES[:7], path, TIMES[:7], sheet=hangs)
        marked = make_recording(clouds, TIMES[:7], path, TIMES[:7], made.info, markers=places)
        found = {f.check: f for each in (made, marked) for f in check(each)}
    assert found["gravity"].describe().startswith("not shown   gravity: ")
    assert found["markers"].describe().startswith("not shown   markers: ")


RNG = np.random.default_rng(0)


def bent(noise: float, radius: float = 1e3, count: int = 2000) -> Recording:
    """A sheet of 0.2 m on a cylinder [m], with noise [m] across it."""
    along, across = RNG.uniform(0, 0.2, (2, 6, count))
    away, angle = noise * RNG.standard_normal((6, count)), along / radius
    out = radius + away
    clouds = np.stack([out * np.sin(angle), across, out * np.cos(angle) - radius], axis=2)
    return made_up(list(clouds), TIMES[:6], np.zeros((6, 3)), TIMES[:6])


@pytest.mark.parametrize(("noise", "radius"), [(2e-4, 1e3), (1e-3, 1e3), (3e-3, 1e3), (1e-3, 0.05)])
def test_noise_across_a_plane_or_a_fold_of_5_cm_is_found(noise, radius):
    assert point_noise(bent(noise, radius)) == pytest.approx(noise, rel=0.2)
    assert np.isnan(point_noise(bent(noise, radius, count=9)))


def test_the_mean_distance_is_that_of_normal_noise():
    mean = np.abs(RNG.standard_normal(100_000)).mean()
    assert mean_distance(1.0) == pytest.approx(mean, rel=0.01)
