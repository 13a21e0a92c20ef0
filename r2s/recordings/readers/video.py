"""Frames of a video file or of a folder of images. Needs OpenCV: pip install 'r2s[camera]'."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from r2s._util.extras import require
from r2s.recordings.readers.numbered import find_numbered

PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


def read_grey(path: Path | str) -> Iterator[UInt8[np.ndarray, "height width"]]:
    """The frames of a video, one after the other, as grey images.

    `path`: a video file, or a folder of images of one format, numbered as for `find_numbered`.

    Raises FileNotFoundError, ImportError (names the extra), or a ValueError that names the file
    and the frame: no video, no images, one that is damaged or of another size than the first, a
    video that ends early; and as `find_numbered`.
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
        yield image


def _images(folder: Path) -> Iterator[tuple[Path, np.ndarray]]:
    cv2 = require("cv2", "camera", "videos and images")
    for file in find_numbered(folder, IMAGES).values():
        if file.suffix.lower() == ".png":
            read_png(file)  # of a cut one OpenCV takes the rows that are there
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise ValueError(f"{file}: damaged: copy it again from the camera")
        yield file, np.asarray(image, np.uint8)


def _video(path: Path) -> Iterator[tuple[Path, np.ndarray]]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such video file or folder of images")
    cv2 = require("cv2", "camera", "videos and images")
    capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise ValueError(f"{path}: no video that OpenCV can read: convert it to MP4 (H.264)")
        promised, number = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0
        while (found := capture.read())[0]:
            number += 1
            image = found[1] if found[1].ndim == 2 else cv2.cvtColor(found[1], cv2.COLOR_BGR2GRAY)
            yield path, np.asarray(image, np.uint8)
    finally:
        capture.release()
    if number < promised - 1:  # some containers count one frame too many
        raise ValueError(
            f"{path}: frame {number} cannot be read, of {promised} that the file promises: it is "
            "cut short or damaged; copy it again, or cut it before that frame"
        )
    if number == 0:
        raise ValueError(f"{path}: the video has no frames")


def read_png(path: Path) -> np.ndarray:
    """The pixels of a PNG, as they are; ValueError that names a file that is none or damaged."""
    cv2 = require("cv2", "camera", "images")
    data = path.read_bytes()
    if not data.startswith(PNG_START):
        raise ValueError(
            f"{path}: no PNG: found the bytes {data[:8]!r}: export it as PNG, depth also as NPY"
        )
    # by hand, since the decoder says nothing, or takes a part for the whole
    is_whole = PNG_END in data[-64:]
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if is_whole else None
    if image is None:
        what = "damaged" if is_whole else "truncated"
        raise ValueError(f"{path}: {what} PNG of {len(data)} bytes: copy or export it again")
    return image
