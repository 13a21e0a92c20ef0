"""Images in files: depth, masks, video."""

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Num, UInt8

from r2s._util.checks import SHOWN
from r2s._util.extras import require
from r2s._util.files import write_bytes
from r2s.recordings.clocks import find_frames
from r2s.recordings.clouds import read_values

PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


def read_grey(path: Path | str) -> Iterator[UInt8[np.ndarray, "height width"]]:
    """The frames of a video, or of a folder of numbered images (`r2s.recordings.clocks`), as
    grey images.

    Raises FileNotFoundError, ImportError (names the extra), or ValueError (file and frame).
    """
    path = Path(path)
    frames = _images(path) if path.is_dir() else _video(path)
    size = None
    for number, (name, image) in enumerate(frames):
        size = size or image.shape
        if image.shape != size:
            raise ValueError(
                f"{name}: frame {number} has {image.shape[1]} x {image.shape[0]} pixels, the first "
                f"{size[1]} x {size[0]}: one recording needs one size"
            )
        yield np.asarray(image, np.uint8)


def _images(folder: Path) -> Iterator[tuple[Path, np.ndarray]]:
    cv2 = require("cv2", "camera", "videos and images")
    frames = find_frames(folder, IMAGES)
    if missing := frames.missing:
        raise ValueError(
            f"{folder}: frame {missing[0]} (counted from the first) is missing: restore it, or "
            "number the frames without gaps and give their times"
        )
    for file in frames.files:
        if file.suffix.lower() == ".png":
            read_png(file)  # of a cut one OpenCV takes the rows that are there
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise ValueError(f"{file}: damaged: copy it again from the camera")
        yield file, image


def _video(path: Path) -> Iterator[tuple[Path, np.ndarray]]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such video file or folder of images")
    cv2 = require("cv2", "camera", "videos and images")
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise ValueError(f"{path}: no video that OpenCV can read: convert it to MP4 (H.264)")
    promised, number = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0
    try:
        while (frame := capture.read())[0]:
            number += 1
            image = frame[1]
            yield path, image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    except cv2.error as error:
        words = f"{path}: frame {number} cannot be read: {str(error)[:SHOWN]}"
        raise ValueError(f"{words}: it is damaged; copy it again") from error
    finally:
        capture.release()
    if number < max(promised - 1, 1):  # some containers count one frame too many
        raise ValueError(
            f"{path}: frame {number} cannot be read, of {promised} that the file promises: it is "
            "cut short or damaged; copy it again, or cut it before that frame"
        )


def read_png(path: Path) -> np.ndarray:
    """The pixels of a PNG, as they are; ValueError that names a file that is none or damaged."""
    cv2 = require("cv2", "camera", "images")
    data = path.read_bytes()
    if not data.startswith(PNG_START):
        raise ValueError(
            f"{path}: no PNG: found the bytes {data[:8]!r}: export it as PNG, depth also as NPY"
        )
    pixels = np.frombuffer(data, np.uint8)
    image = cv2.imdecode(pixels, cv2.IMREAD_UNCHANGED) if _is_whole(data) else None
    if image is None:
        what = "damaged" if PNG_END in data[-64:] else "truncated"
        raise ValueError(f"{path}: {what} PNG of {len(data)} bytes: copy or export it again")
    return image


def _is_whole(data: bytes) -> bool:
    """Whether the chunks of a PNG follow each other to its end, each with its checksum (ISO 15948).

    By hand: OpenCV takes a part for the whole, and reserves the gigabytes that a damaged length
    asks for.
    """
    at = len(PNG_START)
    while at + 12 <= len(data):  # length, name, what is in it, checksum
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end
    return False


DEPTHS, MASKS, COLOURS = (".png", ".npy"), (".png",), (".png", ".jpg", ".jpeg")
FARTHEST, NEAREST = 20.0, 0.02  # [m], of median depths; no camera of a fabric measures others
DEEPEST = 65535  # units of depth that 16 bits hold


