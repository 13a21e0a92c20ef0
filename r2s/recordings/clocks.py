"""When frames were taken: by a file of times, stamps or numbers in the names of their files."""

import re
import warnings
from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from r2s.recordings.clouds import list_frames
from r2s.recordings.force_log import check_increasing, number_in, read_lines

TABLE = "times.csv"  # in a folder of frames: their times [s], read by `read_times`
LONGEST = 5.0  # [s] between frames: above, times are taken for milliseconds or nanoseconds
EPOCH = 1e6  # [s]: later times count from 1970, or from when a machine was started
DIGITS = {13: 1e-3, 16: 1e-6, 19: 1e-9}  # of stamps that are whole numbers, and their unit [s]
MOST_MISSING = 0.9  # of the frames, or their numbers are something else
MOST_BEYOND = 0.5  # of the frames that count, that may be dropped at the end
DAY = re.compile(  # as in 2026-11-30_21-33-59.900, or 20261130_213359.900
    r"(?<!\d)(\d{4})-?([01]\d)-?([0-3]\d)[T_ -]([0-2]\d)[-:_]?([0-5]\d)[-:_]?([0-5]\d)"
    r"\.(\d{1,9})(?!\d)"
)
CLOCK = re.compile(r"(?<!\d)(\d{9,10})\.(\d{1,9})(?!\d)")  # anywhere, as in t1700000100.02_left
SECONDS = re.compile(r"(?:^|[^0-9A-Za-z.])(\d+)\.(\d+)$")  # as in 1700000100.001234567
PARTED = re.compile(r"(?:^|\D)(\d{9,10})[_-](\d{9}|\d{6})$")  # as in 1700000100_001234567
WHOLE = re.compile(r"(?:^|\D)(\d{13}|\d{16}|\d{19})$")


class Frames(NamedTuple):
    """The files of frames in the order of time.

    - `keys`: the number or the time [s] in each name.
    - `numbers`: those in the names less that of the first frame; of stamped files from 0 on.
    - `stamps`: the times in their names, [s]; None: they have numbers.
    """

    files: list[Path]
    keys: list[float]
    numbers: list[int]
    stamps: Float[np.ndarray, " frame"] | None

    @property
    def missing(self) -> list[int]:
        """The first number of each gap."""
        numbers = np.array([-1, *self.numbers])
        return (numbers[:-1][np.diff(numbers) > 1] + 1).tolist()


def find_frames(folder: Path | str, suffixes: Collection[str], first: int | None = None) -> Frames:
    """The frames of a folder, by the numbers or the times in their names (`000.npy`,
    `frame_12.npy`, `1700000100.001234567.pcd`, `1700000100001234567.npy`).

    Files without one of the `suffixes` or a number are skipped; numbers may be missing. `first`:
    the number of the frame at time 0; None: the least there is. Raises FileNotFoundError, or
    ValueError that names the folder and the frame.
    """
    files = list_frames(folder, suffixes)
    stamps = _stamps(Path(folder), files)
    if stamps is not None:
        order = np.argsort(stamps, kind="stable")
        ordered = [files[i] for i in order]
        for at in np.flatnonzero(np.diff(stamps[order]) == 0)[:1]:
            names = f"{ordered[at].name} and {ordered[at + 1].name}"
            raise ValueError(f"{folder}: {names} have the same time: which of them is the frame?")
        return Frames(ordered, stamps[order].tolist(), list(range(len(files))), stamps[order])
    frames: dict[float, Path] = {}
    for path in files:
        number = int(re.findall(r"[0-9]+", path.stem)[-1])
        other = frames.setdefault(number, path)
        if other != path:
            raise ValueError(
                f"{folder}: frame {number} is there twice: {other.name} and {path.name}: keep one, "
                "or, if the names are times, write these to times.csv, a line a frame"
            )
    keys = sorted(frames)
    start = int(keys[0]) if first is None else first
    if keys[0] < start:
        raise ValueError(f"{folder}: frame {keys[0]} comes before the first frame, {start}")
    return numbered_from(Frames([frames[key] for key in keys], keys, [], None), start)


def numbered_from(frames: Frames, first: int) -> Frames:
    """Frames whose numbers are those in their names less `first`; others as they are."""
    if frames.stamps is not None:
        return frames
    return frames._replace(numbers=[int(key - first) for key in frames.keys])


def has_table(folder: Path) -> bool:
    """Whether a folder of frames has a file of their times."""
    return (folder / TABLE).is_file()


