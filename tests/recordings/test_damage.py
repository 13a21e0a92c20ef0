"""Files damaged anywhere: either they are still read, or the error names the file."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cv2")
from hypothesis import HealthCheck, given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from rgbd_scene import INFO, PATH, TIMES, write  # noqa: E402
from test_clouds import FORMATS, write_cloud  # noqa: E402

from r2s.recordings.clouds import read_cloud  # noqa: E402
from r2s.recordings.force_log import read_force_log  # noqa: E402
from r2s.recordings.manifest import default_manifest, read_manifest  # noqa: E402
from r2s.recordings.recording import load, make_recording, save  # noqa: E402
from r2s.recordings.rgbd import read_clouds, read_rig  # noqa: E402

IMAGES = ("cameras.json", "left/times.csv", "left/depth/001.png", "right/masks/002.png")
Damage = Callable[[bytes], bytes]


@st.composite
def damages(draw: st.DrawFn) -> Damage:
    """Cut, bytes changed, or doubled."""
    share = draw(st.floats(0, 1, exclude_max=True))
    junk = draw(st.binary(max_size=8))
    kind = draw(st.sampled_from(["cut", "changed", "doubled"]))

    def damage(data: bytes) -> bytes:
        at = int(share * len(data))
        rest = {"cut": b"", "changed": data[at + len(junk) :], "doubled": data}[kind]
        return data[:at] + junk + rest

    return damage


def read_or_named(read: Callable[[], Any], *names: Path) -> None:
    """It is read, or the error is one of those promised and has one of the names."""
    try:
        read()
    except (ValueError, FileNotFoundError) as error:
        assert any(str(name) in str(error) for name in names), error


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "wave"
    write(folder)
    return folder


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(name=st.sampled_from(IMAGES), damage=damages())
@pytest.mark.filterwarnings("ignore")
def test_a_damaged_folder_of_images(whole: Path, name: str, damage: Damage) -> None:
    file = whole / name
    before = file.read_bytes()
    try:
        file.write_bytes(damage(before))
        read_or_named(lambda: read_clouds(whole, read_rig(whole)), whole)
    finally:
        file.write_bytes(before)


CLOUD = np.random.default_rng(0).uniform(-1, 1, (20, 3)).astype(np.float32)


def recording(path: Path) -> None:
    save(make_recording([CLOUD] * 4, TIMES, PATH, TIMES, INFO), path)


def log(path: Path) -> None:
    path.write_text("time_s,force_N\n" + "".join(f"{0.1 * i:.1f},{i}\n" for i in range(20)))


def manifest(path: Path) -> None:
    value = json.loads(default_manifest().read_text())
    value["files"] = dict(list(value["files"].items())[:3])
    path.write_text(json.dumps(value))


FILES: dict[str, Any] = {
    "recording.npz": (recording, load),
    "log.csv": (log, read_force_log),
    "manifest.json": (manifest, read_manifest),
} | {kind: (partial(write_cloud, points=CLOUD), read_cloud) for kind in FORMATS}


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damage=damages())
@pytest.mark.filterwarnings("ignore")
def test_a_damaged_file(tmp_path: Path, name: str, damage: Damage) -> None:
    write_it, read_it = FILES[name]
    file = write_it(tmp_path / name) or tmp_path / name
    read_it(file)
    file.write_bytes(damage(file.read_bytes()))
    read_or_named(lambda: read_it(file), file)
