"""A small RGB-D scene that several tests share: a wavy sheet that rises, seen by two cameras."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from r2s.mesh import surface as surfaces
from r2s.mesh.mesh import rectangle
from r2s.recordings.cameras import Camera, DepthCamera, look_at
from r2s.recordings.clouds import Cleaning
from r2s.recordings.recording import RecordingInfo, SheetPlacement
from r2s.recordings.rgbd import Rig
from r2s.recordings.synthetic_rgbd import write_rgbd

nearest = jax.jit(surfaces.nearest)
SAMPLE = 1000
RESOLUTION = (160, 120)
LENS = (-0.1, 0.02, 0.001, -0.001, 0.0)
SHEET = rectangle((0.3, 0.3), (13, 13))
FACES = np.asarray(SHEET.faces)
TIMES = np.arange(4) / 15
INFO = RecordingInfo(
    name="wave",
    scenario="lift",
    fabric="none",
    trial="1",
    source="made up",
    frames_used=(0, 3),
    sheet=SheetPlacement(
        (0.3, 0.3), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), ("origin",)
    ),
    table_height=0.0,
    verified=None,
)
PATH = np.linspace([0, 0, 0.08], [0, 0, 0.11], 4)


def camera(position: tuple[float, float, float], **changes: Any) -> DepthCamera:
    across, down = changes.get("resolution", RESOLUTION)
    focal = 0.9 * across
    fields: dict[str, Any] = {
        "resolution": (across, down),
        "focal_length": (focal, focal),
        "centre": (across / 2 - 0.5, down / 2 - 0.5),
        "to_world": look_at(position, (0.15, 0.15, 0.08)),
        "depth_scale": 1e-3,
    }
    return DepthCamera(**(fields | changes))


def calibrated(pinhole: Camera) -> DepthCamera:
    """A pinhole camera as a calibrated one: its pixels begin, those have their middle, at 0."""
    across, down = pinhole.resolution
    focal = float(pinhole.focal_length)
    position, target = (tuple(map(float, p)) for p in (pinhole.position, pinhole.target))
    centre = (across / 2 - 0.5, down / 2 - 0.5)
    return DepthCamera((across, down), (focal, focal), centre, look_at(position, target), 1e-3)


def rig(**changes: Any) -> Rig:
    """Two cameras, the second with a lens; `changes` are of the cleaning."""
    cameras = {
        "left": camera((-0.4, -0.1, 0.45)),
        "right": camera((0.4, -0.3, 0.6), distortion=LENS),
    }
    box = Cleaning(((-0.1, -0.1, -0.02), (0.4, 0.4, 0.4)), voxel=0.004)
    return Rig(cameras, replace(box, **changes))


def surface(frame: int) -> np.ndarray:
    """Positions [m] of the sheet's vertices."""
    flat = np.asarray(SHEET.rest)
    wave = np.sin(14 * flat[:, 0] + 0.3 * frame) * np.cos(11 * flat[:, 1])
    return np.column_stack([flat, 0.08 + 0.01 * frame + 0.025 * wave])


def write(folder: Path, scene: Rig | None = None, **options: Any) -> Rig:
    scene = scene or rig()
    x = np.stack([surface(frame) for frame in range(len(TIMES))])
    write_rgbd(folder, scene, x, FACES, TIMES, **options)
    return scene


def distances(points: np.ndarray, x: np.ndarray, faces: np.ndarray = FACES) -> np.ndarray:
    """Distances [m] of `SAMPLE` of the points, evenly chosen, to a surface."""
    chosen = points[np.linspace(0, len(points) - 1, SAMPLE).astype(int)]
    face, weights = nearest(jnp.asarray(chosen), jnp.asarray(x), jnp.asarray(faces))
    place = np.einsum("pk,pki->pi", np.asarray(weights), x[faces[np.asarray(face)]])
    return np.linalg.norm(chosen - place, axis=1)
