"""Files damaged anywhere: either they are still read, or the error names the file."""

import json
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cv2")
import rgbd_scene  # noqa: E402
from hypothesis import HealthCheck, given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from rgbd_scene import INFO, PATH, TIMES  # noqa: E402
from test_clouds import FORMATS, write_cloud  # noqa: E402

from r2s._util.files import read_json, write_json  # noqa: E402
from r2s.recordings.clouds import read_cloud  # noqa: E402
from r2s.recordings.force_log import read_force_log  # noqa: E402
from r2s.recordings.images import read_depth, write_depth  # noqa: E402
from r2s.recordings.manifest import default_manifest, read_manifest  # noqa: E402
from r2s.recordings.recording import load, make_recording, save  # noqa: E402
from r2s.recordings.rgbd import Rig  # noqa: E402

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


CLOUD = np.random.default_rng(0).uniform(-1, 1, (20, 3)).astype(np.float32)


def recording(path: Path) -> None:
    save(make_recording([CLOUD] * 4, TIMES, PATH, TIMES, INFO), path)


def rig(path: Path) -> None:
    write_json(path, asdict(rgbd_scene.rig()))


def depth(path: Path) -> None:
    write_depth(path, np.full((12, 16), 0.7), 1e-3)


def log(path: Path) -> None:
    path.write_text("time_s,force_N\n" + "".join(f"{0.1 * i:.1f},{i}\n" for i in range(20)))


def manifest(path: Path) -> None:
    value = json.loads(default_manifest().read_text())
    value["files"] = dict(list(value["files"].items())[:3])
    path.write_text(json.dumps(value))


FILES: dict[str, Any] = {
    "recording.npz": (recording, load),
    "log.csv": (log, read_force_log),
    "cameras.json": (rig, lambda path: read_json(path, Rig)),
    "depth.png": (depth, lambda path: read_depth(path, 1e-3, (16, 12))),
    "manifest.json": (manifest, read_manifest),
} | {kind: (partial(write_cloud, points=CLOUD), read_cloud) for kind in FORMATS}


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damage=damages())
@pytest.mark.filterwarnings("ignore")
def test_a_damaged_file_is_read_or_named(tmp_path: Path, name: str, damage: Damage) -> None:
    write_it, read_it = FILES[name]
    file = write_it(tmp_path / name) or tmp_path / name
    read_it(file)
    file.write_bytes(damage(file.read_bytes()))
    try:
        read_it(file)
    except (ValueError, FileNotFoundError) as error:
        assert str(file) in str(error)
