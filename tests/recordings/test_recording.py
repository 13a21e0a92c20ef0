"""Recordings: what makes one, thinning, and files that are whole or not there."""

import errno
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from r2s.recordings.recording import (
    STILL,
    Recording,
    RecordingInfo,
    SheetPlacement,
    cloud,
    corner,
    first_motion,
    load,
    make_recording,
    save,
    set_time_offset,
    subsample,
)

SHEET = SheetPlacement(
    size=(0.3, 0.2),
    origin=(0.1, 0.0, 0.05),
    warp=(0.0, 1.0, 0.0),
    weft=(-1.0, 0.0, 0.0),
    pinned=("opposite",),
)
INFO = RecordingInfo(
    name="lift_tan",
    scenario="lift",
    fabric="tan",
    trial="1",
    source="made up",
    frames_used=(0, 1),
    sheet=SHEET,
    table_height=0.05,
    verified=None,
)
CLOUDS = st.lists(
    arrays(
        np.float32,
        st.tuples(st.integers(1, 9), st.just(3)),
        elements=st.floats(-10, 10, width=32, allow_subnormal=False),
    ),
    min_size=2,
    max_size=5,
)


def record(clouds: list[Any] | None, info: RecordingInfo = INFO, **changes: Any) -> Recording:
    fields = {
        "times": np.arange(2 if clouds is None else len(clouds)) * 0.1 - 0.05,
        "gripper_path": np.linspace(0, 1, 36).reshape(12, 3),
        "gripper_times": np.arange(12) * 0.1,
    } | changes
    return make_recording(clouds, info=info, **fields)


def ones(*counts: int) -> list[np.ndarray]:
    return [np.full((count, 3), 0.5) for count in counts]


