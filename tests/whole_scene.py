"""RGB-D recordings of whole scenes: a sheet, and table, arm and clutter around it, in colour."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import trimesh
from rgbd_scene import camera

from r2s._util.files import write_bytes
from r2s.mesh.mesh import rectangle
from r2s.recordings.images import encode_png, write_depth
from r2s.recordings.rgbd import Rig
from r2s.recordings.synthetic_rgbd import TYPICAL, Flaws, flawed_depth
from r2s.recordings.views import render

SIDE = 0.4
SHEET = rectangle((SIDE, SIDE), (17, 17))
FACES, REST = np.asarray(SHEET.faces), np.asarray(SHEET.rest)
BLUE, RED, GREEN, WHITE = (40, 70, 190), (190, 40, 45), (50, 150, 60), (235, 235, 230)
BEIGE, GREY, BLACK, ORANGE = (200, 170, 130), (120, 120, 125), (35, 35, 38), (220, 130, 30)
UP = (0.0, 0.0, 1.0)


class Body(NamedTuple):
    """A mesh [m] and its colour: red, green, blue."""

    x: np.ndarray
    faces: np.ndarray
    colour: tuple[int, int, int]


def sheet(x: np.ndarray, colour: tuple[int, int, int]) -> Body:
    return Body(x, FACES, colour)


def table(colour: tuple[int, int, int], tilt: float = 0.0, height: float = 0.0) -> Body:
    """A table of 1.6 m around the sheet, tilted along x by some degrees."""
    mesh = rectangle((1.6, 1.6), (9, 9))
    flat = np.asarray(mesh.rest) - 0.8 + SIDE / 2
    up = height + np.tan(np.radians(tilt)) * (flat[:, :1] - SIDE / 2)
    return Body(np.hstack([flat, up]), np.asarray(mesh.faces), colour)


def box(size: Sequence[float], centre: Sequence[float], colour, turn: float = 0.0) -> Body:
    pose = trimesh.transformations.rotation_matrix(np.radians(turn), UP)
    pose[:3, 3] = centre
    mesh = trimesh.creation.box(size, pose).subdivide()
    return Body(np.asarray(mesh.vertices), np.asarray(mesh.faces), colour)


def rod(start: Any, end: Any, radius: float, colour) -> Body:
    mesh = trimesh.creation.cylinder(radius, segment=[start, end], sections=16)
    return Body(np.asarray(mesh.vertices), np.asarray(mesh.faces), colour)


def arm(gripper: np.ndarray, outwards: Sequence[float] = UP, colour=GREY) -> list[Body]:
    """Fingers, a hand and a forearm that lead away from a gripper."""
    axis = np.array(outwards) / np.linalg.norm(outwards)
    at = [gripper + along * axis for along in (-0.01, 0.08, 0.2, 0.7)]
    parts = ((0.012, BLACK), (0.035, colour), (0.05, colour))
    return [rod(at[i], at[i + 1], radius, shade) for i, (radius, shade) in enumerate(parts)]


def lying(bump: float = 0.0, lift: float = 0.0) -> np.ndarray:
    """On the table, with bumps [m], and the corner at the origin lifted."""
    share = np.clip(1 - REST.sum(axis=1) / 0.35, 0, 1)
    waves = bump * (1 + np.sin(19 * REST[:, 0]) * np.cos(13 * REST[:, 1])) / 2
    moved = REST + 0.25 * lift * share[:, None]
    return np.column_stack([moved, 0.001 + waves + lift * share**2])


def folded(angle: float) -> np.ndarray:
    """The half of the sheet at x < SIDE / 2 turned over the other by an angle [degree]."""
    radius, middle = 0.02, SIDE / 2
    turned = np.radians(angle)
    away = np.clip(middle - REST[:, 0], 0, None)  # along the part that is turned
    bent = np.clip(away / radius, 0, turned)
    rest = away - bent * radius
    x = middle - radius * np.sin(bent) - rest * np.cos(bent)
    z = 0.001 + radius * (1 - np.cos(bent)) + rest * np.sin(bent)
    return np.column_stack([np.where(away > 0, x, REST[:, 0]), REST[:, 1], z])


def hanging(lowest: float, sway: float = 0.0) -> np.ndarray:
    """From the corners at y = SIDE in the plane of x and z, with folds."""
    down = 1 - REST[:, 1] / SIDE
    across = 0.02 * np.sin(4 * np.pi * REST[:, 0] / SIDE) * down + sway * down**2
    sag = 0.03 * np.sin(np.pi * REST[:, 0] / SIDE) * (1 - down)
    return np.column_stack([REST[:, 0], SIDE / 2 + across, lowest + REST[:, 1] - sag])


def cameras(count: int = 4, across: int = 320, **changes: Any) -> dict[str, Any]:
    """Around the sheet, without masks."""
    size = (across, 3 * across // 4)
    places = ((-0.6, -0.35, 0.75), (1.0, -0.3, 0.8), (0.9, 0.95, 0.7), (-0.5, 0.8, 0.85))
    made = {"resolution": size, "masks": False} | changes
    return {f"c{i}": camera(place, **made) for i, place in enumerate(places[:count])}


def write_scene(
    folder: Path,
    rig: Rig,
    frames: Sequence[Sequence[Body]],
    times: Sequence[float],
    flaws: Flaws = TYPICAL,
    seed: int = 0,
) -> None:
    """Write depth, colour, times, and true masks of the first body of each frame."""
    for order, (name, view) in enumerate(rig.cameras.items()):
        for kind in ("depth", "colour", "masks"):
            (folder / name / kind).mkdir(parents=True)
        (folder / name / "times.csv").write_text("".join(f"{time}\n" for time in times))
        for frame, bodies in enumerate(frames):
            generator = np.random.default_rng([seed, order, frame])
            starts = np.cumsum([0, *(len(body.x) for body in bodies)])
            x = np.concatenate([body.x for body in bodies])
            pairs = zip(starts, bodies, strict=False)
            faces = np.concatenate([start + body.faces for start, body in pairs])
            owner = np.repeat(np.arange(len(bodies)), [len(body.faces) for body in bodies])
            depth, which = render(view, x, faces)
            body = np.where(which >= 0, owner[which], -1)
            seen = flawed_depth(view, depth, which, x, faces, flaws, generator)
            colours = np.array([*(b.colour for b in bodies), (90, 90, 90)], float)
            normals = np.cross(x[faces[:, 1]] - x[faces[:, 0]], x[faces[:, 2]] - x[faces[:, 0]])
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
            light = np.where(which >= 0, 0.65 + 0.35 * np.abs(normals[which, 2]), 1)
            picture = cv2.blur(colours[body] * light[..., None], (3, 3))
            picture += generator.normal(0, 4, picture.shape)
            pixels = np.clip(picture, 0, 255).astype(np.uint8)
            file = f"{frame:03d}.png"
            write_depth(folder / name / "depth" / file, seen, view.depth_scale)
            write_bytes(folder / name / "colour" / file, encode_png(pixels[..., ::-1]))
            mask = (body == 0).astype(np.uint8) * 255
            write_bytes(folder / name / "masks" / file, encode_png(mask))


def shares(kept: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """How many of the true points are among those that were kept, and of these how many are not
    true; points are equal to the last bit."""
    rows = {point.tobytes() for point in true}
    same = sum(point.tobytes() in rows for point in kept)
    return same / len(true), 1 - same / max(len(kept), 1)
