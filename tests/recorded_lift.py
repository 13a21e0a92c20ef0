"""A made-up recording of a lift, a simulated sheet beside it, and a laboratory's folder."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from r2s.recordings.manifest import default_manifest
from r2s.recordings.open import SimulatedCloth
from r2s.recordings.recording import Recording, RecordingInfo, SheetPlacement, make_recording

FRAMES = 5
X, Y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


def recorded(frames: int = FRAMES, **more: Any) -> Recording:
    """A square of 0.2 m whose corner is lifted, with a few points far off."""
    sheet = SheetPlacement((0.2, 0.2), (0.0, 0.0, 0.0), X, Y, ("origin",))
    info = RecordingInfo(
        "lift_made", "lift", "made", "1", "here", (1, frames - 1), sheet, 0.0, None
    )
    generator = np.random.default_rng(0)
    flat = generator.uniform(0, 0.2, (frames, 300, 2))
    lifted = np.linspace(0, 0.15, frames)[:, None] * (1 - flat.sum(axis=-1) / 0.4)
    clouds = np.concatenate([flat, lifted[..., None]], axis=-1)
    clouds[:, :1] = [1.5, 1.5, 1.5]
    path = np.linspace([0, 0, 0], [0, 0, 0.15], frames)
    times = np.arange(frames) / 15
    return make_recording(list(clouds), times, path, times, info, **more)


def cloth(frames: int = FRAMES) -> SimulatedCloth:
    corners = np.array([[0, 0, 0], [0.2, 0, 0], [0.2, 0.2, 0], [0, 0.2, 0]])
    x = np.repeat(corners[None], frames, axis=0)
    x[:, 0, 2] = np.linspace(0, 0.15, frames)
    return SimulatedCloth(x, np.array([[0, 1, 2], [0, 2, 3]]))


def lab(tmp_path: Path, *names: str) -> Path:
    """A folder with the template of a lab's manifest, and recordings of these names."""
    template = default_manifest().parent / "templates" / "study.json"
    manifest = json.loads(template.read_text())
    manifest["scenarios"]["lift"]["frames_used"] = [0, 2]
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    np.save(tmp_path / "lift_gripper.npy", np.zeros((3, 3)))
    for name in names:
        (tmp_path / name).mkdir()
        for frame in range(3):
            np.save(tmp_path / name / f"{frame:03d}.npy", np.ones((4, 3)) * frame)
    return tmp_path
