"""Synthetic RGB-D recordings: a moving mesh as folders of images, with the flaws of real ones."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, gaussian_filter, zoom

from r2s._util.files import write_bytes, write_json, write_text
from r2s.mesh.mesh import rectangle
from r2s.recordings.cameras import DepthCamera, depth_jumps, from_world, rays
from r2s.recordings.images import encode_png, write_depth
from r2s.recordings.rgbd import NAME, Rig
from r2s.recordings.views import render

TABLE, TABLE_CELLS = 2.0, 8  # [m] and cells along each side of the table
STEP = 0.02  # [m]: a jump in depth that counts as an edge


@dataclass(frozen=True)
class Flaws:
    """How wrong images are; all zero (and `grazing` 90) for perfect ones.

    - `noise`: standard deviation of depth at 1 m, growing with its square, [m].
    - `grazing`: surfaces turned away by more than this give no depth, [degree].
    - `edge_holes`, `edge_mixed`: shares of pixels at edges that have no depth, or a depth between
      that of the two sides.
    - `holes`: share of all pixels that have no depth.
    - `mask_error`: standard deviation of the mask's border, [pixel].
    """

    noise: float = 1.5e-3
    grazing: float = 82.0
    edge_holes: float = 0.3
    edge_mixed: float = 0.3
    holes: float = 0.003
    mask_error: float = 1.0


TYPICAL = Flaws()
NONE = Flaws(0.0, 90.0, 0.0, 0.0, 0.0, 0.0)


def write_rgbd(
    folder: Path | str,
    rig: Rig,
    x: Float[np.ndarray, "frame vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    times: Float[np.ndarray, " frame"],
    *,
    flaws: Flaws = TYPICAL,
    seed: int = 0,
) -> None:
    """Write what the cameras of a rig see of a moving mesh [m] on a table at z = 0, at `times` [s].

    With cameras.json, without colour. Raises ValueError when a camera does not see the mesh,
    OSError naming the file that cannot be written.
    """
    folder, faces = Path(folder), np.asarray(faces)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / NAME, asdict(rig))
    # in cells, so that few of them reach behind a camera
    table = rectangle((TABLE, TABLE), (TABLE_CELLS + 1, TABLE_CELLS + 1))
    plane = np.pad(np.asarray(table.rest) - TABLE / 2, ((0, 0), (0, 1)))
    both = np.concatenate([faces, x.shape[1] + np.asarray(table.faces)])
    for order, (name, camera) in enumerate(rig.cameras.items()):
        depths, masks = folder / name / "depth", folder / name / "masks"
        depths.mkdir(parents=True, exist_ok=True)
        masks.mkdir(exist_ok=True)
        rows = [f"{frame},{time:.6f}\n" for frame, time in enumerate(times)]
        write_text(folder / name / "times.csv", "frame,time\n" + "".join(rows))
        for frame, positions in enumerate(x):
            generator = np.random.default_rng([seed, order, frame])
            mesh = np.concatenate([np.asarray(positions), plane]), both
            depth, which = render(camera, *mesh)
            mask = (which >= 0) & (which < len(faces))
            if not mask.any() and not camera.may_miss:
                raise ValueError(f"camera {name!r} does not see the mesh in frame {frame}")
            file = f"{frame:03d}.png"
            seen = flawed_depth(camera, depth, which, *mesh, flaws, generator)
            write_depth(depths / file, seen, camera.depth_scale)
            marked = flawed_mask(mask, flaws.mask_error, generator)
            write_bytes(masks / file, encode_png(marked.astype(np.uint8) * 255))


def flawed_depth(
    camera: DepthCamera,
    depth: Float[np.ndarray, "down across"],
    which: Int[np.ndarray, "down across"],
    x: Float[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    flaws: Flaws,
    generator: np.random.Generator,
) -> Float[np.ndarray, "down across"]:
    """A rendered depth image [m] (with the faces that it shows) as a real camera gives it."""
    flawed = depth.copy()
    edges = np.flatnonzero(depth_jumps(depth, STEP))
    chance = generator.random(len(edges))
    mixed = edges[chance < flaws.edge_mixed]
    flawed.flat[mixed] = _mix(depth, mixed, generator)
    flawed.flat[edges[chance > 1 - flaws.edge_holes]] = 0
    if flaws.noise > 0:
        flawed += flaws.noise * flawed**2 * generator.standard_normal(depth.shape, np.float32)
    if flaws.holes > 0:
        flawed[generator.random(depth.shape, np.float32) < flaws.holes] = 0
    if flaws.grazing < 90:
        flawed[_turned_away(camera, which, x, faces, flaws.grazing)] = 0
    return np.where(depth > 0, np.maximum(flawed, 0), 0)


def flawed_mask(
    mask: Bool[np.ndarray, "down across"], error: float, generator: np.random.Generator
) -> Bool[np.ndarray, "down across"]:
    """A mask whose border wanders by `error` pixels (standard deviation), smoothly along it."""
    if error == 0 or not mask.any() or mask.all():
        return mask
    signed = np.asarray(distance_transform_edt(mask)) - distance_transform_edt(~mask)
    coarse = [size // 8 + 2 for size in mask.shape]  # it changes over about 16 pixels
    field = gaussian_filter(generator.standard_normal(coarse), 1)
    wander = zoom(field / field.std(), 8, order=1)[: mask.shape[0], : mask.shape[1]]
    return signed + error * wander > 0


def _mix(depth: np.ndarray, places: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Depths between those of pixels and of the neighbour that differs most."""
    padded = np.pad(depth, 1, mode="edge")
    shifts = padded[1:-1, 2:], padded[2:, 1:-1], padded[1:-1, :-2], padded[:-2, 1:-1]
    beside = np.stack([shifted.flat[places] for shifted in shifts])
    own = depth.flat[places]
    apart = np.where(beside > 0, np.abs(beside - own), 0)
    other = beside[apart.argmax(axis=0), np.arange(len(places))]
    return own + generator.random(len(places)) * np.where(apart.any(axis=0), other - own, 0)


def _turned_away(camera, which, x, faces, limit: float) -> Bool[np.ndarray, "down across"]:
    corners = from_world(camera, np.asarray(x, np.float64))[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    normal = normals[which]  # where there is no face, any: nothing is seen
    ray = rays(camera)
    along = np.abs(normal[..., 2] + (normal[..., :2] * ray).sum(axis=-1))
    return along < np.cos(np.deg2rad(limit)) * np.sqrt(1 + (ray**2).sum(axis=-1))
