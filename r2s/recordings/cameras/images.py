"""Depth images, masks and colour in files."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Num

from r2s._util.extras import require
from r2s._util.files import write_bytes
from r2s.recordings.readers.video import read_png

DEPTHS, MASKS, COLOURS = (".png", ".npy"), (".png",), (".png", ".jpg", ".jpeg")
FARTHEST, NEAREST = 20.0, 0.02  # [m], of median depths; no camera of a fabric measures others
DEEPEST = 65535  # units of depth that 16 bits hold


def read_depth(
    path: Path, scale: float, resolution: tuple[int, int]
) -> Float[np.ndarray, "down across"]:
    """A depth image in metres; 0 where the camera measured nothing (0, NaN or infinity in files).

    16-bit PNG or NPY, `scale` metres per unit, `resolution` pixels (across, down). Raises
    FileNotFoundError or ValueError that names the file: truncated, of another kind or size,
    negative depths, no depth at all, depths that are no metres.
    """
    units = _read_npy(path) if path.suffix.lower() == ".npy" else read_png(path)
    if units.ndim != 2 or units.dtype == np.uint8 or units.dtype.kind not in "uif":
        kind = f"{8 * units.dtype.itemsize} bits in {units.shape[2] if units.ndim > 2 else 1}"
        raise ValueError(
            f"{path}: expected depth as a 16-bit PNG or NPY of one channel, found {kind}: "
            "export the raw depth, not a picture of it"
        )
    _check_size(path, units, resolution, "export the depth at the resolution of the calibration")
    depth = np.asarray(units, np.float32)
    if units.dtype.kind == "f":
        depth = np.where(np.isfinite(depth), depth, np.float32(0))
    if (depth < 0).any():
        raise ValueError(
            f"{path}: {(depth < 0).sum()} depths are negative, the least is {depth.min():g}: "
            "depth is the distance along the camera's axis, 0 where unknown"
        )
    depth = depth * np.float32(scale)
    _check_unit(path, depth, scale)
    return depth


def read_mask(path: Path, resolution: tuple[int, int]) -> Bool[np.ndarray, "down across"]:
    """Which pixels a mask marks: those that are not zero, in any channel but opacity.

    Raises FileNotFoundError or ValueError that names the file: truncated, of another size.
    """
    image = read_png(path)
    _check_size(path, image, resolution, "make the masks in the pixels of the depth images")
    return image != 0 if image.ndim == 2 else (image[..., :3] != 0).any(axis=2)


def encode_png(image: Num[np.ndarray, "down across *channel"]) -> bytes:
    """An image of 8 or 16 bits as PNG; colour in the order blue, green, red."""
    cv2 = require("cv2", "camera", "depth images")
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def write_depth(path: Path, depth: Float[np.ndarray, "down across"], scale: float) -> None:
    """Write a depth image [m] in units of `scale` [m]: NPY, or 16-bit PNG.

    Raises ValueError for a depth that does not fit into 16 bits.
    """
    if path.suffix == ".npy":
        np.save(path, (depth / scale).astype(np.float32))
        return
    units = np.rint(depth / scale)
    if units.max() > DEEPEST:
        raise ValueError(f"{depth.max():g} m does not fit into 16 bits of {scale:g} m")
    write_bytes(path, encode_png(units.astype(np.uint16)))


def _check_size(path: Path, image: np.ndarray, resolution: tuple[int, int], remedy: str) -> None:
    found = image.shape[1], image.shape[0]
    if found != tuple(resolution):
        size = "{} x {}".format
        raise ValueError(
            f"{path}: the image has {size(*found)} pixels, cameras.json says {size(*resolution)}: "
            f"{remedy}"
        )


def _check_unit(path: Path, depth: np.ndarray, scale: float) -> None:
    sample = depth[::4, ::4]
    sample = sample[sample > 0]
    if len(sample) == 0 and not (depth > 0).any():
        raise ValueError(f"{path}: no pixel has a depth: drop the frame from all folders")
    if len(sample) and not NEAREST <= (middle := float(np.median(sample))) <= FARTHEST:
        raise ValueError(
            f"{path}: the median depth is {middle:g} m with depth_scale {scale:g}: depth_scale is "
            "metres per unit of the file, 0.001 for millimetres, 1 for metres"
        )


def _read_npy(path: Path) -> np.ndarray:
    try:
        values = np.load(path, allow_pickle=False)
        if not isinstance(values, np.ndarray):
            raise ValueError("an archive of arrays, expected one depth image")
    except FileNotFoundError:
        raise
    except Exception as error:  # a damaged file raises anything
        size = path.stat().st_size
        raise ValueError(f"{path}: damaged NPY of {size} bytes ({error}): copy it again") from error
    return values
