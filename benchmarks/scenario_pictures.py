"""Pictures of simulated sheets: rendered with a z-buffer, so that layers 1 mm apart are told apart.

The front of the fabric is in the solver's colour, its back paler, the table's squares are 10 cm.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from r2s.files import write_bytes
from r2s.recordings.cameras.calibration import DepthCamera, look_at, project
from r2s.recordings.cameras.depth import back_project, from_world
from r2s.recordings.cameras.render import render
from r2s.scenarios.scenario import Scenario

VIEWS = {"lifting": (25, -50), "folding": (35, -40), "stretching": (50, -60)}  # degrees
SIDEWAYS = (12, -50)  # of hanging sheets
PANELS = 6
PIXELS = (440, 340)
SQUARE = 0.1  # [m], of the table's chequers
BELOW = 2e-3  # [m], by which the table is drawn lower, since a sheet may lie in its plane
LIGHT = np.array([0.35, -0.6, 0.72])
TABLE, BACK = np.array([0.93, 0.93, 0.93]), 0.55  # and how pale the back of the fabric is


def picture(name: str, runs: list[tuple[Scenario, np.ndarray, str, str]], path: Path) -> None:
    """Six frames of each run (scenario, positions [m], title, colour), a row a run, as one PNG."""
    figure = Figure(figsize=(2.6 * PANELS, 2.25 * len(runs) + 0.4), layout="constrained")
    figure.suptitle(f"{name}; dashed: the sheet in the first frame")
    camera = _camera(np.concatenate([x.reshape(-1, 3) for _, x, _, _ in runs]), name)
    for line, (scenario, x, title, colour) in enumerate(runs):
        frames = np.linspace(0, len(x) - 1, PANELS).round().astype(int)
        for place, frame in enumerate(frames):
            axes: Any = figure.add_subplot(len(runs), PANELS, line * PANELS + place + 1)
            axes.imshow(_shaded(camera, scenario, x[frame], colour))
            _lines(axes, camera, scenario, x[0], x[frame])
            axes.set_axis_off()
            seconds = f"{frame * scenario.interval:.2f} s"
            axes.set_title(f"{title}, {seconds}" if place == 0 else seconds, fontsize=8, pad=2)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    write_bytes(path, buffer.getvalue())


def _camera(points: np.ndarray, name: str) -> DepthCamera:
    """One that has all points in view."""
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    up, around = np.radians(VIEWS.get(name, SIDEWAYS))
    towards = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    middle = (low + high) / 2
    pose = look_at(tuple(middle + 2.0 * towards), tuple(middle))
    across, down = PIXELS
    centre = (across / 2 - 0.5, down / 2 - 0.5)
    wide = DepthCamera(PIXELS, (across, across), centre, pose, 1e-3)
    away = np.abs(_pixels(wide, points) - np.array(centre)).max(axis=0) / np.array([across, down])
    focal = across * 0.46 / float(away.max())
    return DepthCamera(PIXELS, (focal, focal), centre, pose, 1e-3)


def _pixels(camera: DepthCamera, points: np.ndarray) -> np.ndarray:
    return project(camera, from_world(camera, points))


def _shaded(camera: DepthCamera, scenario: Scenario, x: np.ndarray, colour: str) -> np.ndarray:
    """An image (down, across, 3) in 0..1 of the sheet over the table."""
    faces, eye = np.asarray(scenario.scene.mesh.faces), np.array(camera.to_world)[:3, 3]
    table, squares = _table(float(scenario.scene.table.height), x)
    depth, which = render(
        camera, np.concatenate([x, table]), np.concatenate([faces, squares + len(x)])
    )
    seen = depth > 0
    points = back_project(camera, depth, seen) @ np.array(camera.to_world)[:3, :3].T + eye
    which = which[seen]
    chequer = np.floor(points[:, :2] / SQUARE).sum(axis=1) % 2
    values = (TABLE - 0.06 * chequer[:, None]).copy()
    cloth = which < len(faces)
    values[cloth] = _fabric(x, faces, which[cloth], points[cloth], eye, np.array(to_rgb(colour)))
    image = np.ones((*seen.shape, 3))
    image[seen] = values
    return image


def _fabric(x, faces, which, points, eye, colour) -> np.ndarray:
    """The colours of places on the sheet, by its smooth normals."""
    corners = x[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    smooth = np.zeros_like(x)
    for corner in range(3):
        np.add.at(smooth, faces[:, corner], normals)
    a, b, c = np.moveaxis(corners[which], 1, 0)
    parts = (np.cross(p - points, q - points) for p, q in ((b, c), (c, a), (a, b)))
    weights = np.stack([np.einsum("pi,pi->p", part, normals[which]) for part in parts], axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    normal = np.einsum("pk,pki->pi", weights, smooth[faces[which]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    front = np.einsum("pi,pi->p", normals[which], eye - points) > 0
    tint = np.where(front[:, None], colour, (1 - BACK) * colour + BACK)
    return np.clip((0.45 + 0.6 * np.abs(normal @ LIGHT))[:, None] * tint, 0, 1)


def _table(height: float, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two triangles of the table, where the sheet comes near it."""
    low, high = x.min(axis=0)[:2] - 0.2, x.max(axis=0)[:2] + 0.2
    if not x[:, 2].min() < height + 0.05:
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    return np.column_stack([corners, np.full(4, height - BELOW)]), np.array([[0, 1, 2], [0, 2, 3]])


def _lines(axes: Any, camera: DepthCamera, scenario: Scenario, first: np.ndarray, x: np.ndarray):
    """The held vertices, and the sheet's outline in the first frame."""
    outline = _pixels(camera, first[_border(np.asarray(scenario.scene.mesh.rest))])
    axes.plot(*outline.T, color="#303030", lw=0.6, ls="--", scalex=False, scaley=False)
    held = _pixels(camera, x[np.asarray(scenario.scene.held)])
    axes.scatter(*held.T, s=4, color="black")
    axes.set(xlim=(0, PIXELS[0]), ylim=(PIXELS[1], 0))


def _border(rest: np.ndarray) -> np.ndarray:
    """The vertices around a rectangle, and back to the first."""
    grid = np.arange(len(rest)).reshape(len(np.unique(rest[:, 0])), -1)
    return np.concatenate([grid[:, 0], grid[-1], grid[::-1, -1], grid[0, ::-1]])
