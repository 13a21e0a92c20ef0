"""What damaged files once did instead of being refused by name: one small file for each."""

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cv2")

from r2s.estimation import cards, checkpoint
from r2s.recordings import images
from r2s.recordings.clouds import MOST_NUMBERS, read_cloud
from r2s.recordings.datasets import known_bar, read_dataset
from r2s.recordings.force_log import read_force_log
from r2s.recordings.gripper_paths import read_track
from r2s.recordings.manifest import read_manifest
from r2s.recordings.open import load_trajectory
from r2s.recordings.recording import load
from r2s.recordings.segmentation import read_colours
from r2s.recordings.swings import ARRAYS, read_swing

DEEP = "[" * 100_000
PCD = (
    "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 {}\nWIDTH 2\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n0 0 0 7\n1 1 1 {}\n"
)


def chunk(name: bytes, data: bytes, length: int | None = None) -> bytes:
    """A part of a PNG, which may say another length than it has."""
    size = struct.pack(">I", len(data) if length is None else length)
    return size + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(length: int | None = None) -> bytes:
    header = struct.pack(">IIBBBBB", 4, 3, 8, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"tEXt", b"a\0b", length), chunk(b"IEND", b"")
    return images.PNG_START + b"".join(parts)


def arrays(**values: Any):
    return lambda path: np.savez(path, **values)


def recording(**changes: Any):
    """An NPZ of a recording that is none yet."""
    whole = {"meta": "{}", "points": np.zeros((2, 3)), "offsets": [0, 2], "times": [0.0]}
    return arrays(**whole | changes)


def text(content: str | bytes):
    data = content.encode() if isinstance(content, str) else content
    return lambda path: path.write_bytes(data)


def swing(path: Path) -> Any:
    return read_swing(path, known_bar())


def resumed(path: Path) -> Any:
    return checkpoint.load(path, {"kind": "descent"})


def mask(path: Path) -> Any:
    return images.read_mask(path, (4, 3))


META = {"format": "r2s-recording/4", "info": {}}
ODD = [
    # JSON that is nested too deeply, or has numbers beyond 64 bits
    ("a.json", text(DEEP), read_manifest, "no JSON"),
    ("a.json", text(DEEP), read_dataset, "no JSON"),
    ("a.json", text(DEEP), cards.read, "no JSON"),
    ("a.json", text(DEEP), read_track, "no JSON"),
    ("a.json", text(b"\xff\xfe{"), cards.read, "no JSON"),
    ("a.json", text("[1]"), read_dataset, "a JSON object"),
    ("a.json", text('{"times": [0], "positions": {}}'), read_track, "the path: expected"),
    ("a.json", text(f'{{"times": [{10**400}], "positions": [[0, 0, 0]]}}'), read_track, "times"),
    # arrays of other things than numbers
    ("a.npz", recording(meta="3"), load, "format 3"),
    ("a.npz", recording(meta=DEEP), load, "recursion"),
    ("a.npz", recording(meta=json.dumps(META), offsets=np.zeros(0)), load, "offsets"),
    ("a.npz", recording(meta=json.dumps(META), offsets=np.array([0.0, 2.0])), load, "offsets"),
    ("a.npz", recording(meta=json.dumps(META), points=np.zeros(())), load, "points must have"),
    ("a.npz", recording(points=np.zeros(3, [("x", "f4")])), load, "points: expected numbers"),
    ("a.npz", arrays(x=np.array("text"), faces=[[0, 1, 2]]), load_trajectory, "x: expected numb"),
    ("a.npz", arrays(x=np.zeros((1, 0, 3)), faces=[[0, 1, 2]]), load_trajectory, "faces must be"),
    ("a.npz", arrays(**dict.fromkeys(ARRAYS, np.zeros(()))), swing, "points must be"),
    ("a.npz", arrays(checkpoint='{"format": "r2s-checkpoint/1", "run": 3}'), resumed, "no check"),
    # images and clouds whose headers promise more than they have, or nothing
    ("a.png", text(png()), mask, "damaged PNG"),
    ("a.png", text(png(40)), mask, "damaged PNG"),
    ("a.jpg", text(b""), lambda path: images.read_colour(path, (4, 3)), "damaged or truncated"),
    ("a.pcd", text(PCD.format(f"{MOST_NUMBERS + 1}", 7)), read_cloud, "numbers a point"),
    ("a.pcd", text(PCD.format("1", "7 7")), read_colours, "its colours cannot be read"),
    ("a.pcd", text(PCD.format("1", "7\n2 2 2 7")), read_colours, "promises 2 points, found 3"),
]


@pytest.mark.parametrize(("name", "write", "read", "words"), ODD)
def test_an_odd_file_is_refused_by_name(tmp_path: Path, name, write, read, words: str) -> None:
    if name.endswith("pcd"):
        pytest.importorskip("pypcd4")
    write(tmp_path / name)
    with pytest.raises(ValueError, match=words) as error:
        read(tmp_path / name)
    assert type(error.value) is ValueError  # no JSONDecodeError, no UnicodeDecodeError
    assert str(tmp_path / name) in str(error.value)


def test_an_error_shows_the_beginning_of_what_is_long(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text(f"time_s,force_N\n0,0\n1,{'x' * 90_000}\n")
    with pytest.raises(ValueError, match="line 3: expected a finite number") as error:
        read_force_log(log)
    assert len(str(error.value)) < 1000
