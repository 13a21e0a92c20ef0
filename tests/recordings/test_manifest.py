"""Manifests: strict reading, transforms and clocks, verification; and the real recordings."""

import copy
import json
import os
import runpy
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folders import ROOT

from r2s.recordings.manifest import (
    Manifest,
    hash_values,
    manifest_for,
    read_manifest,
    read_recording,
    read_recordings,
)
from r2s.recordings.recording import Recording, cloud, corner

DATA = Path(os.environ.get("R2S_DATA") or ROOT.parent / "shared" / "data" / "diffcloud_real")
TURN = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
UNIT = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
MANIFEST: dict[str, Any] = {
    "name": "made up",
    "title": "Three frames of a fabric that is pulled",
    "citation": "nobody",
    "source": {"repository": "nobody/nothing", "commit": "0", "path": "."},
    "licence": "none",
    "hash": "see r2s.recordings.manifest.hash_values",
    "note": "",
    "files": {},
    "scenarios": {
        "pull": {
            "folder": r"pull_(?P<fabric>[a-z]+?)(?P<trial>\d*)",
            "frame_rate": 20,
            "time_offset": -0.01,
            "cloud": {"scale": 0.5, "rotation": TURN, "translation": [0, 0, 1]},
            "gripper": {
                "file": "gripper.npy",
                "rate": 10,
                "transform": {"scale": 2, "rotation": UNIT, "translation": [0, 0, 0]},
                "offset": [0, 0, -0.5],
                "note": "made up",
            },
            "sheet": {
                "size": [0.3, 0.2],
                "origin": [0, 0, 0],
                "warp": [1, 0, 0],
                "weft": [0, 1, 0],
                "held": ["origin"],
            },
            "table_height": 0,
            "frames_used": [0, 2],
            "drop_repeats": True,
        }
    },
}
CLOUDS = [np.array([[1.0, 2, 3], [1, 2, 3], [0, 0, frame]]) for frame in range(3)]
GRIPPER = np.array([[0.0, 0, 1], [0, 0, 2]])


def changed(*keys: str, value: Any = None) -> dict[str, Any]:
    manifest = copy.deepcopy(MANIFEST)
    inner = manifest
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value
    return manifest


def read(folder: Path, manifest: dict[str, Any] = MANIFEST) -> Manifest:
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return manifest_for(folder)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("pull_tan", "pull_tan2", "pull_", "notes"):
        (tmp_path / name).mkdir()
        for frame, points in enumerate(CLOUDS):
            np.save(tmp_path / name / f"{frame:03d}.npy", points)
    np.save(tmp_path / "gripper.npy", GRIPPER)
    return tmp_path


@pytest.mark.parametrize(
    "key, value, words",
    [
        ("cloud scale", None, "cloud: scale is unknown: give metres per unit"),
        ("cloud scale", 0, "scale must be positive .m per unit., found 0"),
        ("cloud scale", np.nan, "scale: expected a finite number"),
        ("cloud scale", "mm", "scale: expected a finite number.*'mm'"),
        ("cloud rotation", [[1, 0, 0], [0, 1, 0], [0, 0, 1.01]], "orthonormal"),
        ("cloud rotation", [[0, 1, 0], [1, 0, 0], [0, 0, 1]], "determinant"),
        ("cloud rotation", [[1, 0], [0, 1]], "rotation: expected 3 entries"),
        ("frame_rate", -1, "frame_rate must not be negative .Hz., found -1"),
        ("sheet size", [0.3, -0.2], "sheet: .*sides must be positive"),
        ("sheet held", ["left"], "unknown corner 'left'"),
        ("frames_used", [2, 1], "frames_used must be"),
        ("drop_repeats", 1, "drop_repeats: expected bool"),
        ("folder", "pull_(?P<fabric>.*)", "lacks the group"),
        ("folder", "pull_(", "is no regex"),
        ("colour", "red", "scenarios: pull: unknown: colour; known: folder"),
    ],
)
def test_a_bad_scenario_names_the_file_and_the_field(tmp_path: Path, key, value, words) -> None:
    with pytest.raises(ValueError, match=f"manifest.json.*{words}"):
        read(tmp_path, changed("scenarios", "pull", *key.split(), value=value))


@pytest.mark.parametrize(
    "text, words",
    [
        (json.dumps({k: v for k, v in MANIFEST.items() if k != "licence"}), "missing: licence"),
        (json.dumps(MANIFEST | {"files": []}), "files: expected an object"),
        (json.dumps(MANIFEST | {"source": "here"}), "source: expected an object"),
        ("{", "no JSON"),
    ],
)
def test_a_bad_manifest_is_named(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ValueError, match=f"manifest.json: {words}"):
        manifest_for(tmp_path)
    with pytest.raises(FileNotFoundError, match="nowhere.json"):
        read_manifest(tmp_path / "nowhere.json")


@pytest.mark.parametrize("first", [0, 1])
def test_a_recording_is_in_metres_and_seconds(folder: Path, first: int) -> None:
    for frame in reversed(range(3)):  # numbered from the first
        file = folder / "pull_tan2" / f"{frame:03d}.npy"
        file.rename(file.with_name(f"{frame + first:03d}.npy"))
    manifest = read(folder, changed("scenarios", "pull", "first_frame", value=first))
    recording = read_recording(folder, manifest, "pull_tan2")
    info = recording.info
    assert (info.scenario, info.fabric, info.trial, info.verified) == ("pull", "tan", "2", None)
    # The turn takes x to -y and y to x; half a metre a unit; one of the two equal points is kept.
    np.testing.assert_allclose(cloud(recording, 1), [[1, -0.5, 2.5], [0, 0, 1.5]], rtol=1e-6)
    np.testing.assert_allclose(recording.times, [-0.01, 0.04, 0.09], rtol=1e-6)
    np.testing.assert_allclose(recording.gripper_path[:, 0, 2], [1.5, 3.5])
    np.testing.assert_allclose(recording.gripper_times, [0, 0.1], rtol=1e-6)