def read_depth(
    path: Path, scale: float, resolution: tuple[int, int]
) -> Float[np.ndarray, "down across"]:
    """A depth image in metres; 0 where the camera measured nothing (0, NaN or infinity in files).

    16-bit PNG or NPY, `scale` metres per unit, `resolution` pixels (across, down). Raises
    FileNotFoundError, or ValueError that names the file.
    """
    units = read_values(path, None) if path.suffix.lower() == ".npy" else read_png(path)
    if units.ndim != 2 or units.dtype == np.uint8:
        kind = f"{8 * units.dtype.itemsize} bits in {units.shape[2] if units.ndim > 2 else 1}"
        raise ValueError(
            f"{path}: expected depth as a 16-bit PNG or NPY of one channel, found {kind}: "
            "export the raw depth, not a picture of it"
        )
    _check_size(path, units, resolution, "export the depth at the resolution of the calibration")
    depth = np.asarray(units, np.float32)
    depth = np.where(np.isfinite(depth), depth, np.float32(0))
    if (depth < 0).any():
        raise ValueError(
            f"{path}: {(depth < 0).sum()} depths are negative, the least is {depth.min():g}: "
            "depth is the distance along the camera's axis, 0 where unknown"
        )
    depth = depth * np.float32(scale)
    if not (depth > 0).any():
        raise ValueError(f"{path}: no pixel has a depth: drop the frame from all folders")
    median = float(np.median(depth[depth > 0]))
    if not NEAREST <= median <= FARTHEST:
        raise ValueError(
            f"{path}: the median depth is {median:g} m with depth_scale {scale:g}: depth_scale is "
            "metres per unit of the file, 0.001 for millimetres, 1 for metres"
        )
    return depth


def read_mask(path: Path, resolution: tuple[int, int]) -> Bool[np.ndarray, "down across"]:
    """Which pixels a mask marks: those that are not zero, in any channel but opacity.

    Raises as `read_depth`.
    """
    image = read_png(path)
    _check_size(path, image, resolution, "make the masks in the pixels of the depth images")
    return image != 0 if image.ndim == 2 else (image[..., :3] != 0).any(axis=2)


def read_colour(path: Path, resolution: tuple[int, int]) -> UInt8[np.ndarray, "down across 3"]:
    """Red, green and blue of an image, PNG or JPG, in the pixels of the depth; as `read_depth`."""
    cv2 = require("cv2", "camera", "colour images")
    if path.suffix.lower() == ".png":
        read_png(path)  # of a cut one OpenCV takes the rows that are there
    data = np.frombuffer(path.read_bytes(), np.uint8)
    whole = path.suffix.lower() == ".png" or b"\xff\xd9" in data[-64:].tobytes()  # JPG's end
    # the camera's pixels, also where a tag asks viewers to turn them
    how = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, how) if whole else None
    if image is None:
        raise ValueError(f"{path}: damaged or truncated image of {len(data)} bytes: copy it again")
    _check_size(path, image, resolution, "register colour to depth, as the camera's driver can")
    return image[..., ::-1]


def encode_png(image: Num[np.ndarray, "down across *channel"]) -> bytes:
    """An image of 8 or 16 bits as PNG; colour in the order blue, green, red."""
    cv2 = require("cv2", "camera", "depth images")
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def write_depth(path: Path, depth: Float[np.ndarray, "down across"], scale: float) -> None:
    """Write a depth image [m] as a 16-bit PNG in units of `scale` [m]; ValueError: does not fit."""
    units = np.rint(depth / scale)
    if units.max() > DEEPEST:
        raise ValueError(f"{depth.max():g} m does not fit into 16 bits of {scale:g} m")
    write_bytes(path, encode_png(units.astype(np.uint16)))


def _check_size(path: Path, image: np.ndarray, resolution: tuple[int, int], remedy: str) -> None:
    down, across = image.shape[:2]
    if (across, down) != tuple(resolution):
        raise ValueError(
            f"{path}: the image has {across} x {down} pixels, cameras.json says "
            f"{resolution[0]} x {resolution[1]}: {remedy}"
        )