def test_the_import_needs_no_extras() -> None:
    code = (
        "import sys; extras = 'trimesh', 'pypcd4', 'cv2', 'matplotlib', 'tqdm';"
        "sys.modules.update(dict.fromkeys(extras));"
        "import r2s.recordings.recording, r2s.recordings.clouds, r2s.recordings.manifest"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@given(clouds=CLOUDS)
@settings(max_examples=20, deadline=None)
def test_padding_keeps_the_points(clouds: list[np.ndarray]) -> None:
    recording = record(clouds)
    assert recording.points.shape == (len(clouds), max(map(len, clouds)), 3)
    assert recording.points.dtype == jnp.asarray(0.0, float).dtype
    assert not np.asarray(recording.points)[~np.asarray(recording.mask)].any()
    for frame, points in enumerate(clouds):
        np.testing.assert_array_equal(cloud(recording, frame), points)
    with pytest.raises(IndexError):
        cloud(recording, len(clouds))


def test_one_gripper_gets_its_axis_and_two_keep_theirs() -> None:
    assert record(ones(3, 4)).gripper_path.shape == (12, 1, 3)
    two = replace(INFO, sheet=replace(SHEET, pinned=("origin", "warp")))
    assert record(ones(3, 4), two, gripper_path=np.zeros((12, 2, 3))).gripper_path.shape[1] == 2


@pytest.mark.parametrize(
    "bad, words",
    [
        (np.zeros((0, 3)), "frame 1: the cloud is empty"),
        (np.array([[0, 1, np.nan], [0, 0, 0]]), "frame 1: the cloud: 1 of 2 are not finite"),
        (np.zeros((4, 2)), r"frame 1: the cloud .*shape \(point, 3\), found \(4, 2\)"),
        ([["a", "b", "c"]], "frame 1: the cloud: expected an array of numbers"),
        ([[1, 2, 3], [4, 5]], "frame 1: the cloud: expected an array of numbers"),
    ],
)
def test_a_bad_cloud_names_its_frame(bad: Any, words: str) -> None:
    with pytest.raises(ValueError, match=f"recording lift_tan: {words}"):
        record([np.ones((2, 3)), bad])


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"times": [0.0, 0.1, 0.2]}, r"times .* must have the shape \(2\), found \(3,\)"),
        ({"times": [0.1, 0.1]}, "times must increase"),
        ({"times": [0.2, 0.1]}, "times must increase: 0.2 s at 0, then 0.1 s"),
        ({"times": [0.0, np.nan]}, "times .*not finite"),
        ({"times": [0.0, 1.25]}, r"ends at 1.1 s, before the last frame at 1.25 s"),
        ({"gripper_path": np.zeros((12, 2))}, r"path .* \(knot, gripper, 3\), found \(12, 1, 2\)"),
        ({"gripper_path": np.zeros((12, 2, 3))}, "path has 2 grippers, the sheet is pinned at"),
        ({"gripper_path": np.zeros((0, 3))}, "the gripper path .*is empty"),
        ({"gripper_path": np.full((12, 3), np.inf)}, "the gripper path .*not finite"),
        ({"gripper_times": np.arange(11.0)}, r"gripper_times .*must have the shape \(12\)"),
        ({"gripper_times": np.zeros(12)}, "gripper_times must increase"),
        ({"force": [1.0, 2.0]}, "give both or neither"),
        ({"force_times": [1.0, 2.0]}, "give both or neither"),
        ({"force": [[1.0, 2.0]], "force_times": [0.0]}, r"\(sample, 3\), found \(1, 2\)"),
        ({"force": [], "force_times": []}, r"force .*is empty"),
        ({"force": [1.0, np.nan], "force_times": [0.0, 1.0]}, "force .*first is number 1: nan"),
        ({"force": [1.0, 2.0], "force_times": [0.0]}, r"force_times .*must have the shape \(2\)"),
        ({"force": [1.0, 2.0], "force_times": [0.2, 0.1]}, "force_times must increase: .*sort"),
        ({"markers": np.zeros((3, 4, 3))}, "markers in 3 frames, but clouds in 2"),
        ({"markers": np.zeros((2, 4, 2))}, r"markers must be \(frame, marker, 3\)"),
        ({"markers_seen": np.ones((2, 4), bool)}, "markers_seen without markers"),
        (
            {"markers": np.zeros((2, 4, 3)), "markers_seen": np.ones((2, 4))},
            r"markers_seen must be \(2, 4\) of bool, found \(2, 4\) of float64",
        ),
        (
            {"markers": np.full((2, 4, 3), np.nan), "markers_seen": np.ones((2, 4), bool)},
            "frame 0: marker 0 is seen, but its place is not finite",
        ),
        ({"marker_places": np.zeros((4, 2))}, "marker_places without markers"),
        (
            {"markers": np.zeros((2, 1, 3)), "marker_places": [[9.0, 0.0]]},
            "marker_places must lie on the sheet",
        ),
    ],
)
def test_what_does_not_belong_together_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=f"recording lift_tan: .*{words}"):
        record(ones(3, 4), **changes)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"frames_used": (1, 2)}, r"frames_used is 1\.\.2, but there are 2 frames"),
        ({"wind": (0.0, np.inf, 0.0)}, "wind must be three finite numbers"),
        ({"time_offset": np.nan}, "time_offset must be finite"),
        ({"angle": 45.0}, "angle is that of a stretching"),
    ],
)
def test_a_bad_description_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        record(ones(3, 4), replace(INFO, **change))
    with pytest.raises(ValueError, match="there are 0 frames"):
        record([])


def test_times_that_single_precision_cannot_part_are_refused() -> None:
    since_1970 = np.array([1.7e9, 1.7e9 + 0.1])
    changes = {"times": since_1970, "gripper_times": since_1970[0] + np.arange(12.0)}
    if jax.config.read("jax_enable_x64"):
        assert record(ones(3, 4), **changes).times[1] > 1.7e9
    else:
        with pytest.raises(ValueError, match="must increase.* as float32"):
            record(ones(3, 4), **changes)


def test_corners_of_a_sheet() -> None:
    corners = [corner(SHEET, name) for name in ("origin", "warp", "weft", "opposite")]
    expected = [[0.1, 0, 0.05], [0.1, 0.3, 0.05], [-0.1, 0, 0.05], [-0.1, 0.3, 0.05]]
    np.testing.assert_allclose(corners, expected, atol=1e-15)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"size": (0.3, -0.2)}, "sides must be positive"),
        ({"size": (np.nan, 0.2)}, "sides must be positive"),
        ({"origin": (0.0, np.inf, 0.0)}, "origin must be finite"),
        ({"warp": (0.0, 1.1, 0.0)}, "orthonormal"),
        ({"warp": (-1.0, 0.0, 0.0)}, "orthonormal"),
        ({"pinned": ("middle",)}, "unknown corner 'middle'.*'opposite'"),
    ],
)
def test_a_bad_sheet_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(SHEET, **change)


