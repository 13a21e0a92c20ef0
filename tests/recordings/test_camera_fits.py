"""Cameras that are turned or shifted, or whose depth is along the ray, are named by `check`."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_checks import PLACE, RIG, SHEET, positions

from r2s._util.files import write_json
from r2s.recordings.camera_fits import fit_cameras
from r2s.recordings.cameras import rays, rows_of
from r2s.recordings.checks import check
from r2s.recordings.images import read_depth, write_depth
from r2s.recordings.manifest import default_manifest, manifest_for
from r2s.recordings.open import convert
from r2s.recordings.recording import RecordingInfo, SheetPlacement, load, make_recording
from r2s.recordings.rgbd import Rig, read_clouds
from r2s.recordings.synthetic_rgbd import write_rgbd
from r2s.recordings.views import CameraFit

TIMES = np.arange(3) / 10
X = np.stack([positions(height) for height in (0.0, 0.1, 0.2)])
ONE = replace(RIG, cameras={"left": RIG.cameras["left"]})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("rgbd")
    write_rgbd(made, RIG, X, np.asarray(SHEET.faces), TIMES)
    return made


def left(rig: Rig = RIG, turn=(0, 0, 0), shift=(0, 0, 0)) -> Rig:
    """The left camera turned about its own axes [degrees], and shifted in the world [m]."""
    pose = np.array(rig.cameras["left"].to_world)
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(turn, degrees=True).as_matrix()
    pose[:3, 3] += shift
    moved = replace(rig.cameras["left"], to_world=rows_of(pose))
    return replace(rig, cameras={**rig.cameras, "left": moved})


def fits_of(folder: Path, rig: Rig, sheet: SheetPlacement = PLACE) -> tuple[CameraFit, ...]:
    read_clouds(folder, rig, alone=(alone := []))
    return fit_cameras(rig.cameras, alone, sheet)


def suspicious(folder: Path, rig: Rig) -> set[str]:
    """What `check` says of the cameras."""
    fits = fits_of(folder, rig)
    info = RecordingInfo(
        *("made_up", "lift", "none", "1", "made up", (0, 2), PLACE, 0.0, None), camera_fits=fits
    )
    path = X[:, :1]
    findings = check(make_recording(list(X), TIMES, path, TIMES, info))
    shown = {each.check for each in findings if each.check.startswith("camera")}
    assert {f"camera depth {name}" for name in rig.cameras} <= shown
    return {f.check for f in findings if f.is_suspicious and f.check.startswith("camera")}


@pytest.mark.parametrize("rig", [RIG, ONE, left(turn=(0.2, 0, 0)), left(shift=(0.003, 0, 0.002))])
def test_good_cameras_are_not_suspicious(folder: Path, rig: Rig) -> None:
    assert suspicious(folder, rig) == set()


@pytest.mark.parametrize("rig", [RIG, ONE])
@pytest.mark.parametrize("amount", [1, -1])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_turned_or_a_shifted_camera_is_named(
    folder: Path, rig: Rig, axis: int, amount: int
) -> None:
    step = amount * np.eye(3)[axis]
    for wrong in (left(rig, turn=2 * step), left(rig, shift=0.02 * step)):
        named = suspicious(folder, wrong)
        assert named & {"camera shift left", "camera turn left"}
        assert not named & {"camera shift right", "camera turn right"}


def test_cameras_that_see_no_sheet_at_rest_are_compared_with_each_other(folder: Path) -> None:
    """As of a sheet that hangs: it was written down elsewhere."""
    away = replace(PLACE, origin=(0.0, 0.0, 1.0))
    for rig, apart in (
        (RIG, False),
        (left(turn=(2, 0, 0)), True),
        (left(shift=(0, 0, 0.02)), True),
    ):
        for fit in fits_of(folder, rig, away):
            assert fit.shift is fit.turn is None and fit.apart is not None
            assert (fit.apart > 0.005) == apart


def on_rays(folder: Path, to: Path, names: tuple[str, ...]) -> None:
    """A recording whose cameras of these names write depth along the ray."""
    write_rgbd(to, RIG, X, np.asarray(SHEET.faces), TIMES)
    for name in names:
        along = np.sqrt(1 + (rays(RIG.cameras[name]) ** 2).sum(axis=-1))
        for file in (to / name / "depth").iterdir():
            write_depth(file, read_depth(file, 1e-3, (160, 120)) * along, 1e-3)


@pytest.mark.parametrize("names", [("left", "right"), ("right",)])
def test_depth_along_the_ray_is_named(folder: Path, tmp_path: Path, names) -> None:
    on_rays(folder, tmp_path, names)
    wrong = {f"camera depth {name}" for name in names}
    assert {name for name in suspicious(tmp_path, RIG) if "depth" in name} == wrong
    cameras = {n: replace(c, depth_along="ray") for n, c in RIG.cameras.items() if n in names}
    right = replace(RIG, cameras={**RIG.cameras, **cameras})
    assert suspicious(tmp_path, right) == set()
    if len(names) == 2:  # and the other way round
        assert "camera depth left" in suspicious(folder, right)


def test_conversion_keeps_what_a_check_needs(tmp_path: Path) -> None:
    template = default_manifest().parent / "templates" / "study.json"
    manifest = json.loads(template.read_text())
    scenario = manifest["scenarios"]["lift"]
    scenario |= {"frames_used": [0, 2], "sheet": asdict(PLACE), "table_height": 0.0}
    (tmp_path / "in").mkdir()
    on_rays(tmp_path, tmp_path / "in/lift_made_1", ("left", "right"))
    write_json(tmp_path / "in/manifest.json", manifest)
    write_json(tmp_path / "in/cameras.json", asdict(RIG))
    np.save(tmp_path / "in/lift_gripper.npy", np.repeat(X[:, 0], 9, axis=0))
    assert manifest_for(tmp_path / "in").scenarios["lift"].sheet == PLACE
    (line,) = convert(tmp_path / "in", tmp_path / "out")
    assert line.startswith("lift_made_1: 3 frames, ") and "suspicious  camera depth left: " in line
    findings = check(load(tmp_path / "out/lift_made_1.npz"))
    (words,) = {f.describe() for f in findings if f.check == "camera depth left"}
    assert words.startswith("suspicious") and 'set its "depth_along"' in words
