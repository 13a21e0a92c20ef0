"""Data sets: manifests, downloads from a server on loopback, what is corrupt."""

import hashlib
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from r2s.recordings.datasets import Dataset, fetch, known_datasets, read_dataset
from r2s.recordings.manifest import (
    Manifest,
    default_manifest,
    hash_values,
    read_manifest,
)

MANIFESTS = default_manifest().parent
CONTENT = np.random.default_rng(0).bytes(300_000)
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Server(BaseHTTPRequestHandler):
    """Serves CONTENT as /whole, and something else as /other."""

    def do_GET(self) -> None:
        kind = self.path.strip("/")
        self.server.asked.append(kind)  # type: ignore[attr-defined]
        if kind not in ("whole", "other"):
            self.send_error(404)
            return
        data = CONTENT if kind == "whole" else CONTENT[::-1]
        self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture(scope="module")
def server() -> Iterator[ThreadingHTTPServer]:
    pytest.importorskip("pooch")
    server = ThreadingHTTPServer(("127.0.0.1", 0), Server)
    server.asked = []  # type: ignore[attr-defined]
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


def dataset(folder: Path, server: Any, **kinds: str) -> Path:
    """A folder with the manifest of a data set `made`, of the files kind/NAME.bin."""
    port = server.server_address[1] if server else 1
    downloads = {
        f"clouds/{name}.bin": {"url": f"http://127.0.0.1:{port}/{kind}", "sha256": SHA256}
        for name, kind in kinds.items()
    }
    about = {key: f"the {key}" for key in ("title", "citation", "licence", "how", "note")}
    made = {"name": "made", **about, "layout": {}, "downloads": downloads}
    folder.mkdir(exist_ok=True)
    (folder / "made.json").write_text(json.dumps(made))
    return folder


def fetched(tmp_path: Path, server: Any, **kinds: str) -> list[str]:
    manifests = dataset(tmp_path / "manifests", server, **kinds)
    return list(fetch("made", tmp_path / "data", manifests))


def test_a_download_is_verified_and_not_repeated(tmp_path: Path, server: Any) -> None:
    lines = fetched(tmp_path, server, a="whole")
    assert lines[1:3] == ["licence: the licence", "cite: the citation"]
    assert lines[-1] == "clouds/a.bin: downloaded, verified"
    assert (tmp_path / "data/clouds/a.bin").read_bytes() == CONTENT
    assert sorted(p.name for p in (tmp_path / "data/clouds").iterdir()) == ["a.bin"]
    server.asked.clear()
    assert fetched(tmp_path, server, a="whole")[-1] == "clouds/a.bin: there, verified"
    assert server.asked == []


def test_what_is_corrupt_is_named_and_left_alone(tmp_path: Path, server: Any) -> None:
    (tmp_path / "data/clouds").mkdir(parents=True)
    mine = tmp_path / "data/clouds/a.bin"
    mine.write_bytes(b"something of mine")
    server.asked.clear()
    with pytest.raises(ValueError, match="a.bin: corrupt: sha256 .* published is .* delete it"):
        fetched(tmp_path, server, a="whole", b="whole")
    assert mine.read_bytes() == b"something of mine"
    assert (tmp_path / "data/clouds/b.bin").read_bytes() == CONTENT  # the others are fetched
    assert server.asked == ["whole"]


def test_a_server_that_sends_something_else(tmp_path: Path, server: Any) -> None:
    with pytest.raises(
        ValueError, match="a.bin: corrupt: what http.*other sent is not the publish"
    ):
        fetched(tmp_path, server, a="other")
    assert list((tmp_path / "data/clouds").iterdir()) == []


def test_what_is_not_there(tmp_path: Path, server: Any) -> None:
    with pytest.raises(ValueError, match="/gone: 404 .* run it again"):
        fetched(tmp_path, server, a="gone")
    with pytest.raises(ValueError, match="/whole: .*refused.* run it again"):
        fetched(tmp_path, None, a="whole")
    with pytest.raises(ValueError, match="no data set 'none'; there are made"):
        list(fetch("none", tmp_path, tmp_path / "manifests"))
    with pytest.raises(FileNotFoundError, match="no folder of manifests"):
        known_datasets(tmp_path / "nowhere")


@pytest.mark.parametrize(
    "path, change, words",
    [
        ("clouds/a.bin", {"sha256": "abc"}, "sha256 must be 64 hexadecimal digits, found 'abc'"),
        ("clouds/a.bin", {"url": "ftp://x"}, "url must begin with https://"),
        ("../a.bin", {}, "paths must stay in the folder of the data, found '../a.bin'"),
        ("/a.bin", {}, "paths must stay in the folder"),
    ],
)
def test_a_manifest_that_is_wrong(tmp_path: Path, path: str, change: dict, words: str) -> None:
    file = dataset(tmp_path, None, a="whole") / "made.json"
    made = json.loads(file.read_text())
    made["downloads"] = {path: made["downloads"]["clouds/a.bin"] | change}
    file.write_text(json.dumps(made))
    with pytest.raises(ValueError, match=f"made.json.*{words}"):
        read_dataset(file)
    file.write_text("{")
    with pytest.raises(ValueError, match="made.json: no JSON"):
        read_dataset(file)


def test_the_manifests_of_the_project() -> None:
    known = known_datasets()
    assert set(known) == {"blanco_mulero", "diffcloud", "rgbench", "study", "swings"}
    assert isinstance(known["diffcloud"], Manifest) and isinstance(known["rgbench"], Dataset)
    assert known["rgbench"].licence == "CC-BY-4.0"
    assert "10.5281/zenodo.13823986" in known["blanco_mulero"].citation
    study = read_manifest(MANIFESTS / "templates" / "study.json")
    assert set(study.scenarios) == {"lift", "wind", "fold", "fling", "shaking"}
    with pytest.raises(ValueError, match="blanco_mulero.json.*scenarios: dynamic: .*"):
        read_manifest(MANIFESTS / "templates" / "blanco_mulero.json")  # until it is filled in


@pytest.mark.parametrize("name", ["rgbench", "blanco_mulero", "study", "swings"])
def test_what_must_be_fetched_by_hand_says_how(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}: cannot be downloaded automatically. .* Licence"):
        list(fetch(name, tmp_path))


def test_what_was_fetched_by_hand_is_counted(tmp_path: Path) -> None:
    for motion in ("dynamic", "quasi_static"):
        (tmp_path / "cotton_rag_0" / motion / "cloud").mkdir(parents=True)
        (tmp_path / "cotton_rag_0" / motion / "cloud" / "00000.ply").touch()
    lines = list(fetch("blanco_mulero", tmp_path))
    assert lines[-1].endswith(
        "1 found (clouds of the slow motion, frames 00000.ply and on), not verified"
    )


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
