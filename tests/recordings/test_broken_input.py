"""Broken recordings: each gives an error that names the file or frame, and what to do."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rgbd_scene import TIMES, write

from r2s.recordings.images import encode_png
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


def cut(name: str, share: float = 0.5) -> Break:
    def shorten(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(share * len(data))])

    return shorten


def image(name: str, values: Any) -> Break:
    return lambda folder: (folder / name).write_bytes(encode_png(np.asarray(values)))


def depths(change: Callable[[np.ndarray], np.ndarray]) -> Break:
    """The depth of the left camera as NPY of metres, changed."""

    def rewrite(folder: Path) -> None:
        from r2s.recordings.images import read_depth

        edited(*LEFT, "depth_scale", value=1.0)(folder)
        for path in sorted((folder / "left" / "depth").iterdir()):
            np.save(path.with_suffix(".npy"), change(read_depth(path, 1e-3, (160, 120))))
            path.unlink()

    return rewrite


def text(name: str, content: str) -> Break:
    return lambda folder: (folder / name).write_text(content)


def inverse(pose: list[list[float]]) -> list[list[float]]:
    turned = np.linalg.inv(pose)
    turned[3] = [0, 0, 0, 1]
    return turned.tolist()


def swap_poses(folder: Path) -> None:
    whole = json.loads((folder / "cameras.json").read_text())
    left, right = whole["cameras"].values()
    left["to_world"], right["to_world"] = right["to_world"], left["to_world"]
    (folder / "cameras.json").write_text(json.dumps(whole))


def duplicate(folder: Path) -> None:
    shutil.copy(folder / "left/depth/001.png", folder / "left/depth/left_0001.png")


BROKEN: dict[str, tuple[Break, str]] = {
    # files and frames
    "missing camera": (removed("right"), "wave/right: no folder of the camera 'right'.*restore it"),
    "missing masks": (removed("left/masks"), "left/masks: no such folder: segment.*SAM 2"),
    "missing depth": (removed("left/depth/001.png"), "left/depth: frame 1 is missing.*restore"),
    "missing last depth": (removed("left/depth/003.png"), "left/depth: frame 3 .*export it again"),
    "missing mask": (removed("right/masks/003.png"), "right/masks: frame 3 .*export it again"),
    "missing colour": (
        lambda folder: ((folder / "right/colour").mkdir(), text("right/colour/1.png", "")(folder)),
        "right/colour: frame 0 is missing",
    ),
    "duplicate frame": (duplicate, "left/depth: frame 1 is there twice: .*remove one"),
    # images
    "truncated PNG": (cut("left/depth/002.png"), "left/depth/002.png: truncated PNG.*again"),
    "truncated mask": (cut("left/masks/002.png"), "left/masks/002.png: truncated PNG"),
    "no PNG": (text("left/depth/002.png", "JFIF"), "left/depth/002.png: no PNG.*: export it as"),
    "damaged NPY": (
        lambda folder: (depths(lambda d: d)(folder), cut("left/depth/001.npy")(folder)),
        "left/depth/001.npy: damaged NPY.*copy it again",
    ),
    "wrong image size": (
        image("right/depth/001.png", np.ones((60, 80), np.uint16)),
        "right/depth/001.png: the image has 80 x 60 pixels, cameras.json says 160 x 120: export",
    ),
    "mask of another size": (
        image("right/masks/001.png", np.ones((480, 640), np.uint8)),
        "right/masks/001.png: the image has 640 x 480 pixels.*make the masks in the pixels of the",
    ),
    "8-bit depth": (
        image("left/depth/000.png", np.ones((120, 160), np.uint8)),
        "left/depth/000.png: expected depth as a 16-bit PNG.*found 8 bits in 1: export the raw",
    ),
    "colour for depth": (
        image("left/depth/000.png", np.ones((120, 160, 3), np.uint8)),
        "left/depth/000.png: expected depth.* of one channel, found 8 bits in 3",
    ),
    "negative depth": (
        depths(lambda depth: depth - 0.5),
        r"left/depth/000.npy: \d+ depths are negative, the least is -0.*0 where unknown",
    ),
    "no depth": (depths(lambda depth: depth * np.nan), "left/depth/000.npy: no pixel.*drop the fr"),
    "millimetres for metres": (
        edited(*LEFT, "depth_scale", value=1.0),
        r"left/depth/000.png: the median depth is \d+ m with depth_scale 1: .*0.001 for millimet",
    ),
    "metres for millimetres": (
        lambda folder: (
            depths(lambda d: d)(folder),
            edited(*LEFT, "depth_scale", value=0.001)(folder),
        ),
        r"left/depth/000.npy: the median depth is 0.000\d+ m .*1 for metres",
    ),
    "empty mask": (
        image("right/masks/001.png", np.zeros((120, 160), np.uint8)),
        'right/masks/001.png: the mask is empty: segment the frame again, or set "may_miss"',
    ),
    "full mask": (
        image("left/masks/003.png", np.ones((120, 160), np.uint8)),
        "left/masks/003.png: the mask marks every pixel: write 0 where the fabric is not",
    ),
    "mask of another place": (
        image("left/depth/000.png", np.pad(np.full((9, 9), 700, np.uint16), ((0, 111), (0, 151)))),
        "left/depth/000.png: no depth behind the mask .*left/masks/000.png: check that masks and",
    ),
    # calibration
    "no JSON": (cut("cameras.json"), "cameras.json: no JSON: "),
    "no cameras.json": (removed("cameras.json"), "wave: no cameras.json.*: write one"),
    "unknown key": (edited(*LEFT, "fx", value=900), "cameras.json: cameras: left: unknown: fx"),
    "unknown scale": (
        edited("cameras", value=lambda c: {"left": dict(c["left"], depth_scale=None)}),
        "cameras.json: cameras: left: depth_scale is unknown: give metres per unit",
    ),
    "zero scale": (edited(*LEFT, "depth_scale", value=0), "left: depth_scale must be.*give metres"),
    "other resolution": (
        edited(*LEFT, "centre", value=[319.5, 239.5]),
        "cameras.json: cameras: left: centre .* far from the middle of 160 x 120 pixels.*Scale",
    ),
    "no rotation": (
        edited(*LEFT, "to_world", value=(2 * np.eye(4) - np.diag([0, 0, 0, 1])).tolist()),
        "cameras.json: cameras: left: to_world is no rotation and shift.*as columns",
    ),
    "mirrored": (
        edited(*LEFT, "to_world", value=np.diag([1.0, 1, -1, 1]).tolist()),
        "cameras.json: cameras: left: to_world is no rotation",
    ),
    "transposed pose": (
        edited(*LEFT, "to_world", value=lambda pose: np.transpose(pose).tolist()),
        "left: to_world must end with the row 0 0 0 1.*transpose it",
    ),
    "pose in millimetres": (
        edited(*LEFT, "to_world", value=lambda p: [[*r[:3], 1e3 * r[3]] for r in p[:3]] + p[3:]),
        "left: to_world puts the camera at .* m away: give its position in metres",
    ),
    "world to camera": (
        edited(*LEFT, "to_world", value=inverse),
        "left/depth/000.png: 0% of .*'left' are in the workspace.*its inverse .is it world to cam",
    ),
    "OpenGL axes": (
        edited(*LEFT, "to_world", value=lambda p: (np.array(p) @ np.diag([1, -1, -1, 1])).tolist()),
        "left/depth/000.png: 0% of .*OpenGL",
    ),
    "swapped": (swap_poses, r"wave: the first frames of 'left' and 'right' .*are the two swapped"),
    "no overlap with the workspace": (
        edited("clean", "workspace", value=[[5, 5, 5], [6, 6, 6]]),
        "left/depth/000.png: 0% of .* lie around .* m: check to_world, depth_scale and workspace",
    ),
    "workspace without inside": (
        edited("clean", "workspace", value=[[1, 1, 1], [0, 0, 0]]),
        r"cameras.json: clean: workspace must be \[least, greatest\] corner",
    ),
    # clocks
    "unsorted times": (
        text("left/times.csv", "frame,time\n0,0\n1,0.2\n2,0.1\n3,0.3\n"),
        "left/times.csv: line 4: 0.1 s is there before the time of the line above.*sort the frames",
    ),
    "duplicate times": (
        text("left/times.csv", "0\n0.1\n0.1\n0.3\n"),
        "left/times.csv: line 3: 0.1 s is there twice.*drop those that are repeated",
    ),
    "milliseconds": (text("left/times.csv", "0\n66\n133\n200\n"), "67 s apart: .*in seconds"),
    "no numbers": (
        text("left/times.csv", "0\n0.1\n12:00:01\n0.3\n"),
        "left/times.csv: line 3: expected a time .s. last, found '12:00:01': write a number",
    ),
    "another encoding": (
        lambda folder: (folder / "left/times.csv").write_bytes(b"Zeit in s, f\xfcr alle\n0\n"),
        "left/times.csv: no text in UTF-8 .*: export it again",
    ),
    "too few times": (text("left/times.csv", "0\n0.1\n"), "left/times.csv: 2 times, but 4 frames"),
    "no times": (removed("left/times.csv"), "left/times.csv: no such file, and no frame_rate"),
    "no common time": (
        text("right/times.csv", "".join(f"{9 + t}\n" for t in TIMES)),
        "wave: the cameras never ran at once: .*check that they share a clock",
    ),
    "frame without partner": (
        text("right/times.csv", "0\n0.12\n0.133\n0.2\n"),
        "wave: frame 1 of left at 0.066.* s has no frame of right within .*restore the frame",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_images_are_named_with_a_remedy(folder: Path, case: str) -> None:
    break_it, words = BROKEN[case]
    break_it(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=words) as error:
        read_clouds(folder, read_rig(folder))
    assert str(folder) in str(error.value)


def test_a_fabric_out_of_view_may_be_declared(folder: Path) -> None:
    image("right/masks/001.png", np.zeros((120, 160), np.uint8))(folder)
    edited("cameras", "right", "may_miss", value=True)(folder)
    assert len(read_clouds(folder, read_rig(folder))[1]) == 4


def test_a_camera_that_hangs_is_warned_of(folder: Path) -> None:
    shutil.copy(folder / "left/depth/001.png", folder / "left/depth/002.png")
    with pytest.warns(UserWarning, match="left/depth/002.png: the same image as in the frame bef"):
        read_clouds(folder, read_rig(folder))
