"""Paths of grippers with their own times, and tools that turn."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from r2s.recordings.gripper_paths import merged, read_track, with_tool

TIMES = np.array([10.0, 10.5, 11.5])
PLACES = np.array([[0.1, 0.2, 0.3], [0.1, 0.2, 0.4], [0.3, 0.2, 0.4]])
TURNS = Rotation.from_rotvec(np.radians([[0, 0, 0], [0, 0, 45], [0, 0, 90]]))


def rows(scale=1.0):
    return np.column_stack([TIMES, scale * PLACES, TURNS.as_quat()])


def write(path, kind):
    """The same track in each format; quaternions of npz and json are w first."""
    quaternions = TURNS.as_quat()[:, [3, 0, 1, 2]]
    lines = [",".join(map(repr, row.tolist())) for row in rows(1e3 if kind == "csv" else 1.0)]
    if kind == "csv":
        header = "time [s],x [mm],y [mm],z [mm],qx,qy,qz,qw\n"
        path.write_text(header + "\n".join(lines) + "\n")
    elif kind == "tum":
        text = "\n".join(line.replace(",", " ") for line in lines)
        path.write_text("# timestamp tx ty tz qx qy qz qw\n" + text + "\n")
    elif kind == "npz":
        np.savez(path, times=TIMES, positions=PLACES, quaternions=quaternions)
    else:
        stored = {"times": TIMES, "positions": PLACES, "quaternions": quaternions}
        path.write_text(json.dumps({name: array.tolist() for name, array in stored.items()}))


@pytest.mark.parametrize("kind", ["csv", "tum", "npz", "json"])
def test_a_track_is_the_same_in_every_format(tmp_path, kind):
    path = tmp_path / f"path.{kind}"
    write(path, kind)
    track = read_track(path, "wxyz")
    assert track.times is not None
    np.testing.assert_allclose(track.times, TIMES)
    np.testing.assert_allclose(track.positions[:, 0], PLACES, atol=1e-12)
    assert track.turns is not None
    np.testing.assert_allclose((track.turns * TURNS.inv()).magnitude(), 0, atol=1e-7)


def test_a_tool_that_turns_carries_the_cloth_on_an_arc(tmp_path):
    """It holds the cloth 0.1 m along its x axis, and turns by 45 degrees between knots."""
    path = tmp_path / "path.tum"
    write(path, "tum")
    finer, offset = with_tool(read_track(path), (0.1, 0.0, 0.0))
    assert finer.times is not None
    held = finer.positions[:, 0] + offset[:, 0]
    np.testing.assert_allclose(held[[0, -1]], PLACES[[0, -1]] + [[0.1, 0, 0], [0, 0.1, 0]])
    np.testing.assert_allclose(np.linalg.norm(held - finer.positions[:, 0], axis=1), 0.1)
    angle = np.interp(finer.times, TIMES, np.radians([0, 45, 90]))  # slerp: at an even rate
    np.testing.assert_allclose(offset[:, 0, 0], 0.1 * np.cos(angle), atol=1e-9)


def test_tracks_of_two_grippers_are_joined_at_all_knots(tmp_path):
    path = tmp_path / "path.tum"
    write(path, "tum")
    one = read_track(path)
    late = one._replace(times=TIMES + 0.25)
    both = merged([one, late])
    assert both.times is not None and len(both.times) == 6 and both.positions.shape == (6, 2, 3)
    np.testing.assert_allclose(both.positions[0, 1], PLACES[0])  # rests before its own begins
    np.testing.assert_allclose(both.positions[1, 0], (PLACES[0] + PLACES[1]) / 2)
    rounded = merged([one, one._replace(times=TIMES + 1e-6)])
    assert rounded.times is not None and len(rounded.times) == 3
    with pytest.raises(ValueError, match="some of the grippers' files have times"):
        merged([one, one._replace(times=None)])


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "time_s,x,y\n0,1,2\n1,2,3\n", "expected one column 'z'"),
        ("a.csv", "time_s,x,y,z\n0,1,2,3\n0,2,3,4\n", "times must increase"),
        ("a.tum", "0 1 2 3\n100 1 2 3\n200 1 2 3\n", "100 s apart: give times in seconds"),
        ("a.tum", "0 1 2 3 4\n", "expected 4 or 8 numbers a line"),
        ("a.tum", "0 1 2 3 0 0 0 2\n", "a quaternion of length 2, expected 1"),
        ("a.json", '{"times": [0]}', "expected an object with times and positions"),
        ("a.json", '{"times": [0, 1], "positions": [[0, 0, 0]]}', "must have the shape"),
        (
            "a.json",
            '{"times": [0], "positions": [[0, 0, 0]], "quaternions": [[1, 0, 0, 0]]}',
            'say their quaternion_order, "xyzw" or "wxyz"',
        ),
        ("a.yaml", "", "unknown suffix '.yaml', expected one of .npy, .csv"),
    ],
)
def test_a_bad_file_is_named_with_what_is_wrong(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=words) as error:
        read_track(tmp_path / name)
    assert str(error.value).startswith(str(tmp_path / name))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file, which gripper.file names"):
        read_track(tmp_path / "lift.csv")
