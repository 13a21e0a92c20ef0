"""What `r2s check` finds: every fault that is put into a recording, and nothing in one without."""

import dataclasses
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from r2s import scenarios
from r2s.cli.main import main as cli
from r2s.materials import presets
from r2s.mesh.mesh import rectangle
from r2s.recordings.cameras import DepthCamera, look_at
from r2s.recordings.checks import Finding, check
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
    made: dict[float, Path] = {}

    def folder(longer: float) -> Path:
        if longer not in made:
            made[longer] = tmp_path_factory.mktemp("rgbd")
            factors = 1 + (longer - 1) * np.arange(len(TIMES)) / len(TIMES)
            pairs = zip(height(TIMES), factors, strict=True)
            x = np.stack([positions(*pair) for pair in pairs])
            write_rgbd(made[longer], RIG, x, np.asarray(SHEET.faces), TIMES)
        return made[longer]

    return folder


def read(folder: Path, rig: Rig = RIG, late: float = 0.0, rate: float = 1.0, **info: Any):
    """A recording of the images, with a rig and a clock that may be wrong."""
    times, clouds = read_clouds(folder, rig)
    times = times[0] + (times - times[0]) * rate + late
    knots = np.linspace(0, 2 * TIMES[-1] + 1, 400)
    path = np.stack([positions(h)[0] for h in height(np.minimum(knots, TIMES[-1]))])
    told = RecordingInfo(
        name="made_up",
        scenario="lift",
        fabric="none",
        trial="1",
        source="made up",
        frames_used=(5, len(times) - 1),
        sheet=PLACE,
        table_height=0.0,
        verified=None,
    )
    return make_recording(clouds, times, path, knots, dataclasses.replace(told, **info))


def suspicious(recording: Recording) -> set[str]:
    return {each.check for each in check(recording) if each.is_suspicious}


def with_cameras(change: Callable[[DepthCamera], DepthCamera], **clean: Any) -> Rig:
    cameras = {name: change(each) for name, each in RIG.cameras.items()}
    return dataclasses.replace(RIG, cameras=cameras, clean=dataclasses.replace(RIG.clean, **clean))


def same(camera: DepthCamera) -> DepthCamera:
    return camera


def scaled(factor: float) -> Rig:
    """A wrong calibration: all that the cameras see, and where they are, is longer."""

    def longer(camera: DepthCamera) -> DepthCamera:
        pose = np.array(camera.to_world)
        pose[:3, 3] *= factor
        rows: Any = tuple(map(tuple, pose.tolist()))
        return dataclasses.replace(camera, to_world=rows, depth_scale=factor * camera.depth_scale)

    return with_cameras(longer)


def tilted(degrees: float) -> Rig:
    angle = np.radians(degrees)
    turn = np.eye(4)
    turn[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]

    def turned(camera: DepthCamera) -> DepthCamera:
        rows: Any = tuple(map(tuple, (turn @ np.array(camera.to_world)).tolist()))
        return dataclasses.replace(camera, to_world=rows)

    return with_cameras(turned)


def test_nothing_is_suspicious_in_a_good_recording(rendered):
    found = check(read(rendered(1.0)))
    assert [each.describe() for each in found if each.is_suspicious] == []
    shown = {each.check for each in found if np.isfinite(each.figure)}
    assert {"scale, warp", "gravity", "table", "reach", "clock", "points", "stretch"} <= shown


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize(
    ("fault", "options", "expected"),
    [
        ("scale 4 % too long", {"rig": scaled(1.04)}, "scale, warp"),
        ("scale 4 % too short", {"rig": scaled(0.96)}, "scale, weft"),
        ("gravity 3 degrees off", {"rig": tilted(3.0)}, "gravity"),
        ("clock 0.15 s late", {"late": 0.15}, "clock"),
        ("clock 0.15 s early", {"late": -0.15}, "clock"),
        ("a clock that runs twice as fast", {"rate": 2.0}, "clock rate"),
        ("frames in milliseconds", {"rate": 0.001}, "rate"),
        (
            "a crop through the sheet",
            {"rig": with_cameras(same, workspace=((-0.3, -0.3, -0.1), (0.33, 0.7, 0.6)))},
            "crop x",
        ),
        ("too few points", {"rig": with_cameras(same, max_points=60)}, "points"),
        (
            "a sheet written down 5 % too small",
            {"sheet": dataclasses.replace(PLACE, size=(0.38, 0.38))},
            "scale, warp",
        ),
        ("a table 3 cm too low", {"table_height": -0.03}, "table"),
    ],
)
def test_every_fault_that_is_put_in_is_found(rendered, fault, options, expected):
    assert expected in suspicious(read(rendered(1.0), **options)), fault


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
    assert capsys.readouterr().out.endswith("nothing suspicious\n")
    assert cli(["check", str(tmp_path / "late.npz"), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["suspicious"] >= 1 and told["findings"][0]["check"] == "clock"


def test_a_sheet_of_which_no_point_lies_on_the_table_is_not_shown_and_no_warning():
    away = positions(0.0) + np.array([0, 0, 0.5])
    path = np.broadcast_to(away[:1], (len(TIMES), 1, 3))
    info = RecordingInfo(
        "made_up", "lift", "none", "1", "made up", (5, len(TIMES) - 1), PLACE, 0.0, None
    )
    seen = make_recording([away] * len(TIMES), TIMES, path, TIMES, info)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = {each.check: each for each in check(seen)}
    assert all(np.isnan(found[f"scale, {side}"].figure) for side in ("warp", "weft"))
    assert np.isnan(found["gravity"].figure) and np.isnan(found["table"].figure)
