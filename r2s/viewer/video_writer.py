"""Pictures, one after the other, as a video file: an MP4 where OpenCV is installed, else a GIF."""

import importlib.util
import io
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from r2s._util.extras import require
from r2s._util.files import write_bytes

Ending = Literal["auto", "gif", "mp4"]
Pictures = Iterable[UInt8[np.ndarray, "height width 3"]]


def write_video(
    folder: Path, stem: str, pictures: Pictures, interval: float, ending: Ending = "auto"
) -> Path:
    """Write `stem`.mp4 or `stem`.gif into a folder; its path. "auto" is MP4 with OpenCV, else GIF.

    `interval`: between two pictures, [s].
    """
    if ending == "auto":
        ending = "gif" if importlib.util.find_spec("cv2") is None else "mp4"
    write = write_mp4 if ending == "mp4" else write_gif
    return write(folder / f"{stem}.{ending}", pictures, interval)


def write_gif(path: Path, pictures: Pictures, interval: float) -> Path:
    """Write pictures, one each `interval` [s], as a GIF, of up to 50 a second."""
    from PIL import Image  # comes with matplotlib

    images = [Image.fromarray(pixels) for pixels in pictures]
    # One palette for all, from the fullest picture: else colours flicker, and files are larger.
    palette = images[len(images) // 2].quantize(64)
    small = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    buffer = io.BytesIO()
    # GIFs count in hundredths of a second: round the times, not the intervals, which would add up.
    times = np.round(100 * interval * np.arange(len(small) + 1))
    duration = [max(20, 10 * int(step)) for step in np.diff(times)]  # [ms]
    options = {"save_all": True, "append_images": small[1:], "loop": 0, "optimize": False}
    small[0].save(buffer, format="GIF", duration=duration, **options)
    write_bytes(path, buffer.getvalue())
    return path


def write_mp4(path: Path, pictures: Pictures, interval: float) -> Path:
    """Write pictures of even sides, one each `interval` [s], as an MP4.

    Needs OpenCV: pip install 'r2s[camera]'. Raises OSError where it cannot write MP4.
    """
    cv2 = require("cv2", "camera", "videos as MP4 (a GIF needs no extra)")
    with tempfile.TemporaryDirectory(dir=path.parent) as place:
        part = Path(place) / "video.mp4"
        writer = None
        for pixels in pictures:
            if writer is None:
                code = cv2.VideoWriter.fourcc(*"mp4v")
                writer = cv2.VideoWriter(str(part), code, 1 / interval, pixels.shape[1::-1])
                if not writer.isOpened():
                    raise OSError(f"{path}: OpenCV cannot write MP4 here: ask for a GIF")
            writer.write(np.ascontiguousarray(pixels[..., ::-1]))
        if writer is not None:
            writer.release()
        write_bytes(path, part.read_bytes())
    return path
