"""Folders of recordings to NPZ files: written, skipped, converted again, and what is broken."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from recorded_lift import lab
from rgbd_scene import PATH, TIMES, distances, surface
from rgbd_scene import write as write_images

from r2s.recordings.manifest import default_manifest, manifest_for, read_recording
from r2s.recordings.open import convert
from r2s.recordings.recording import cloud, load

NAMES = ("lift_camel_1", "lift_denim_1", "lift_denim_2")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three recordings of three clouds."""
    (tmp_path / "in").mkdir()
    return lab(tmp_path / "in", *NAMES)


def converted(folder: Path, to: Path, **options) -> dict[str, str]:
    """What was said of each recording."""
    return dict(line.split(": ", 1) for line in convert(folder, to, **options))


def test_every_recording_becomes_an_npz(folder: Path, tmp_path: Path) -> None:
    said = converted(folder, tmp_path / "new" / "out")
    assert list(said) == list(NAMES)
    for name, line in said.items():
        file = tmp_path / "new" / "out" / f"{name}.npz"
        assert line == f"3 frames, 12 points, {file}"
        made, read = load(file), read_recording(folder, manifest_for(folder), name)
        assert made.info == read.info
        np.testing.assert_array_equal(made.points, read.points)
    assert len(list((tmp_path / "new" / "out").iterdir())) == 6  # and nothing temporary


def test_broken_recordings_are_named_after_the_others_were_converted(
    folder: Path, tmp_path: Path
) -> None:
    (folder / NAMES[0] / "001.npy").write_bytes(b"\x93NUMPY cut")
    for file in (folder / NAMES[1]).glob("*.npy"):
        file.unlink()
    words = "(?s)lift_camel_1/001.npy: .*lift_denim_1: .*1 of 3 recordings are converted$"
    with pytest.raises(ValueError, match=words):
        converted(folder, tmp_path / "out")
    assert {path.stem for path in (tmp_path / "out").iterdir()} == {NAMES[2]}


def test_what_is_up_to_date_is_skipped_and_what_changed_is_not(
    folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    converted(folder, out)

    def changed() -> list[str]:
        return [name for name, line in converted(folder, out).items() if "up to date" not in line]

    before = {path: path.stat().st_mtime_ns for path in out.iterdir()}
    assert changed() == []
    assert {path: path.stat().st_mtime_ns for path in out.iterdir()} == before
    np.save(folder / NAMES[1] / "002.npy", np.full((5, 3), 2.0))
    assert changed() == [NAMES[1]]
    assert len(cloud(load(out / f"{NAMES[1]}.npz"), 2)) == 5
    for suffix in ("npz", "sha256"):  # as when it was killed between the two
        (out / f"{NAMES[0]}.{suffix}").unlink()
        assert changed() == [NAMES[0]]
    np.save(folder / NAMES[2] / "003.npy", np.ones((4, 3)))  # one frame more
    np.save(folder / "lift_gripper.npy", np.zeros((4, 3)))
    assert changed() == list(NAMES)
    text = (folder / "manifest.json").read_text()
    (folder / "manifest.json").write_text(text.replace("A template", "Ours"))
    assert changed() == list(NAMES)
    assert all("frames" in line for line in converted(folder, out, force=True).values())


def test_some_or_one_recording_alone(folder: Path, tmp_path: Path) -> None:
    assert list(converted(folder, tmp_path / "a", only="denim_")) == list(NAMES[1:])
    assert list(converted(folder / NAMES[0], tmp_path / "b")) == [NAMES[0]]
    (tmp_path / "empty").mkdir()
    for place, only, words in (
        (folder, "silk", "no recording whose name matches 'silk'; there are lift_"),
        (folder, "(lift", "'.lift' is no regular expression"),
        (
            tmp_path / "empty",
            "",
            "empty: no manifest.json, which gives .*: copy data_manifests",
        ),
        (tmp_path / "nowhere", "", "nowhere: no such folder"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=words):
            converted(place, tmp_path / "c", only=only)
    assert not (tmp_path / "c").exists()


def test_images_are_converted_and_a_changed_calibration_is_noticed(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    template = default_manifest().parent / "templates" / "study.json"
    manifest = json.loads(template.read_text())
    manifest["scenarios"]["lift"]["frames_used"] = [0, len(TIMES) - 1]
    folder, name = tmp_path / "in", "lift_wave_1"
    write_images(folder / name)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    np.save(folder / "lift_gripper.npy", PATH)
    (said,) = converted(folder, tmp_path / "out").values()
    made = load(tmp_path / "out" / f"{name}.npz")
    assert said.startswith(f"{len(TIMES)} frames, ")
    assert made.info.verified is None
    assert distances(cloud(made, 1), surface(1)).mean() < 2e-3
    colours = folder / name / "left" / "colour"
    colours.mkdir()
    (colours / "000.png").touch()  # is not read
    assert "up to date" in converted(folder, tmp_path / "out")[name]
    shutil.rmtree(colours)
    cameras = folder / name / "cameras.json"
    cameras.write_text(cameras.read_text().replace('"voxel": 0.004', '"voxel": 0.01'))
    assert "up to date" not in converted(folder, tmp_path / "out")[name]
    (folder / name / "left" / "masks" / "002.png").write_bytes(b"")
    with pytest.raises(ValueError, match="left/masks/002.png: no PNG"):
        converted(folder, tmp_path / "out")