def test_discovery_takes_every_folder_that_fits(folder: Path) -> None:
    manifest = read(folder)
    assert read_recordings(folder, manifest) == ["pull_tan", "pull_tan2"]
    assert read_recordings(folder, manifest, []) == []
    with pytest.raises(ValueError, match="unknown scenario 'push', known: .'pull'"):
        read_recordings(folder, manifest, ["push"])
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_recordings(folder / "nowhere", manifest)
    with pytest.raises(ValueError, match="'notes' fits 0 scenarios.*pull_"):
        read_recording(folder, manifest, "notes")
    with pytest.raises(FileNotFoundError, match="pull_silk: no such folder"):
        read_recording(folder, manifest, "pull_silk")
    hash_folder = runpy.run_path(str(ROOT / "data_manifests" / "hash_values.py"))["hash_folder"]
    assert listed()["files"].items() <= hash_folder(folder).items()


def listed(*names: str) -> dict[str, Any]:
    known = {f"pull_tan/{i:03d}.npy": hash_values(points) for i, points in enumerate(CLOUDS)}
    known["gripper.npy"] = hash_values(GRIPPER)
    return changed("files", value={name: known[name] for name in names or known})


def test_hashes_are_of_values_not_of_files(folder: Path) -> None:
    np.save(folder / "pull_tan" / "001.npy", CLOUDS[1].astype(np.float32, order="F"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording = read_recording(folder, read(folder, listed()), "pull_tan")
        assert recording.info.verified is True
        assert recording.info.source == "nobody/nothing 0 ."
        assert read_recording(folder, read(folder, listed()), "pull_tan2").info.verified is None
        some = read(folder, listed("pull_tan/000.npy", "gripper.npy"))
        assert read_recording(folder, some, "pull_tan").info.verified is None


@pytest.mark.parametrize("is_missing", [False, True])
def test_a_listed_file_that_differs_or_lacks_is_warned_of(folder: Path, is_missing: bool) -> None:
    manifest, file = listed(), folder / "pull_tan" / "002.npy"
    if is_missing:
        manifest["scenarios"]["pull"]["frames_used"] = [0, 1]
        file.unlink()
    else:
        np.save(file, CLOUDS[2] + 1e-3)
    with pytest.warns(UserWarning, match="not the published values, or missing: pull_tan/002.npy"):
        info = read_recording(folder, read(folder, manifest), "pull_tan").info
    assert info.verified is False and info.source == str(folder / "pull_tan")


@pytest.mark.parametrize(
    "path, words",
    [
        (GRIPPER[:1], r"pull_tan: the gripper path ends at 0 s, before the last frame at 0.09 s"),
        (GRIPPER[:, :2], r"gripper.npy: .*expected \(knot, 3\)"),
        (GRIPPER * np.nan, "gripper.npy: the path: 2 of 2 are not finite"),
        (GRIPPER[:, None].repeat(2, axis=1), "the path has 2 grippers, the sheet is pinned at"),
        (None, "gripper.npy: no such file, which gripper.file names"),
    ],
)
def test_a_bad_gripper_path_is_an_error(folder: Path, path: np.ndarray | None, words: str) -> None:
    (folder / "gripper.npy").unlink()
    if path is not None:
        np.save(folder / "gripper.npy", path)
    with pytest.raises((ValueError, FileNotFoundError), match=words):
        read_recording(folder, read(folder), "pull_tan")


@pytest.fixture(scope="module")
def real() -> dict[str, Recording]:
    if not DATA.is_dir():
        pytest.skip(f"the DIFFCLOUD recordings are not at {DATA}; set R2S_DATA to their folder")
    manifest = manifest_for(DATA)
    return {name: read_recording(DATA, manifest, name) for name in read_recordings(DATA, manifest)}


def test_all_real_recordings_are_whole_and_verified(real: dict[str, Recording]) -> None:
    assert len(real) == 20
    for recording in real.values():
        info = recording.info
        assert info.verified is True
        assert info.fabric in ("navy", "paper", "polka", "redblack", "tan")
        assert info.trial in ("1", "2") and info.scenario in ("lift", "fold")
        assert recording.times.shape == (25,) and recording.gripper_times.shape == (25,)
        heights = np.asarray(recording.points[..., 2])[np.asarray(recording.mask)]
        assert info.table_height - 0.002 <= heights.min() and heights.max() < 0.5
        top = np.array([len(cloud(recording, frame)) for frame in range(25)])
        assert top.max() < (3500 if info.scenario == "lift" else 8500)  # repeats are dropped


# start, end and origin [m] of the gripper, in the frame of DIFFCLOUD's simulation
DOCUMENTED = {
    "lift": ((0.002, 0.304, 0.223), (0.001, -0.245, 1.107), (0.67, 0.15, 0.0)),
    "fold": ((0.002, -0.818, 0.288), (0.001, -0.008, 0.403), (0.55, 0.18, -0.012)),
}


def test_the_real_gripper_paths_are_the_documented_ones(real: dict[str, Recording]) -> None:
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for recording in real.values():
        path = np.asarray(recording.gripper_path)[:, 0]
        start, end, origin = np.array(DOCUMENTED[recording.info.scenario])
        expected = 0.35 * np.array([start, end]) @ turn.T + origin
        np.testing.assert_allclose(path[[0, -1]], expected, atol=5e-4)
        held = corner(recording.info.sheet, recording.info.sheet.pinned[0])
        np.testing.assert_allclose(path[0][:2], held[:2], atol=2e-3)
