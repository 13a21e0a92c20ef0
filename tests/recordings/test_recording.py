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

from r2s._util.files import write_bytes, write_json
from r2s.recordings.recording import (
    Recording,
    RecordingInfo,
    SheetPlacement,
    cloud,
    corner,
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


def record(clouds: list[Any], info: RecordingInfo = INFO, **changes: Any) -> Recording:
    fields = {
        "times": np.arange(len(clouds)) * 0.1 - 0.05,
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


def test_one_handle_gets_its_axis_and_two_keep_theirs() -> None:
    assert record(ones(3, 4)).gripper_path.shape == (12, 1, 3)
    two = replace(INFO, sheet=replace(SHEET, pinned=("origin", "warp")))
    assert record(ones(3, 4), two, gripper_path=np.zeros((12, 2, 3))).gripper_path.shape[1] == 2
    with pytest.raises(ValueError, match="the path has 2 grippers, the sheet is pinned at"):
        record(ones(3, 4), gripper_path=np.zeros((12, 2, 3)))


@pytest.mark.parametrize(
    "bad, words",
    [
        (np.zeros((0, 3)), "frame 1: the cloud is empty"),
        (np.array([[0, 1, np.nan], [0, 0, 0]]), "frame 1: 1 of 2 points are not finite"),
        (np.zeros((4, 2)), r"frame 1: expected points of shape \(n, 3\), found \(4, 2\)"),
        (np.zeros(3), r"frame 1: .*found \(3,\)"),
        ([["a", "b", "c"]], "frame 1: no array of numbers"),
        ([[1, 2, 3], [4, 5]], "frame 1: no array of numbers"),
    ],
)
def test_a_bad_cloud_names_its_frame(bad: Any, words: str) -> None:
    with pytest.raises(ValueError, match=f"recording lift_tan: {words}"):
        record([np.ones((2, 3)), bad])


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"times": [0.0, 0.1, 0.2]}, r"times must have the shape \(2,\), found \(3,\)"),
        ({"times": [0.1, 0.1]}, "times must increase"),
        ({"times": [0.2, 0.1]}, "times must increase: 0.2 s at 0, then 0.1 s"),
        ({"times": [0.0, np.nan]}, "times must be finite"),
        (
            {"gripper_path": np.zeros((12, 2))},
            r"the gripper path must be \(knot, gripper, 3\), found \(12, 1, 2\)",
        ),
        ({"gripper_path": np.zeros((0, 3))}, "the gripper path must be"),
        ({"gripper_path": np.full((12, 3), np.inf)}, "the gripper path must be finite"),
        ({"gripper_times": np.arange(11.0)}, r"gripper_times must have the shape \(12,\)"),
        ({"gripper_times": np.zeros(12)}, "gripper_times must increase"),
    ],
)
def test_a_bad_clock_or_path_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=f"recording lift_tan: {words}"):
        record(ones(3, 4), **changes)


def test_a_path_that_ends_early_states_both_times() -> None:
    record(ones(3, 4), times=[-0.5, 1.1])
    with pytest.raises(ValueError, match=r"ends at 1.1 s, before the last frame at 1.25 s"):
        record(ones(3, 4), times=[0.0, 1.25])


def test_times_that_single_precision_cannot_part_are_refused() -> None:
    since_1970 = np.array([1.7e9, 1.7e9 + 0.1])
    changes = {"times": since_1970, "gripper_times": since_1970[0] + np.arange(12.0)}
    if jax.config.read("jax_enable_x64"):
        assert record(ones(3, 4), **changes).times[1] > 1.7e9
    else:
        with pytest.raises(ValueError, match="must increase.* as float32"):
            record(ones(3, 4), **changes)


def test_no_frames_and_frames_that_are_not_there() -> None:
    with pytest.raises(ValueError, match="no frames"):
        record([])
    with pytest.raises(ValueError, match=r"frames_used is 1\.\.2, but there are 2 frames"):
        record(ones(3, 4), replace(INFO, frames_used=(1, 2)))


def test_corners_of_a_sheet() -> None:
    np.testing.assert_allclose(corner(SHEET, "origin"), [0.1, 0.0, 0.05])
    np.testing.assert_allclose(corner(SHEET, "warp"), [0.1, 0.3, 0.05])
    np.testing.assert_allclose(corner(SHEET, "weft"), [-0.1, 0.0, 0.05])
    np.testing.assert_allclose(corner(SHEET, "opposite"), [-0.1, 0.3, 0.05])


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