def test_subsample_has_static_shapes_and_a_seed_and_moves_no_point_without_a_voxel() -> None:
    rng = np.random.default_rng(0)
    recording = record([rng.uniform(size=(count, 3)) for count in (400, 5, 90)])
    thin = subsample(recording, 50, 0.05, seed=3)
    assert thin.points.shape == (3, 50, 3) and thin.info == recording.info
    assert np.asarray(thin.mask).sum(axis=1).tolist() == [50, 5, 50]
    assert len(np.unique(cloud(thin, 0), axis=0)) == 50  # none is drawn twice
    again, other = subsample(recording, 50, 0.05, seed=3), subsample(recording, 50, 0.05, seed=4)
    np.testing.assert_array_equal(thin.points, again.points)
    assert (np.asarray(thin.points)[0] != np.asarray(other.points)[0]).any()
    unmoved = cloud(subsample(recording, 50, None, seed=0), 0)
    assert {tuple(point) for point in unmoved} <= {tuple(point) for point in cloud(recording, 0)}
    for num_points, voxel, words in ((0, 0.01, "num_points must be at least 1"), (5, 0.0, "voxel")):
        with pytest.raises(ValueError, match=words):
            subsample(recording, num_points, voxel, seed=0)


@given(clouds=CLOUDS, voxel=st.floats(0.01, 5))
@settings(max_examples=20, deadline=None)
def test_subsample_makes_one_mean_of_a_voxel(clouds: list[np.ndarray], voxel: float) -> None:
    thin = subsample(record(clouds), 9, voxel, seed=0)
    for frame, points in enumerate(clouds):
        cells = np.floor(points.astype(np.float64) / voxel)
        means = [points[(cells == cell).all(axis=1)].mean(0) for cell in np.unique(cells, axis=0)]
        np.testing.assert_allclose(cloud(thin, frame), means, atol=1e-5)


FINITE = st.floats(-1e3, 1e3, allow_subnormal=False)


@given(
    clouds=CLOUDS,
    force=arrays(float, st.sampled_from([(4,), (4, 3), (1,)]), elements=FINITE),
    covered=st.integers(0, 5),
    wind=st.none() | st.tuples(FINITE, FINITE, FINITE),
    time_offset=st.floats(-1, 1),
    fabric=st.text(max_size=5),
)
@settings(max_examples=30, deadline=None)
def test_a_recording_survives_its_file(
    tmp_path_factory, clouds, force, covered, wind, time_offset, fabric
) -> None:
    markers = np.arange(len(clouds) * 18.0).reshape(-1, 6, 3)
    markers[1, covered] = np.nan
    recording = record(
        clouds,
        replace(INFO, wind=wind, time_offset=time_offset, fabric=fabric),
        force=force,
        force_times=np.arange(len(force)) * 0.03,
        markers=markers,
    )
    path = tmp_path_factory.mktemp("saved") / "a.npz"
    save(recording, path)
    loaded = load(path)
    assert loaded.info == recording.info and hash(loaded.info) == hash(recording.info)
    for before, after in zip(jax.tree.leaves(recording), jax.tree.leaves(loaded), strict=True):
        assert before.dtype == after.dtype
        np.testing.assert_array_equal(before, after)
    seen = np.asarray(loaded.markers_seen)
    assert np.argwhere(~seen).tolist() == [[1, covered]]
    np.testing.assert_array_equal(np.asarray(loaded.markers)[seen], markers[seen])
    assert not np.asarray(loaded.markers)[~seen].any()  # no NaN gets into a loss


