"""Broken recordings: each gives an error that names the file or frame, and what to do."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rgbd_scene import write

from r2s.recordings.images import encode_png, read_depth
from r2s.recordings.rgbd import read_clouds, read_rig

Break = Callable[[Path], Any]
LEFT = ("cameras", "left")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "wave"
    write(folder)
    return folder


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "wave")


def edited(*keys: str, value: Any) -> Break:
    """Another value in cameras.json; a function makes it from the old one."""

    def edit(folder: Path) -> None:
        whole = inner = json.loads((folder / "cameras.json").read_text())
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value(inner[keys[-1]]) if callable(value) else value
        (folder / "cameras.json").write_text(json.dumps(whole))

    return edit


def removed(name: str) -> Break:
    def remove(folder: Path) -> None:
        shutil.rmtree(folder / name) if (folder / name).is_dir() else (folder / name).unlink()

    return remove


def cut(name: str) -> Break:
    return lambda folder: os.truncate(folder / name, (folder / name).stat().st_size // 2)


def image(name: str, values: Any) -> Break:
    return lambda folder: (folder / name).write_bytes(encode_png(np.asarray(values)))


def as_npy(change: Callable[[np.ndarray], np.ndarray], *others: Break, scale: float = 1.0) -> Break:
    """The depth of the left camera as NPY of metres, changed; and other changes."""

    def rewrite(folder: Path) -> None:
        for path in sorted((folder / "left" / "depth").iterdir()):
            np.save(path.with_suffix(".npy"), change(read_depth(path, 1e-3, (160, 120))))
            path.unlink()
        for other in (edited(*LEFT, "depth_scale", value=scale), *others):
            other(folder)

    return rewrite


def text(name: str, content: str) -> Break:
    return lambda folder: (folder / name).write_text(content, encoding="latin-1")


def swap(cameras: dict) -> dict:
    poses = [camera["to_world"] for camera in cameras.values()]
    pairs = zip(cameras.items(), reversed(poses), strict=True)
    return {name: camera | {"to_world": pose} for (name, camera), pose in pairs}


def duplicate(folder: Path) -> None:
    shutil.copy(folder / "left/depth/001.png", folder / "left/depth/left_0001.png")


def pose(change: Callable[[np.ndarray], Any]) -> Break:
    return edited(*LEFT, "to_world", value=lambda rows: np.asarray(change(np.array(rows))).tolist())


def inverse(rows: np.ndarray) -> np.ndarray:
    return np.vstack([np.linalg.inv(rows)[:3], [0, 0, 0, 1]])


FLAT, EMPTY = np.ones((120, 160)), np.zeros((120, 160), np.uint8)
CORNER = np.pad(np.full((9, 9), 700, np.uint16), ((0, 111), (0, 151)))
BROKEN: list[tuple[Break, str]] = [
    # files and frames
    (removed("right"), "wave/right: no folder of the camera 'right'.*restore it"),
    (removed("left/masks"), "left/masks: no such folder: segment.*SAM 2"),
    (
        removed("left/depth/001.png"),
        "left/depth: no image .*masks/001.png: export it",
    ),
    (
        removed("left/depth/003.png"),
        "left/depth: no image .*masks/003.png: export it",
    ),
    (
        removed("right/masks/003.png"),
        "right/masks: no image .*depth/003.png: export it",
    ),
    (duplicate, "left/depth: frame 1 is there twice: .*keep one"),
    # images
    (cut("left/depth/002.png"), "left/depth/002.png: truncated PNG.*again"),
    (text("left/depth/002.png", "JFIF"), "left/depth/002.png: no PNG.*: export it as"),
    (as_npy(lambda d: d, cut("left/depth/001.npy")), "left/depth/001.npy: .*npy.*copy it again"),
    (
        image("right/depth/001.png", np.ones((60, 80), np.uint16)),
        "right/depth/001.png: the image has 80 x 60 pixels, cameras.json says 160 x 120: export",
    ),
    (
        image("right/masks/001.png", np.ones((480, 640), np.uint8)),
        "right/masks/001.png: the image has 640 x 480 pixels.*make the masks in the pixels of the",
    ),
    (
        image("left/depth/000.png", FLAT.astype(np.uint8)),
        "left/depth/000.png: expected depth as a 16-bit PNG.*found 8 bits in 1: export the raw",
    ),
    (image("left/depth/000.png", np.ones((120, 160, 3), np.uint8)), "000.png: .* 8 bits in 3"),
    (as_npy(lambda d: d - 0.5), r"000.npy: \d+ depths are negative, the least is -0.*0 where"),
    (as_npy(lambda d: d * np.nan), "left/depth/000.npy: no pixel.*drop the frame"),
    (
        edited(*LEFT, "depth_scale", value=1.0),
        r"000.png: the median depth is \d+ m .*0.001 for mil",
    ),
    (as_npy(lambda d: d, scale=0.001), r"000.npy: the median depth is 0.000\d+ m .*1 for metres"),
    (image("right/masks/001.png", EMPTY), 'right/masks/001.png: the mask is empty: .*"may_miss"'),
    (image("left/masks/003.png", EMPTY + 1), "left/masks/003.png: the mask marks every pixel: wr"),
    (image("left/depth/000.png", CORNER), "no depth behind the mask .*left/masks/000.png: check"),
    # calibration
    (cut("cameras.json"), "cameras.json: no JSON: "),
    (removed("cameras.json"), "wave: no cameras.json.*: write one"),
    (edited(*LEFT, "fx", value=900), "cameras.json: cameras: left: unknown: fx"),
    (
        edited(*LEFT, "depth_scale", value=None),
        "left: depth_scale is unknown: give metres per unit",
    ),
    (edited(*LEFT, "depth_scale", value=0), "left: depth_scale must be.*give metres"),
    (edited(*LEFT, "centre", value=[319.5, 239.5]), "centre .* middle of 160 x 120 pixels.*Scale"),
    (pose(lambda p: p @ np.diag([2, 2, 2, 1])), "left: to_world is no rotation.*as columns"),
    (pose(lambda _: np.diag([1.0, 1, -1, 1])), "left: to_world is no rotation"),
    (pose(np.transpose), "left: to_world must end with the row 0 0 0 1.*transpose it"),
    (pose(lambda p: p * [1, 1, 1, 1e3] - 999 * np.diag([0, 0, 0, 1])), "position in metres"),
    (pose(inverse), "left/depth/000.png: 0% of .*'left' .*its inverse .is it world to cam"),
    (pose(lambda p: p @ np.diag([1, -1, -1, 1])), "left/depth/000.png: 0% of .*OpenGL"),
    (edited("cameras", value=swap), "wave: the first frames of 'left' and 'right' .*swapped"),
    (
        edited("clean", "workspace", value=[[5, 5, 5], [6, 6, 6]]),
        "left/depth/000.png: 0% of .* m: check to_world, depth_scale and workspace",
    ),
    (edited("clean", "workspace", value=[[1, 1, 1], [0, 0, 0]]), "clean: workspace must be"),
    # clocks
    (text("left/times.csv", "frame,time\n0,0\n1,0.2\n2,0.1\n3,0.3\n"), "line 4: .*sort the lines"),
    (text("left/times.csv", "0\n0.1\n0.1\n0.3\n"), "line 3: times must increase.*drop"),
    (text("left/times.csv", "0\n66\n133\n200\n"), "67 s apart: .*in seconds"),
    (text("left/times.csv", "0\n0.1\n12:00:01\n0.3\n"), "line 3: .*found '12:00:01': write"),
    (text("left/times.csv", "Zeit, f\xfcr alle\n0\n"), "times.csv: 1 times, but 4 frames"),
    (text("left/times.csv", "0\n0.1\n"), "left/times.csv: 2 times, but 4 frames"),
    (
        removed("left/times.csv"),
        "times.csv: no such file, no times in the names .* no frame_rate",
    ),
    (text("right/times.csv", "9\n10\n11\n12\n"), "never ran at once: .*share a clock"),
]


@pytest.mark.parametrize(("break_it", "words"), BROKEN)
def test_broken_images_are_named_with_a_remedy(folder: Path, break_it: Break, words: str) -> None:
    break_it(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=words) as error:
        read_clouds(folder, read_rig(folder))
    assert str(folder) in str(error.value)


def test_a_fabric_out_of_view_may_be_declared(folder: Path) -> None:
    image("right/masks/001.png", EMPTY)(folder)
    edited("cameras", "right", "may_miss", value=True)(folder)
    assert len(read_clouds(folder, read_rig(folder))[1]) == 4


def test_a_camera_that_hangs_is_warned_of(folder: Path) -> None:
    shutil.copy(folder / "left/depth/001.png", folder / "left/depth/002.png")
    with pytest.warns(UserWarning, match="left/depth/002.png: the same image as in the frame bef"):
        read_clouds(folder, read_rig(folder))
