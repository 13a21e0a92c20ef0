"""CSV columns with units; force logs of a stretch."""

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
NEWTONS = {"N": 1.0, "mN": 1e-3, "cN": 1e-2, "kN": 1e3, "gf": 9.80665e-3, "kgf": 9.80665}
METRES = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
SHARES = {"-": 1.0, "%": 1e-2}
GRAMS = ("g", "kg", "grams", "kilograms")  # of mass: no force


class Columns(NamedTuple):
    """- `values`: in SI, column by column in the order in which they were asked for.
    - `lines`: of the file, where each sample stands.
    """

    values: Float[np.ndarray, "sample column"]
    lines: tuple[int, ...]


def read_columns(path: Path | str, columns: Mapping[str, Mapping[str, float]]) -> Columns:
    """Read some columns of a CSV with a header, separated by commas, semicolons or tabs.

    `columns`: their names and possible units. The header says which, as in "time_s", "Force [N]" or
    "force (mN)". Other columns, blank lines and lines that start with # are skipped.

    Raises FileNotFoundError, or a ValueError that names the file and the line.
    """
    path = Path(path)
    lines = read_lines(path)
    if not lines:
        raise ValueError(f"{path}: the log is empty")
    header = lines[0][1]
    places = [_column(path, header, name, units) for name, units in columns.items()]
    rows = []
    for number, cells in lines[1:]:
        if len(cells) != len(header):
            raise ValueError(
                f"{path}: line {number} has {len(cells)} columns, the header {len(header)}: it is "
                "cut short, or decimal commas part the columns (write decimal points)"
            )
        rows.append([number_in(path, number, cells[index]) * unit for index, unit in places])
    if len(rows) < 2:
        raise ValueError(f"{path}: expected two samples or more, found {len(rows)}")
    return Columns(np.array(rows), tuple(number for number, _ in lines[1:]))


def header_of(path: Path | str) -> list[str]:
    """The cells of a CSV's header; none of an empty file."""
    lines = read_lines(Path(path))
    return lines[0][1] if lines else []


