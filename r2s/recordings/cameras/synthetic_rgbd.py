"""Synthetic RGB-D recordings: a moving mesh as folders of images."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from r2s.files import write_bytes, write_text
from r2s.recordings.cameras.flaws import TYPICAL, Flaws, flawed_depth, flawed_mask
from r2s.recordings.cameras.images import encode_png, write_depth
from r2s.recordings.cameras.render import render
from r2s.recordings.cameras.rgbd import Rig, write_rig

TABLE_CELLS = 8  # along each side, so that few of them reach behind a camera
FABRIC_COLOUR, TABLE_COLOUR = (60, 60, 200), (120, 140, 150)  # blue, green, red


def write_rgbd(
    folder: Path | str,
    rig: Rig,
    x: Float[np.ndarray, "frame vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    times: Float[np.ndarray, " frame"],
    *,
    table: tuple[float, float] | None = (0.0, 2.0),
    flaws: Flaws = TYPICAL,
    seed: int = 0,
    delays: Mapping[str, float] | None = None,
    colour: bool = True,
    suffix: str = ".png",
) -> None:
    """Write what the cameras of a rig see of a moving mesh [m], with cameras.json.

    `table`: its height and its side [m], around the origin; None: there is none. `times` [s];
    `delays` [s] are added to those of the cameras that they name, whose pictures stay the same.
    `suffix` of the depth images: .png or .npy. Raises ValueError when a camera never sees the
    mesh, OSError naming the file that cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_rig(folder, rig)
    for order, (name, camera) in enumerate(rig.cameras.items()):
        for kind in ("depth", "masks", "colour")[: 3 if colour else 2]:
            (folder / name / kind).mkdir(parents=True, exist_ok=True)
        late = np.asarray(times) + (delays or {}).get(name, 0.0)
        rows = [f"{frame},{time:.6f}\n" for frame, time in enumerate(late)]
        write_text(folder / name / "times.csv", "frame,time\n" + "".join(rows))
        for frame, positions in enumerate(x):
            generator = np.random.default_rng([seed, order, frame])
            mesh = _with_table(np.asarray(positions), np.asarray(faces), table)
            depth, which = render(camera, *mesh)
            mask = (which >= 0) & (which < len(faces))
            if not mask.any() and not camera.may_miss:
                raise ValueError(f"camera {name!r} does not see the mesh in frame {frame}")
            seen = flawed_depth(camera, depth, which, *mesh, flaws, generator)
            file = f"{frame:03d}.png"
            write_depth(folder / name / "depth" / f"{frame:03d}{suffix}", seen, camera.depth_scale)
            marked = flawed_mask(mask, flaws.mask_error, generator)
            write_bytes(folder / name / "masks" / file, encode_png(marked.astype(np.uint8) * 255))
            if colour:
                picture = _picture(depth, mask)
                write_bytes(folder / name / "colour" / file, encode_png(picture))


def _with_table(
    x: np.ndarray, faces: np.ndarray, table: tuple[float, float] | None
) -> tuple[np.ndarray, np.ndarray]:
    if table is None:
        return x, faces
    height, side = table
    line = np.linspace(-side / 2, side / 2, TABLE_CELLS + 1)
    plane = np.stack([*np.meshgrid(line, line), np.full((len(line),) * 2, height)], axis=-1)
    number = np.arange(len(line) ** 2).reshape(len(line), -1)
    a, b, c, d = (
        part.ravel()
        for part in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:])
    )
    cells = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    return np.concatenate([x, plane.reshape(-1, 3)]), np.concatenate([faces, len(x) + cells])


def _picture(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A picture shaded by how steeply depth changes."""
    down, across = np.gradient(depth)
    shade = 1 / (1 + 200 * np.hypot(down, across))
    colours = np.where(mask[..., None], FABRIC_COLOUR, TABLE_COLOUR) * (depth > 0)[..., None]
    return (colours * (0.4 + 0.6 * shade[..., None])).astype(np.uint8)
