"""CSV columns with units; force logs of a stretch."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
NEWTONS = {"N": 1.0, "mN": 1e-3, "cN": 1e-2, "kN": 1e3, "gf": 9.80665e-3, "kgf": 9.80665}
METRES = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
SHARES = {"-": 1.0, "%": 1e-2}
GRAMS = ("g", "kg", "grams", "kilograms")  # of mass: no force


def read_columns(
    path: Path | str, columns: Mapping[str, Mapping[str, float]]
) -> tuple[Float[np.ndarray, "sample column"], list[int]]:
    """Columns of a CSV (of commas, semicolons or tabs) in SI, and the lines of the samples.

    `columns`: their names and possible units. The header says which, as in "time_s", "Force [N]" or
    "force (mN)"; "" stands for none. Other columns, blank lines and comments (#) are skipped.

    Raises FileNotFoundError, or a ValueError that names the file and the line.
    """
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
    return np.array(rows), [number for number, _ in lines[1:]]


def header_of(path: Path | str) -> list[str]:
    """The cells of a CSV's header; none of an empty file."""
    return next((cells for _, cells in read_lines(path)), [])


def read_lines(path: Path | str) -> list[tuple[int, list[str]]]:
    """The cells of a CSV's lines with their numbers, but for blank ones and comments (#).

    Raises FileNotFoundError, or a ValueError that names the file.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        lines = dict(enumerate(text.splitlines(), 1))
        kept = {n: line for n, line in lines.items() if line.strip() and line.lstrip()[0] != "#"}
        delimiter = max(",;\t", key=next(iter(kept.values()), "").count)
        rows = list(csv.reader(kept.values(), delimiter=delimiter, skipinitialspace=True))
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: no text in UTF-8 ({error.reason}): export it again") from error
    except csv.Error as error:
        raise ValueError(f"{path}: no CSV: {error}") from error
    if len(rows) != len(kept):
        raise ValueError(f"{path}: a quotation mark is not closed")
    return [(n, [c.strip() for c in row]) for n, row in zip(kept, rows, strict=True)]


def _column(
    path: Path | str, header: list[str], name: str, units: Mapping[str, float]
) -> tuple[int, float]:
    """The index of a column, and its unit in SI."""
    unit_of = r"(?:[\s_]*[\[(]?\s*([\w%-]+)\s*[\])]?)?"
    pattern = re.compile(re.escape(name) + unit_of, re.IGNORECASE)
    matches = [(i, m[1] or "") for i, cell in enumerate(header) if (m := pattern.fullmatch(cell))]
    if len(matches) != 1:
        raise ValueError(
            f"{path}: expected one column {name!r} with its unit, such as "
            f"'{name}_{next(iter(units))}', found {len(matches)} in {header}: rename it, or name "
            "the column that is meant"
        )
    index, unit = matches[0]
    if unit not in units:
        if unit in GRAMS and "N" in units:
            raise ValueError(
                f"{path}: {header[index]!r} is a mass: a force is in N, or in gf where a scale "
                "shows grams (1 gf = 9.80665 mN): name the column force_gf if it does"
            )
        raise ValueError(
            f"{path}: the unit of {header[index]!r} is not known: write one of {', '.join(units)} "
            f"into the header, as in '{name} [{next(iter(units))}]'"
        )
    return index, units[unit]


def number_in(path: Path | str, line: int, cell: str, what: str = "a finite number") -> float:
    """The number in a cell; ValueError that names the file and the line when there is none."""
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(f"{path}: line {line}: expected {what}, found {cell!r}: write a number")
    return value


def check_increasing(
    path: Path | str, lines: Sequence[int], times: Float[np.ndarray, " sample"]
) -> None:
    """Raise a `ValueError` that names the file and the first line whose time [s] is not later."""
    for at in np.flatnonzero(np.diff(times) <= 0)[:1]:
        raise ValueError(
            f"{path}: line {lines[at + 1]}: times must increase, found {times[at]:.9g} s, then "
            f"{times[at + 1]:.9g} s: sort the lines by time, and drop those that are repeated"
        )


WORST_FIT = 0.9  # share of the force's variance that the displacement must explain
FINEST = 1e-3  # [s], of the offsets that are tried


@dataclass(frozen=True)
class ForceLog:
    """A force over time: `times` [s], which increase, and `force` [N]; `name` is for errors."""

    times: Float[np.ndarray, " sample"]
    force: Float[np.ndarray, " sample"]
    name: str


def read_force_log(path: Path | str, time: str = "time", force: str = "force") -> ForceLog:
    """Read the columns `time` (s, ms, us) and `force` (N, mN, cN, kN, gf, kgf) of a CSV.

    Raises as `read_columns`, and ValueError for times that do not increase.
    """
    values, lines = read_columns(path, {time: SECONDS, force: NEWTONS})
    check_increasing(path, lines, values[:, 0])
    return ForceLog(values[:, 0], values[:, 1], str(path))


def estimate_offset(
    log: ForceLog,
    times: Float[np.ndarray, " frame"],
    displacement: Float[np.ndarray, " frame"],
    longest: float = 5.0,
) -> float:
    """What to add to the frames' `times` [s] to have those of the log, from the motion.

    `displacement` [m] is how far the pulled side went, for example the mean over its markers. The
    force is fitted by a cubic in the displacement, since fabrics stiffen, at offsets up to
    `longest` [s] from where both records begin together. The pull must begin and end in the video.

    Raises ValueError when no offset explains 90 % of the force's variance.
    """
    if displacement.shape != times.shape or not np.isfinite(displacement).all():
        raise ValueError("give one finite displacement [m] for each frame's time")
    if np.ptp(displacement) == 0 or np.ptp(log.force) == 0:
        raise ValueError(f"{log.name}: nothing moves, or the force is constant: no offset shows")
    interval = float(np.median(np.diff(times)))
    step = max(FINEST, interval / 20)
    tried = log.times[0] - times[0] + np.arange(-longest, longest + step, step)
    scaled = (displacement - displacement.mean()) / np.ptp(displacement)
    basis = np.linalg.qr(np.stack([scaled**power for power in range(4)], axis=1))[0]
    # As noisy as it would be at the frames: else the cubic follows the noise of single samples.
    smooth = ForceLog(log.times, _means(log, 0.5 * interval), log.name)
    fits = np.array([_explained(smooth, times + offset, basis) for offset in tried])
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
    before, peak, after = fits[best - 1 : best + 2]
    bend = before - 2 * peak + after
    return float(tried[best] + (step * 0.5 * (before - after) / bend if bend < 0 else 0.0))


def _means(log: ForceLog, half: float) -> np.ndarray:
    """The mean force within `half` [s] of each sample, as far as the log goes."""
    integral = make_interp_spline(log.times, log.force, k=1).antiderivative()
    low, high = (np.clip(log.times + sign * half, log.times[0], log.times[-1]) for sign in (-1, 1))
    return (integral(high) - integral(low)) / (high - low)


def _explained(log: ForceLog, at: np.ndarray, basis: np.ndarray) -> float:
    """Which share of the force's variance, at times on the log's clock, a basis explains."""
    inside = (at >= log.times[0] - 1e-9) & (at <= log.times[-1] + 1e-9)
    if inside.sum() < len(at) / 2:  # rest continues outside of a log, but not for long
        return -np.inf
    force = np.interp(at, log.times, log.force)
    force = force - force.mean()
    variance = float(force @ force)
    if variance < 0.25 * len(at) * float(np.var(log.force)):
        return -np.inf  # the pull is not in these frames
    return float(np.sum((basis.T @ force) ** 2)) / variance