def read_lines(path: Path) -> list[tuple[int, list[str]]]:
    """The cells of a CSV's lines with their numbers, but for blank ones and comments (#).

    Raises FileNotFoundError, or a ValueError that names the file.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: no text in UTF-8 ({error.reason}): export it again") from error
    kept = [
        (number, line)
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not kept:
        return []
    delimiter = max(",;\t", key=kept[0][1].count)
    cells = csv.reader([line for _, line in kept], delimiter=delimiter, skipinitialspace=True)
    numbers = [number for number, _ in kept]
    try:
        cells = list(cells)
    except csv.Error as error:
        raise ValueError(f"{path}: no CSV: {error}") from error
    if len(cells) != len(numbers):
        raise ValueError(f"{path}: a quotation mark is not closed")
    return [(n, [c.strip() for c in row]) for n, row in zip(numbers, cells, strict=True)]


def _column(
    path: Path, header: list[str], name: str, units: Mapping[str, float]
) -> tuple[int, float]:
    """The index of a column, and its unit in SI."""
    unit_of = r"(?:[\s_]*[\[(]?\s*([\w%-]+)\s*[\])]?)?"
    pattern = re.compile(re.escape(name) + unit_of, re.IGNORECASE)
    found = [(i, match[1]) for i, cell in enumerate(header) if (match := pattern.fullmatch(cell))]
    if len(found) != 1:
        raise ValueError(
            f"{path}: expected one column {name!r} with its unit, such as "
            f"'{name}_{next(iter(units))}', found {len(found)} in {header}: rename it, or name "
            "the column that is meant"
        )
    index, unit = found[0]
    if unit in GRAMS and "N" in units:
        raise ValueError(
            f"{path}: {header[index]!r} is a mass: a force is in N, or in gf where a scale shows "
            "grams (1 gf = 9.80665 mN): name the column force_gf if it does"
        )
    if unit not in units:
        raise ValueError(
            f"{path}: the unit of {header[index]!r} is not known: write one of {', '.join(units)} "
            f"into the header, as in '{name} [{next(iter(units))}]'"
        )
    return index, units[unit]


def number_in(path: Path, line: int, cell: str, what: str = "a finite number") -> float:
    """The number in a cell; ValueError that names the file and the line when there is none."""
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(f"{path}: line {line}: expected {what}, found {cell!r}: write a number")
    return value


WORST_FIT = 0.9  # share of the force's variance that the displacement must explain
FINEST = 1e-3  # [s], of the offsets that are tried


@dataclass(frozen=True)
class ForceLog:
    """A force over time: `times` [s], which increase, and `force` [N]; `name` is for errors."""

    times: Float[np.ndarray, " sample"]
    force: Float[np.ndarray, " sample"]
    name: str


def read_force_log(path: Path | str, time: str = "time", force: str = "force") -> ForceLog:
    """Read the columns `time` and `force` of a CSV, as `read_columns`.

    Their units: seconds (s, ms, us), newtons (N, mN, cN, kN, gf, kgf). Raises also ValueError for
    times that do not increase.
    """
    path = Path(path)
    values, lines = read_columns(path, {time: SECONDS, force: NEWTONS})
    later = np.diff(values[:, 0]) > 0
    if not later.all():
        at = int(later.argmin())
        first, then = values[at, 0], values[at + 1, 0]
        raise ValueError(
            f"{path}: line {lines[at + 1]}: times must increase, found {first:g} s, then "
            f"{then:g} s: sort the log, or keep one of samples that are there twice"
        )
    return ForceLog(values[:, 0], values[:, 1], str(path))


def at_frames(
    log: ForceLog, times: Float[np.ndarray, " frame"], offset: float = 0.0
) -> Float[np.ndarray, " frame"]:
    """The force [N] at the frames of a video, each the mean over the time of a frame.

    Frame i is taken at `times[i] + offset` [s] on the log's clock. Raises ValueError that names
    the frame: times that do not increase, a frame outside the log, or in a gap of it.
    """
    if len(times) == 0 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise ValueError("the times of the frames must be finite and increase [s]")
    at = times + offset
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    slack = 0.5 * interval
    for frame in np.flatnonzero((at < log.times[0] - slack) | (at > log.times[-1] + slack))[:1]:
        raise ValueError(
            f"{log.name}: frame {frame}, at {at[frame]:.3f} s on the log's clock, is outside of "
            f"the log, which runs from {log.times[0]:.3f} to {log.times[-1]:.3f} s: check the "
            f"offset ({offset:g} s), or use the frames in between"
        )
    gap = np.diff(log.times)
    after = np.clip(np.searchsorted(log.times, at), 1, len(log.times) - 1)
    wide = gap[after - 1] > max(5 * float(np.median(gap)), 2 * interval)
    for frame in np.flatnonzero(wide)[:1]:
        start = log.times[after[frame] - 1]
        raise ValueError(
            f"{log.name}: frame {frame}, at {at[frame]:.3f} s, is in a gap of the log, "
            f"{gap[after[frame] - 1]:.3f} s from {start:.3f} s on: leave these frames out"
        )
    return _means(log, at, slack)


def estimate_offset(
    log: ForceLog,
    times: Float[np.ndarray, " frame"],
    displacement: Float[np.ndarray, " frame"],
    longest: float = 5.0,
) -> float:
    """The offset [s] for `at_frames`, from the motion: that at which displacement explains force.

    `displacement` [m] is how far the pulled side went, for example the mean over its markers. The
    force is fitted by a cubic in the displacement, since fabrics stiffen, at offsets up to
    `longest` [s] from where both records begin together. The pull must begin and end in the video.

    Raises ValueError when nothing moves, when no offset explains 90 % of the force's variance, or
    when the best is at the end of the range.
    """
    if displacement.shape != times.shape or not np.isfinite(displacement).all():
        raise ValueError("give one finite displacement [m] for each frame's time")
    if np.ptp(displacement) == 0 or np.ptp(log.force) == 0:
        raise ValueError(f"{log.name}: nothing moves, or the force is constant: no offset shows")
    start = log.times[0] - times[0]
    step = max(FINEST, float(np.median(np.diff(times))) / 20)
    tried = start + np.arange(-longest, longest + step, step)
    basis = _cubic(displacement)
    # As noisy as it would be at the frames: else the cubic follows the noise of single samples.
    half = 0.5 * float(np.median(np.diff(times)))
    smooth = ForceLog(log.times, _means(log, log.times, half), log.name)
    fits = np.array([_explained(smooth, times, basis, offset) for offset in tried])
    best = int(fits.argmax())
    if not fits[best] > WORST_FIT:
        raise ValueError(
            f"{log.name}: at best the displacement explains {max(0.0, fits[best]):.0%} of the "
            f"force's variance, for offsets of {tried[0]:.2f} to {tried[-1]:.2f} s: is it the log "
            "of this video? Else give the offset"
        )
    if best in (0, len(tried) - 1) or not np.isfinite(fits[best - 1 : best + 2]).all():
        raise ValueError(
            f"{log.name}: the best offset, {tried[best]:.2f} s, is the last that the records "
            "allow: they must hold the rest before the pull and after it"
        )
    before, here, after = fits[best - 1 : best + 2]
    bend = before - 2 * here + after
    return float(tried[best] + (step * 0.5 * (before - after) / bend if bend < 0 else 0.0))


def _means(log: ForceLog, at: np.ndarray, half: float) -> np.ndarray:
    """The mean force within `half` [s] of times on the log's clock, as far as the log goes."""
    integral = make_interp_spline(log.times, log.force, k=1).antiderivative()
    low, high = (np.clip(at + sign * half, log.times[0], log.times[-1]) for sign in (-1, 1))
    width = high - low
    mean = (integral(high) - integral(low)) / np.where(width > 0, width, 1)
    return np.where(width > 0, mean, np.interp(at, log.times, log.force))


def _cubic(displacement: np.ndarray) -> np.ndarray:
    """An orthonormal basis of cubics in the displacement, over the frames."""
    scaled = (displacement - displacement.mean()) / np.ptp(displacement)
    return np.linalg.qr(np.stack([scaled**power for power in range(4)], axis=1))[0]


def _explained(log: ForceLog, times: np.ndarray, basis: np.ndarray, offset: float) -> float:
    """Which share of the force's variance at the frames a cubic in the displacement explains."""
    at = times + offset
    if at[0] < log.times[0] - 1e-9 or at[-1] > log.times[-1] + 1e-9:
        # Rest goes on before a log and after it, but not for long: half of the frames must be in.
        if ((at >= log.times[0]) & (at <= log.times[-1])).sum() < len(at) / 2:
            return -np.inf
    force = np.interp(at, log.times, log.force)
    force = force - force.mean()
    variance = float(force @ force)
    if variance < 0.25 * len(at) * float(np.var(log.force)):
        return -np.inf  # the pull is not in these frames
    return float(np.sum((basis.T @ force) ** 2)) / variance