def test_a_file_of_the_first_version_is_read(tmp_path: Path) -> None:
    save(record(ones(3, 4)), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as file:
        meta = json.loads(str(file["meta"]))
    meta["format"] = "r2s-recording/1"
    for later in ("wind", "time_offset"):
        del meta["info"][later]
    resave(tmp_path / "a.npz", meta=np.array(json.dumps(meta)))
    loaded = load(tmp_path / "a.npz")
    assert loaded.info == INFO and loaded.force is None and loaded.markers is None
    np.testing.assert_array_equal(loaded.points, record(ones(3, 4)).points)


def test_markers_alone_make_the_clouds() -> None:
    markers = np.arange(18.0).reshape(2, 3, 3)
    seen = np.array([[True, True, True], [True, False, True]])
    recording = record(None, markers=markers, markers_seen=seen)
    np.testing.assert_array_equal(cloud(recording, 1), markers[1, [0, 2]])
    with pytest.raises(ValueError, match="frame 1: the cloud is empty"):
        record(None, markers=markers, markers_seen=seen & [[True], [False]])


def test_the_offset_of_the_clocks_can_be_set_again() -> None:
    recording = record(ones(3, 4), replace(INFO, time_offset=-0.05), times=[-0.05, 0.05])
    moved = set_time_offset(recording, 0.1)
    np.testing.assert_allclose(moved.times, [0.1, 0.2], rtol=1e-6)
    assert moved.info.time_offset == 0.1
    np.testing.assert_allclose(set_time_offset(moved, -0.05).times, recording.times, atol=1e-7)
    with pytest.raises(ValueError, match="lift_tan: time offset 2 s: the gripper path ends at 1.1"):
        set_time_offset(recording, 2.0)


def resave(path: Path, **changes: Any) -> None:
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **{k: v for k, v in (arrays | changes).items() if v is not None})


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    save(record(ones(3, 4)), path)
    whole = path.read_bytes()
    for damaged in (b"", b"junk", whole[:100], whole[:-30], whole.replace(b"?", b"@")):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="a.npz: not a readable recording"):
            load(path)
    with pytest.raises(FileNotFoundError, match="nowhere.npz"):
        load(tmp_path / "nowhere.npz")
    with pytest.raises(FileNotFoundError, match="cannot write .*nowhere/a.npz.*missing"):
        save(record(ones(3, 4)), tmp_path / "nowhere" / "a.npz")


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"meta": np.array('{"format": "r2s-recording/9"}')}, "r2s-recording/9.*expected.*update"),
        ({"meta": np.array('{"format": "r2s-recording/2"}')}, "it lacks 'info'"),
        ({"offsets": np.array([0, 3, 6])}, "number of points, 7"),
        ({"points": None}, "points"),
        ({"times": np.array([0.0])}, r"times .*must have the shape \(2\)"),
        ({"offsets": np.array([0, 0, 7])}, "frame 0: the cloud is empty"),
    ],
)
def test_other_versions_and_wrong_contents_are_refused(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    save(record(ones(3, 4)), tmp_path / "a.npz")
    resave(tmp_path / "a.npz", **changes)
    with pytest.raises(ValueError, match=f"a.npz: not a readable recording.*{words}"):
        load(tmp_path / "a.npz")


def no_space(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_no_space_leaves_the_old_file_and_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.npz"
    save(record(ones(3, 4)), path)
    before = path.read_bytes()
    monkeypatch.setattr(os, "replace", no_space)
    for target in (path, tmp_path / "b.npz"):
        with pytest.raises(OSError, match=f"cannot write {target}.*bytes free") as error:
            save(record(ones(5, 6)), target)
        assert error.value.errno == errno.ENOSPC
    assert list(tmp_path.iterdir()) == [path] and path.read_bytes() == before


KNOTS = np.arange(0, 15, 1 / 120)


@pytest.mark.parametrize("jitter", [0.0, 3e-5, 1.5e-4])  # [m] of each axis: up to 0.5 mm
@pytest.mark.parametrize("speed", [1e-3, 0.2])
def test_a_motion_begins_at_the_last_rest_however_slow_it_is(jitter: float, speed: float) -> None:
    """After 10 s: jitter of a robot at rest is none, a slow pull is one from its begin on."""
    path = jitter * np.random.default_rng(0).standard_normal((len(KNOTS), 1, 3))
    path[:, 0, 2] += speed * np.clip(KNOTS - 10, 0, None)
    begin, shown = first_motion(KNOTS, path)
    assert 10 - 1 / 60 <= begin <= 10 + 1 / 60 + 8 * jitter / speed
    assert shown == pytest.approx(10 + STILL / speed, abs=5 * jitter / speed + 1 / 60)
    assert np.isinf(first_motion(KNOTS[:1000], path[:1000])).all()