def test_subsample_has_static_shapes_and_a_seed() -> None:
    rng = np.random.default_rng(0)
    recording = record([rng.uniform(size=(count, 3)) for count in (400, 5, 90)])
    thin = subsample(recording, 50, 0.05, seed=3)
    assert thin.points.shape == (3, 50, 3) and thin.info == recording.info
    assert np.asarray(thin.mask).sum(axis=1).tolist() == [50, 5, 50]
    assert len(np.unique(cloud(thin, 0), axis=0)) == 50  # none is drawn twice
    again, other = subsample(recording, 50, 0.05, seed=3), subsample(recording, 50, 0.05, seed=4)
    np.testing.assert_array_equal(thin.points, again.points)
    assert (np.asarray(thin.points)[0] != np.asarray(other.points)[0]).any()
    np.testing.assert_allclose(  # one point a cell: nothing to average
        np.sort(cloud(thin, 1), axis=0), np.sort(cloud(recording, 1), axis=0), rtol=1e-6
    )


@given(clouds=CLOUDS, voxel=st.floats(0.01, 5))
@settings(max_examples=20, deadline=None)
def test_subsample_makes_one_mean_of_a_voxel(clouds: list[np.ndarray], voxel: float) -> None:
    thin = subsample(record(clouds), 9, voxel, seed=0)
    for frame, points in enumerate(clouds):
        cells = np.floor(points.astype(np.float64) / voxel)
        means = [points[(cells == cell).all(axis=1)].mean(0) for cell in np.unique(cells, axis=0)]
        np.testing.assert_allclose(cloud(thin, frame), means, atol=1e-5)


def test_subsample_without_voxel_moves_no_point() -> None:
    clouds = np.random.default_rng(0).uniform(size=(2, 200, 3)).astype(np.float32)
    thin = cloud(subsample(record(list(clouds)), 50, None, seed=0), 0)
    assert len(np.unique(thin, axis=0)) == 50
    assert {tuple(point) for point in thin} <= {tuple(point) for point in clouds[0]}


def test_subsample_refuses_bad_numbers() -> None:
    with pytest.raises(ValueError, match="num_points must be at least 1, found 0"):
        subsample(record(ones(3, 4)), 0, 0.01, seed=0)
    for voxel in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="voxel must be positive"):
            subsample(record(ones(3, 4)), 5, voxel, seed=0)


@pytest.mark.slow(group="motions")
@given(clouds=CLOUDS, verified=st.sampled_from([True, False, None]), fabric=st.text(max_size=5))
@settings(max_examples=20, deadline=None)
def test_save_and_load_give_the_same_recording(
    tmp_path_factory: pytest.TempPathFactory,
    clouds: list[np.ndarray],
    verified: bool | None,
    fabric: str,
) -> None:
    path = tmp_path_factory.mktemp("saved") / "a.npz"
    recording = record(clouds, replace(INFO, verified=verified, fabric=fabric))
    save(recording, path)
    loaded = load(path)
    assert loaded.info == recording.info and hash(loaded.info) == hash(recording.info)
    for name in ("points", "mask", "times", "gripper_path", "gripper_times"):
        before, after = getattr(recording, name), getattr(loaded, name)
        assert before.dtype == after.dtype
        np.testing.assert_array_equal(before, after)


def shapes_of(recording: Recording) -> dict[str, Any]:
    names = [name for name in vars(recording) if name != "info"]
    return {name: None if (v := getattr(recording, name)) is None else v.shape for name in names}


FINITE = st.floats(-1e3, 1e3, allow_subnormal=False)


