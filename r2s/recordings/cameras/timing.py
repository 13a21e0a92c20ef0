"""When frames were taken, and which frames of several cameras belong together."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from r2s.recordings.readers.columns import number_in, read_lines

LONGEST = 5.0  # [s] between frames: above, times are taken for milliseconds or nanoseconds


def read_times(path: Path) -> Float[np.ndarray, " frame"]:
    """The frames' times [s] from the last column of a CSV file; a line of titles may come first.

    Raises FileNotFoundError, or ValueError that names the file and the line: no number, times that
    do not increase, or intervals that seconds cannot have.
    """
    rows = read_lines(path)
    if rows and re.match("[A-Za-z]", rows[0][1][-1]):
        rows = rows[1:]
    times = np.array(
        [number_in(path, number, cells[-1], "a time [s] last") for number, cells in rows]
    )
    if len(times) == 0:
        raise ValueError(f"{path}: no times: expected one line a frame, its time [s] last")
    steps = np.diff(times)
    if (steps <= 0).any():
        at = int((steps <= 0).argmax())
        word = "twice" if steps[at] == 0 else "before the time of the line above"
        raise ValueError(
            f"{path}: line {rows[at + 1][0]}: {times[at + 1]:.9g} s is there {word} "
            f"({times[at]:.9g} s): sort the frames by time and drop those that are repeated"
        )
    if len(steps) and np.median(steps) > LONGEST:
        raise ValueError(
            f"{path}: frames are {np.median(steps):g} s apart: give times in seconds, "
            "not in milliseconds or nanoseconds"
        )
    return times


def pair(
    times: Mapping[str, Float[np.ndarray, " frame"]], tolerance: float
) -> dict[str, Int[np.ndarray, " pair"]]:
    """For each camera the indices of its frames, one a pair, nearest in time [s] to the first's.

    Frames of the first camera before or after the others ran are left out. `tolerance` is what
    times of a pair may differ by [s], 0 for half the interval of the first camera. Raises
    ValueError that names camera, frame and time where none is near enough, or none ran at once.
    """
    first, clock = next(iter(times.items()))
    if tolerance == 0:
        tolerance = float(np.median(np.diff(clock)) / 2) if len(clock) > 1 else 0.0
    begin = max(t[0] for t in times.values()) - tolerance
    end = min(t[-1] for t in times.values()) + tolerance
    used = np.flatnonzero((clock >= begin) & (clock <= end))
    if len(used) == 0:
        spans = ", ".join(f"{name} {t[0]:g} to {t[-1]:g} s" for name, t in times.items())
        raise ValueError(f"the cameras never ran at once: {spans}: check that they share a clock")
    pairs = {first: used}
    for name, other in times.items():
        nearest = np.abs(other[None] - clock[used, None]).argmin(axis=1)
        apart = np.abs(other[nearest] - clock[used])
        if (apart > tolerance * (1 + 1e-9)).any():
            at = int(apart.argmax())
            raise ValueError(
                f"frame {used[at]} of {first} at {clock[used[at]]:g} s has no frame of {name} "
                f"within {tolerance:g} s, the nearest is at {other[nearest[at]]:g} s: restore the "
                "frame, or raise pair_tolerance"
            )
        pairs[name] = nearest
    return pairs
