"""Numbered files of a folder, such as the frames of a camera."""

import re
from collections.abc import Collection
from pathlib import Path


def find_numbered(
    folder: Path | str, suffixes: Collection[str], first: int | None = None
) -> dict[int, Path]:
    """The files of a folder with a number in their names (`000.npy`, `frame_12.npy`), in order.

    Other files and hidden files are passed over.

    - `suffixes`: the formats that are looked for, such as ".npy"; all files must have one of them.
    - `first`: the number that the first file must have; None: any.

    The number is the last group of digits in the name. Raises FileNotFoundError (no such folder,
    no such file) or ValueError (mixed formats, two files of one number, a number is missing).
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    found = [(_number(path, suffixes), path) for path in sorted(folder.iterdir())]
    numbered = [(number, path) for number, path in found if number is not None]
    if not numbered:
        formats = f"formats: {', '.join(suffixes)}"
        raise FileNotFoundError(
            f"{folder}: no numbered frames such as 000{next(iter(suffixes))} ({formats})"
        )
    formats = sorted({path.suffix.lower() for _, path in numbered})
    if len(formats) > 1:
        raise ValueError(f"{folder}: frames of mixed formats: {', '.join(formats)}")
    frames: dict[int, Path] = {}
    for number, path in numbered:
        if number in frames:
            names = f"{frames[number].name} and {path.name}"
            raise ValueError(f"{folder}: frame {number} is there twice: {names}: remove one")
        frames[number] = path
    start = min(frames) if first is None else first
    for number in range(start, max(frames)):
        if number not in frames:
            found = f"found {len(frames)} frames from {min(frames)} to {max(frames)}"
            raise ValueError(
                f"{folder}: frame {number} is missing ({found}): restore it, or number the frames "
                "without gaps"
            )
    if min(frames) < start:
        raise ValueError(f"{folder}: frame {min(frames)} comes before the first frame, {start}")
    return dict(sorted(frames.items()))


def _number(path: Path, suffixes: Collection[str]) -> int | None:
    if path.name.startswith(".") or path.suffix.lower() not in suffixes or not path.is_file():
        return None
    digits = re.findall(r"[0-9]+", path.stem)
    return int(digits[-1]) if digits else None
