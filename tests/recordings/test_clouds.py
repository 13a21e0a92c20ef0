"""Point clouds in files: round trips in every format, and errors that help."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from r2s.recordings.clouds import read_cloud

POINTS = arrays(
    np.float32,
    st.tuples(st.integers(1, 12), st.just(3)),
    elements=st.floats(-1e3, 1e3, width=32, allow_subnormal=False),
)
FORMATS = ["npy", "ascii.ply", "binary.ply", "obj", "blank.xyz", "comma.xyz"]
FORMATS += ["ascii.pcd", "binary.pcd"]
PLY = (
    "ply\nformat {}\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "end_header\n"
)
PCD = (
    "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {0}\nDATA {1}\n"
)
some_example = settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def rows(points: np.ndarray, separator: str = " ", start: str = "") -> bytes:
    lines = (start + separator.join(repr(float(value)) for value in point) for point in points)
    return "".join(line + "\n" for line in lines).encode()


def write_cloud(path: Path, points: np.ndarray) -> Path:
    binary = points.astype("<f4").tobytes()
    count = len(points)
    match path.name:
        case "npy":
            np.save(path := path.with_suffix(".npy"), points)
            return path
        case "ascii.ply":
            data = PLY.format("ascii 1.0", count).encode() + rows(points)
        case "binary.ply":
            data = PLY.format("binary_little_endian 1.0", count).encode() + binary
        case "obj":
            path = path.with_suffix(".obj")
            data = b"# a comment\n" + rows(points, start="v ") + b"vn 0 0 1\nf 1 1 1\n"
        case "blank.xyz":
            data = b"# x y z\n" + rows(points)
        case "comma.xyz":
            data = rows(points, ", ")
        case "ascii.pcd":
            data = PCD.format(count, "ascii").encode() + rows(points)
        case _:
            data = PCD.format(count, "binary").encode() + binary
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("kind", FORMATS)
@some_example
@given(points=POINTS)
def test_a_cloud_is_read_as_it_was_written(tmp_path: Path, kind: str, points: np.ndarray) -> None:
    read = read_cloud(write_cloud(tmp_path / kind, points))
    assert read.dtype == np.float64
    np.testing.assert_array_equal(read, points)


@pytest.mark.parametrize("kind", FORMATS)
def test_nan_is_counted_and_located_and_an_empty_cloud_refused(tmp_path: Path, kind: str) -> None:
    points = np.ones((5, 3), np.float32)
    points[2, 1], points[4, 0] = np.nan, np.inf
    for bad, words in (
        (points, "2 of 5 are not finite, the first is number 2"),
        (points[:0], "empty"),
    ):
        path = write_cloud(tmp_path / kind, bad)
        with pytest.raises(ValueError, match=words) as error:
            read_cloud(path)
        assert str(path) in str(error.value)


@pytest.mark.parametrize("kind", ["npy", "ascii.ply", "binary.ply", "ascii.pcd", "binary.pcd"])
@pytest.mark.parametrize("lost", [5, 12])  # a part of a point, and a whole one of 12 bytes
def test_a_truncated_file_is_refused(tmp_path: Path, kind: str, lost: int) -> None:
    path = write_cloud(tmp_path / kind, np.full((6, 3), 1.5, np.float32))  # 12 bytes as text also
    path.write_bytes(path.read_bytes()[:-lost])
    with pytest.raises(ValueError, match="cannot be read as") as error:
        read_cloud(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("suffix", ["npy", "ply", "xyz", "pcd"])
@pytest.mark.parametrize("junk", [b"garbage\n", b"\xff\xfe\x00\x93"])
def test_junk_is_refused(tmp_path: Path, suffix: str, junk: bytes) -> None:
    path = tmp_path / f"cloud.{suffix}"
    path.write_bytes(junk)
    with pytest.raises(ValueError, match=f"cloud.{suffix}: cannot be read as {suffix}"):
        read_cloud(path)


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("two.xyz", "1 2\n3 4\n5 6\n", r"\(3, 2\)"),
        ("ragged.xyz", "1 2 3\n4 5\n", "columns changed from 3 to 2"),
        ("two.obj", "v 1 2\nv 3 4\nv 5 6\n", r"\(3, 2\)"),
        ("text.npy", np.array([["a", "b", "c"]]), "expected real numbers"),
        ("flat.npy", np.zeros(6), r"shape \(point, 3\), found \(6,\)"),
        ("wide.npy", np.zeros((3, 4)), r"found \(3, 4\)"),
        ("a.las", "1 2 3", r"unknown suffix '.las'.*\.npy, \.ply, \.obj"),
    ],
)
def test_what_is_no_cloud_is_named(tmp_path: Path, name: str, content, words: str) -> None:
    if isinstance(content, str):
        (tmp_path / name).write_text(content)
    else:
        np.save(tmp_path / name, content)
    with pytest.raises(ValueError, match=f"{name}: .*{words}"):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize("suffix", ["npy", "ply", "obj", "xyz", "pcd", "e57"])
def test_a_missing_file_is_named(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(FileNotFoundError, match=f"nowhere.{suffix}"):
        read_cloud(tmp_path / f"nowhere.{suffix}")


@pytest.mark.parametrize(
    "library, suffix, extra",
    [("trimesh", "ply", "study"), ("pye57", "e57", "e57"), ("pypcd4", "pcd", "pcd")],
)
def test_a_missing_library_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str, suffix: str, extra: str
) -> None:
    (tmp_path / f"a.{suffix}").write_bytes(b"ply\n")
    monkeypatch.setitem(sys.modules, library, None)  # makes the import fail
    with pytest.raises(ImportError, match=rf"pip install 'r2s\[{extra}\]'"):
        read_cloud(tmp_path / f"a.{suffix}")
