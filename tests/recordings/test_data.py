"""Data sets: their manifests, what is there, what is corrupt."""

import json
from pathlib import Path

import numpy as np
import pytest

from r2s.recordings.datasets import Dataset, fetch, known_datasets, read_dataset
from r2s.recordings.manifest import Manifest, default_manifest, hash_values, read_manifest

MANIFESTS = default_manifest().parent


def test_the_manifests_of_the_project() -> None:
    known = known_datasets()
    assert set(known) == {"blanco_mulero", "diffcloud", "rgbench", "study", "swings"}
    assert isinstance(known["diffcloud"], Manifest) and isinstance(known["rgbench"], Dataset)
    assert known["rgbench"].licence == "CC-BY-4.0"
    assert "10.5281/zenodo.13823986" in known["blanco_mulero"].citation
    study = read_manifest(MANIFESTS / "templates" / "study.json")
    assert set(study.scenarios) == {"lift", "wind", "fold", "fling", "shaking"}
    assert [path.name for path in (MANIFESTS / "templates").iterdir()] == ["study.json"]


@pytest.mark.parametrize("name", ["rgbench", "blanco_mulero", "study", "swings"])
def test_what_must_be_fetched_by_hand_says_how(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}: cannot be downloaded automatically. .* Licence"):
        list(fetch(name, tmp_path))


def test_what_was_fetched_by_hand_is_counted(tmp_path: Path) -> None:
    for motion in ("dynamic", "quasi_static"):
        (tmp_path / "cotton_rag_0" / motion / "cloud").mkdir(parents=True)
        (tmp_path / "cotton_rag_0" / motion / "cloud" / "00000.ply").touch()
    assert ": 1 found" in list(fetch("blanco_mulero", tmp_path))[-1]


def test_what_is_not_there_or_no_manifest_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no data set 'none'; there are blanco_mulero, diffcloud"):
        list(fetch("none", tmp_path))
    with pytest.raises(FileNotFoundError, match="no folder of manifests"):
        known_datasets(tmp_path / "nowhere")
    for text, words in (("{", "no JSON"), ("{}", "missing: citation")):
        (tmp_path / "made.json").write_text(text)
        with pytest.raises(ValueError, match=f"made.json.*{words}"):
            read_dataset(tmp_path / "made.json")


def test_recordings_are_compared_with_the_published_values(tmp_path: Path) -> None:
    manifests, data = tmp_path / "manifests", tmp_path / "data"
    (data / "lift_tan").mkdir(parents=True)
    manifests.mkdir()
    points = np.arange(6.0).reshape(2, 3)
    made = json.loads(default_manifest().read_text())
    made["files"] = {f"lift_tan/00{i}.npy": hash_values(points) for i in range(3)}
    (manifests / "made.json").write_text(json.dumps(made))
    with pytest.raises(
        ValueError, match="no licence stated.*Get it from priyasundaresan.*lift_tan"
    ):
        list(fetch("diffcloud", data, manifests))
    for i in range(3):
        np.save(data / "lift_tan" / f"00{i}.npy", points)
    lines = list(fetch("diffcloud", data, manifests))
    assert lines[-1].endswith("3 of 3 files verified")
    np.save(data / "lift_tan" / "001.npy", points + 1)
    (data / "lift_tan" / "002.npy").write_bytes(b"cut")
    with pytest.raises(ValueError, match="corrupt, not the published.*001.npy, lift_tan/002.npy$"):
        list(fetch("diffcloud", data, manifests))