@given(
    force=arrays(float, st.sampled_from([(4,), (4, 3), (1,)]), elements=FINITE),
    markers=arrays(float, st.sampled_from([(2, 1, 3), (2, 6, 3)]), elements=FINITE),
    lost=st.integers(0, 5),
    wind=st.none() | st.tuples(FINITE, FINITE, FINITE),
    time_offset=st.floats(-1, 1),
)
@settings(max_examples=30, deadline=None)
def test_force_markers_and_wind_survive_the_file(
    tmp_path_factory: pytest.TempPathFactory,
    force: np.ndarray,
    markers: np.ndarray,
    lost: int,
    wind: tuple[float, float, float] | None,
    time_offset: float,
) -> None:
    path = tmp_path_factory.mktemp("saved") / "a.npz"
    if lost < markers.shape[1]:
        markers[1, lost] = np.nan
    recording = record(
        ones(3, 4),
        replace(INFO, wind=wind, time_offset=time_offset),
        force=force,
        force_times=np.arange(len(force)) * 0.03,
        markers=markers,
    )
    save(recording, path)
    loaded = load(path)
    assert loaded.info == recording.info
    assert shapes_of(loaded) == shapes_of(recording)
    for name in shapes_of(loaded):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(recording, name))
    np.testing.assert_allclose(np.asarray(loaded.force), force, rtol=1e-6)
    seen = np.asarray(loaded.markers_seen)
    assert seen.sum() == markers.shape[0] * markers.shape[1] - (lost < markers.shape[1])
    np.testing.assert_allclose(np.asarray(loaded.markers)[seen], markers[seen], rtol=1e-6)
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
    recording = make_recording(
        None, [0.0, 0.1], np.zeros((2, 3)), [0.0, 0.1], INFO, markers=markers, markers_seen=seen
    )
    np.testing.assert_array_equal(cloud(recording, 1), markers[1, [0, 2]])
    blind = seen & [[True], [False]]
    with pytest.raises(ValueError, match="frame 1: the cloud is empty"):
        make_recording(
            None, [0.0, 0.1], np.zeros((2, 3)), [0, 1], INFO, markers=markers, markers_seen=blind
        )


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"force": [1.0, 2.0]}, "give both or neither"),
        ({"force_times": [1.0, 2.0]}, "give both or neither"),
        ({"force": [[1.0, 2.0]], "force_times": [0.0]}, r"or \(sample, 3\) .N., found \(1, 2\)"),
        ({"force": [], "force_times": []}, r"found \(0,\)"),
        ({"force": [1.0, np.nan], "force_times": [0.0, 1.0]}, "found nan in sample 1"),
        ({"force": [1.0, 2.0], "force_times": [0.0]}, r"force_times must have the shape \(2,\)"),
        (
            {"force": [1.0, 2.0, 3.0], "force_times": [0.0, 0.2, 0.1]},
            "force_times must increase: 0.2 s at 1, then 0.1 s.*sort them, drop repeated",
        ),
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
    ],
)
def test_a_bad_force_or_marker_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=f"recording lift_tan: .*{words}"):
        record(ones(3, 4), **changes)


def test_bad_wind_and_offset_are_refused() -> None:
    with pytest.raises(ValueError, match="wind must be three finite numbers"):
        replace(INFO, wind=(0.0, np.inf, 0.0))
    with pytest.raises(ValueError, match="time_offset must be finite"):
        replace(INFO, time_offset=np.nan)


def test_the_offset_of_the_clocks_can_be_set_again() -> None:
    recording = record(ones(3, 4), replace(INFO, time_offset=-0.05), times=[-0.05, 0.05])
    moved = set_time_offset(recording, 0.1)
    np.testing.assert_allclose(moved.times, [0.1, 0.2], rtol=1e-6)
    assert moved.info.time_offset == 0.1
    np.testing.assert_allclose(set_time_offset(moved, -0.05).times, recording.times, atol=1e-7)
    with pytest.raises(ValueError, match="lift_tan: time offset 2 s: the gripper path ends at 1.1"):
        set_time_offset(recording, 2.0)


def test_a_recording_goes_through_jit() -> None:
    total = jax.jit(lambda r: jnp.where(r.mask[..., None], r.points, 0).sum())
    assert total(record(ones(3, 4))) == pytest.approx(0.5 * 3 * 7)


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
    np.save(tmp_path / "b.npy", np.zeros(3))
    with pytest.raises(ValueError, match="b.npy: not a readable recording"):
        load(tmp_path / "b.npy")
    with pytest.raises(FileNotFoundError, match="nowhere.npz"):
        load(tmp_path / "nowhere.npz")


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"meta": np.array('{"format": "r2s-recording/4"}')}, "r2s-recording/4.*expected.*update"),
        ({"meta": np.array('{"format": "r2s-recording/2"}')}, "it lacks 'info'"),
        ({"offsets": np.array([0, 3, 6])}, "offsets must go from 0 to 7"),
        ({"offsets": np.array([0, 8, 7])}, "offsets must go from 0 to 7"),
        ({"points": None}, "points"),
        ({"times": np.array([0.0])}, r"times must have the shape \(2,\)"),
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


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_disk_that_fills_up_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("builtins.open", lambda path, mode, real=open: real("/dev/full", mode))
    with pytest.raises(OSError, match="a.bin.*No space left"):
        write_bytes(tmp_path / "a.bin", b"x" * 100_000)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="cannot write .*nowhere/a.npz.*missing"):
        save(record(ones(3, 4)), tmp_path / "nowhere" / "a.npz")


def test_json_is_whole_or_not_there(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"a": [1, 2.5, None]})
    assert (tmp_path / "a.json").read_text().endswith("}\n")
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "b.json", {"a": float("nan")})
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