def times_of(folder: Path, frames: Frames, rate: float) -> Float[np.ndarray, " frame"]:
    """The times [s] of frames: those of a file, else the stamps in their names, else their numbers
    over a rate [Hz], with a warning where numbers are missing."""
    path = folder / TABLE
    if has_table(folder):
        times = read_times(path)
        if len(times) != len(frames.files):
            raise ValueError(
                f"{path}: {len(times)} times, but {len(frames.files)} frames in {folder}: "
                "one line a frame"
            )
        return times
    if frames.stamps is not None:
        return frames.stamps
    if not rate > 0:
        raise FileNotFoundError(
            f"{path}: no such file, no times in the names of the frames, and no frame_rate: give "
            "one of them"
        )
    count = frames.numbers[-1] + 1
    missing = count - len(frames.numbers)
    if missing > MOST_MISSING * count:
        raise ValueError(
            f"{folder}: {count - missing} frames are numbered up to {count - 1} from the first: if "
            "these are times, write them to times.csv, the time [s] of each frame on a line"
        )
    if missing:
        words = ", ".join(map(str, frames.missing[:4]))
        warnings.warn(
            f"{folder}: {missing} of {count} frames are missing (from {words}, counted from the"
            " first): the others are taken at their numbers over the frame rate",
            stacklevel=2,
        )
    return np.array(frames.numbers) / rate


def places_of(folder: Path, used: Sequence[int], numbers: Sequence[int]) -> tuple[int, int]:
    """The first and the last frame that count, by their places, from those of their numbers, which
    may be of frames that were dropped. `used` empty: all."""
    if not used:
        return 0, len(numbers) - 1
    first, last = used
    places = [place for place, number in enumerate(numbers) if first <= number <= last]
    beyond, words = last - numbers[-1], f"{folder}: frames_used is {first}..{last}, but the frames"
    words += f" are numbered 0 to {numbers[-1]}, counted from the first"
    if not places or beyond > MOST_BEYOND * (last - first + 1):
        raise ValueError(words)
    if beyond > 0:
        warnings.warn(f"{words}: the last ones are taken to be dropped", stacklevel=3)
    return places[0], places[-1]


def read_times(path: Path) -> Float[np.ndarray, " frame"]:
    """The frames' times [s] from the last column of a CSV file; a line of titles may come first.

    Raises FileNotFoundError, or ValueError that names the file and the line.
    """
    rows = read_lines(path)
    if rows and re.match("[A-Za-z]", rows[0][1][-1]):
        rows = rows[1:]
    times = np.array([number_in(path, line, cells[-1], "a time [s] last") for line, cells in rows])
    if len(times) == 0:
        raise ValueError(f"{path}: no times: expected one line a frame, its time [s] last")
    check_increasing(path, [line for line, _ in rows], times)
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if interval > LONGEST:
        raise ValueError(
            f"{path}: frames are {interval:g} s apart: give times in seconds, not in milliseconds "
            "or nanoseconds"
        )
    return times


def _stamps(folder: Path, files: list[Path]) -> Float[np.ndarray, " frame"] | None:
    """The times in the names of all files, [s]; None where they are numbers."""
    stems = [path.stem for path in files]
    if all(whole := [WHOLE.search(stem) for stem in stems]):
        return np.array([int(m[1]) * DIGITS[len(m[1])] for m in whole if m])
    if all(parted := [PARTED.search(stem) for stem in stems]):
        return np.array([int(m[1]) + float(f"0.{m[2]}") for m in parted if m])
    if all(days := [DAY.search(stem) for stem in stems]):
        return np.array([_seconds(m) for m in days if m])
    if not all(pairs := [CLOCK.search(stem) or SECONDS.search(stem) for stem in stems]):
        return None
    seconds, fractions = zip(*((m[1], m[2]) for m in pairs if m), strict=True)
    widths = {len(fraction) for fraction in fractions}
    if len(widths) > 1 and int(seconds[0]) > EPOCH:
        raise ValueError(
            f"{folder}: the names are times whose fractions have {min(widths)} to {max(widths)} "
            "digits: decimals, or nanoseconds without their zeros? Write times.csv there, the time "
            "[s] of each frame on a line"
        )
    last = np.array([int(fraction) for fraction in fractions])
    if len(set(seconds)) == 1 and min(widths) >= 4 and np.all(np.diff(np.sort(last)) == 1):
        return None  # a version, and the number of a frame
    return np.array([float(f"{a}.{b}") for a, b in zip(seconds, fractions, strict=True)])


def _seconds(match: re.Match[str]) -> float:
    """The time [s] of a date and time of day in a name."""
    *parts, fraction = match.groups()
    day = datetime(*map(int, parts), tzinfo=UTC)  # no month 13 and no minute 61
    return day.timestamp() + float(f"0.{fraction}")
