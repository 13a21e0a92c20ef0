"""Captures of RGBench: clouds in the world, on the arms' clock, and what is broken in them."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rgbench_captures import read_capture

from r2s.recordings.recording import SheetPlacement, cloud

X, Y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
SHEET = SheetPlacement((0.5, 0.6), (0.1, 0.0, 0.0), X, Y, ("weft", "opposite"))
START = 1752924898.0  # [s], the arms' first sample
TURN = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # from world to camera
SHIFT = np.array([0.1, 0.2, 0.3])
POINTS = np.array([[0.3, 0.1, 0.02], [0.5, -0.2, 0.1]])  # [m], in the world


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A capture of five clouds, 0.06 s apart, with two arms that rise by 1 m/s."""
    from_pcd = pytest.importorskip("pypcd4").PointCloud
    folder = tmp_path / "green_tshirt" / "green_tshirt_grasp_2025-07-19-19-14-58"
    for name in ("segment_pcds", "calibration", "joints"):
        (folder / name).mkdir(parents=True)
    for i in range(5):
        seen = (POINTS + [0, 0, 0.06 * i]) @ TURN.T + SHIFT
        file = folder / "segment_pcds" / f"pointcloud_{START + 0.06 * i:.6f}_segmented.pcd"
        from_pcd.from_xyz_points(seen.astype(np.float32)).save(file)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = TURN, SHIFT
    extrinsics = folder / "calibration" / "world_to_camera_transform.json"
    extrinsics.write_text(json.dumps(matrix.tolist()))
    for arm, late in (("left", 0.0), ("right", 0.003)):
        lines = ["time,pos_1,pos_x,pos_y,pos_z,orn_w"]
        for i in range(40):
            lines.append(f"{START + late + 0.01 * i},0.5,0.3,0.0,{late + 0.01 * i},1")
        file = folder / "joints" / f"{arm}_arm_joint_states_and_end_pose.csv"
        file.write_text("\n".join(lines))
    return folder


def test_a_capture_is_in_the_world_and_on_the_arms_clock(capture: Path) -> None:
    recording = read_capture(capture, SHEET, camera_delay=0.05)
    np.testing.assert_allclose(recording.times, 0.05 + 0.06 * np.arange(5), atol=1e-6)
    for i in range(5):
        np.testing.assert_allclose(cloud(recording, i), POINTS + [0, 0, 0.06 * i], atol=1e-6)
    np.testing.assert_allclose(recording.gripper_path[10, :, 1], [0.25, -0.25])
    np.testing.assert_allclose(recording.gripper_path[10, :, 2], [0.1, 0.1], atol=1e-6)
    info = recording.info
    assert (info.fabric, info.scenario) == ("green_tshirt", "grasp")
    assert info.trial == "2025-07-19-19-14-58"
    assert float(read_capture(capture, SHEET).times[0]) == pytest.approx(0.06, abs=1e-5)


def renamed(path: Path) -> None:
    path.rename(path.with_name(path.name.replace("pointcloud_17", "pointcloud_16")))


def changed(name: str, change) -> Callable[[Path], object]:
    """A file of lines with others."""

    def edit(capture: Path) -> None:
        lines = change((capture / name).read_text().splitlines())
        (capture / name).write_text("\n".join(lines))

    return edit


LEFT = "joints/left_arm_joint_states_and_end_pose.csv"
EXTRINSICS = "calibration/world_to_camera_transform.json"
BROKEN: list[tuple[Callable[[Path], object], str]] = [
    (lambda c: shutil.rmtree(c / "segment_pcds"), "segment_pcds: no such folder of clouds"),
    (
        lambda c: [file.unlink() for file in sorted((c / "segment_pcds").iterdir())[1:]],
        "segment_pcds: expected clouds such as pointcloud_.*found 1",
    ),
    (lambda c: (c / EXTRINSICS).unlink(), EXTRINSICS),
    (changed(EXTRINSICS, lambda _: [json.dumps(np.eye(3).tolist())]), "expected four rows of four"),
    (
        changed(EXTRINSICS, lambda _: [json.dumps(np.diag([1.0, 1, -1, 1]).tolist())]),
        "world_to_camera_transform.json: its rotation is none",
    ),
    (changed(LEFT, lambda a: [a[0].replace("pos_x", "x"), *a[1:]]), "left.*lacks .* pos_x"),
    (changed(LEFT, lambda a: [*a[:3], a[3].replace("0.3", "high"), *a[4:]]), "csv: line 4: .*high"),
    (changed(LEFT, lambda a: [*a[:3], a[4], a[3], *a[5:]]), "csv: line 5: times must increase"),
    (
        lambda c: [renamed(file) for file in list(c.glob("segment_pcds/*"))],
        "no cloud is from the time of the arms' paths.*of one capture",
    ),
]


@pytest.mark.parametrize("break_it, words", BROKEN)
def test_a_broken_capture_names_the_file(capture: Path, break_it, words: str) -> None:
    break_it(capture)
    with pytest.raises((ValueError, FileNotFoundError), match=words):
        read_capture(capture, SHEET)


def test_a_capture_needs_two_held_corners_and_its_name(capture: Path) -> None:
    with pytest.raises(ValueError, match="two arms hold the sheet, found 1"):
        read_capture(capture, replace(SHEET, pinned=("weft",)))
    with pytest.raises(ValueError, match="expected a name such as white_shirt_grasp"):
        read_capture(capture.rename(capture.with_name("capture")), SHEET)
