"""Cases of PhysTwin (Jiang et al., ICCV 2025): tracked points of an object and of the hands on it.

A case is a folder with `final_data.pkl`, as `data_process/data_process_sample.py` of the public
code writes it (repository Jianghanxiao/PhysTwin, commit 44f17cc, MIT licence): arrays of
`object_points` and `controller_points`, in metres, z downwards, 30 frames a second, and which
points were seen and moved plausibly. Read by the layout of that code; the published cases were not
at hand. Only arrays of numbers are read from the pickle, no code.
"""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.cluster.vq import kmeans2

from r2s._util.extras import require
from r2s.recordings.clouds import numbers
from r2s.recordings.recording import (
    CORNERS,
    Recording,
    RecordingInfo,
    SheetPlacement,
    corner,
    make_recording,
)

FILE = "final_data.pkl"
RATE = 30.0  # frames a second
UPWARDS = np.array([1.0, -1.0, -1.0])  # its z is down
ARRAYS: dict[str, tuple[str | int, ...]] = {
    "object_points": ("frame", "point", 3),
    "object_visibilities": ("frame", "point"),
    "object_motions_valid": ("frame", "point"),
    "controller_points": ("frame", "controller", 3),
}
# names that a pickle of arrays holds, where "core" stands for "_core", too
ALLOWED = {
    "numpy.ndarray",
    "numpy.dtype",
    "numpy.core.multiarray._reconstruct",
    "numpy.core.multiarray.scalar",
    "numpy.core.numeric._frombuffer",
}


def read_case(
    folder: Path | str, sheet: SheetPlacement | None = None, hands: int | None = None
) -> Recording:
    """The recording of a case of a cloth, such as `single_lift_cloth_1`.

    - `sheet`: the rectangle that stands for the cloth; None: the smallest one around its points in
      the first frame, which must lie flat, held at the corners that are nearest to the hands.
    - `hands`: how many there are; None: two where the name begins with "double", else one. The
      controllers of a hand move a corner by their mean.

    Clouds are the points that were seen and moved plausibly in each frame. The table is where the
    lowest of them are in the first frame (1 % of them below).

    Raises FileNotFoundError or ValueError that names the file: no such case, a pickle that holds
    more than arrays, arrays that are missing or of other shapes, a frame without points, a sheet
    held at another number of corners than there are hands.
    """
    folder = Path(folder)
    arrays = _arrays(folder / FILE)
    points = arrays["object_points"] * UPWARDS
    kept = arrays["object_visibilities"].astype(bool)
    # a motion is that to the next frame: the last frame has none
    kept[1:] &= arrays["object_motions_valid"].astype(bool)[:-1]
    clouds = [points[frame][mask] for frame, mask in enumerate(kept)]
    for frame, cloud in enumerate(clouds):
        if not len(cloud):
            raise ValueError(f"{folder / FILE}: no point was seen in frame {frame}")
    count = hands or (2 if folder.name.startswith("double") else 1)
    paths = _hands(arrays["controller_points"] * UPWARDS, count)
    placed = sheet or _around(clouds[0], paths[0])
    if len(placed.pinned) != count:
        raise ValueError(
            f"{folder}: {count} hands hold the sheet, found {len(placed.pinned)} corners"
        )
    corners = np.array([corner(placed, name) for name in placed.pinned])
    times = np.arange(len(clouds)) / RATE
    info = RecordingInfo(
        name=folder.name,
        scenario="lifting",
        fabric=folder.name,
        trial="1",
        source=f"PhysTwin, {folder.name}",
        frames_used=(0, len(clouds) - 1),
        sheet=placed,
        table_height=float(np.quantile(clouds[0][:, 2], 0.01)),
        verified=None,
    )
    return make_recording(clouds, times, corners + (paths - paths[:1]), times, info)


class _Arrays(pickle.Unpickler):
    """Reads arrays, and nothing that could run."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        if f"{module_name.replace('._core', '.core')}.{global_name}" not in ALLOWED:
            raise pickle.UnpicklingError(f"it holds {module_name}.{global_name}, which is no array")
        return super().find_class(module_name, global_name)


def _arrays(file: Path) -> dict[str, np.ndarray]:
    if not file.exists():
        raise FileNotFoundError(f"{file}: no such case of PhysTwin")
    try:
        with open(file, "rb") as stream:
            stored = _Arrays(stream).load()
        lacking = ARRAYS.keys() - stored.keys()
    except Exception as error:  # a damaged pickle raises anything
        raise ValueError(f"{file}: no arrays of PhysTwin: {error}") from error
    if lacking:
        raise ValueError(f"{file}: lacks {', '.join(lacking)}, has {', '.join(map(str, stored))}")
    shape = np.shape(stored["object_visibilities"])
    sizes: dict[Any, int] = dict(zip(("frame", "point"), shape, strict=False))
    try:
        return {
            name: numbers(name, stored[name], *(sizes.get(axis, axis) for axis in shape))
            for name, shape in ARRAYS.items()
        }
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def _hands(
    controllers: Float[np.ndarray, "frame controller 3"], count: int
) -> Float[np.ndarray, "frame hand 3"]:
    """Mean places of the controllers of each hand, the one that is first along x first."""
    if count == 1:
        return controllers.mean(axis=1, keepdims=True)
    first = controllers[0]
    ends = first[[np.argmin(first[:, 0]), np.argmax(first[:, 0])]]
    _, which = kmeans2(first, ends, minit="matrix")
    return np.stack([controllers[:, which == hand].mean(axis=1) for hand in range(2)], axis=1)


def _around(
    cloud: Float[np.ndarray, "point 3"], hands: Float[np.ndarray, "hand 3"]
) -> SheetPlacement:
    """The smallest rectangle around a cloud that lies, held where the hands are."""
    cv2 = require("cv2", "camera", "a sheet around points")
    centre, sides, degrees = cv2.minAreaRect(cloud[:, :2].astype(np.float32))
    cosine, sine = float(np.cos(np.radians(degrees))), float(np.sin(np.radians(degrees)))
    x, y = centre - np.array([[cosine, -sine], [sine, cosine]]) @ sides / 2
    sheet = SheetPlacement(
        size=sides,
        origin=(float(x), float(y), float(np.median(cloud[:, 2]))),
        warp=(cosine, sine, 0.0),
        weft=(-sine, cosine, 0.0),
        pinned=(),
    )
    places = np.array([corner(sheet, name) for name in CORNERS])
    nearest = np.linalg.norm(places - hands[:, None], axis=-1).argmin(axis=1)
    return replace(sheet, pinned=tuple(list(CORNERS)[index] for index in nearest))
