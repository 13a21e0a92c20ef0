"""CSV columns with units; force logs of a stretch."""

import codecs
import contextlib
import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline

from r2s._util.checks import shown

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "sec": 1.0}
NEWTONS = {"N": 1.0, "mN": 1e-3, "cN": 1e-2, "kN": 1e3}
NEWTONS |= {"gf": 9.80665e-3, "kgf": 9.80665, "lbf": 4.4482216}
METRES = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254}
SHARES = {"-": 1.0, "%": 1e-2, "mm/mm": 1.0, "m/m": 1.0}
GRAMS = ("g", "kg", "grams", "kilograms")  # of mass: no force
NAMES = {  # of columns in what testers export, English and German
    "time": ("zeit", "pruefzeit", "testzeit"),
    "force": ("load", "kraft", "standardkraft", "pruefkraft", "zugkraft"),
    "extension": (
        *("displacement", "elongation", "crosshead", "position", "stroke", "verschiebung", "weg"),
        *("standardweg", "traversenweg", "dehnung", "verlaengerung", "laengenaenderung"),
    ),
    "strain": ("elongation", "dehnung"),
    "width": ("breite",),
}
KINDS = ("tensile", "standard", "crosshead", "nominal", "engineering", "elapsed", "nominelle")
UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue"})
UNIT = r"(?P<gap>[\s_]*(?:\bin\s|[/,:])?\s*[\[(]?)\s*(?P<unit>[^\s\[\]()]*)\s*[\])]?"
HEADER_WITHIN, LONGEST_LINE = 100, 100_000  # lines, and characters
WORKBOOKS = b"PK\x03\x04", b"\xd0\xcf\x11\xe0"  # xlsx, xls
Units = Mapping[str, float]


def read_columns(
    path: Path | str, columns: Mapping[str, Units]
) -> tuple[Float[np.ndarray, "sample column"], list[int]]:
    """Columns of a CSV in SI, and the lines of the samples: see `read_choices`."""
    values, lines, _ = read_choices(path, [{name: units} for name, units in columns.items()])
    return values, lines


def read_choices(
    path: Path | str, choices: Sequence[Mapping[str, Units]], optional: Mapping[str, Units] = {}
) -> tuple[Float[np.ndarray, "sample column"], list[int], list[str]]:
    """Columns of a CSV in SI, the lines of the samples, and the names of the columns.

    Of each of the `choices` (names and their possible units) the first that is there is read, then
    what is there of `optional`. In the file a name may be one of `NAMES`, too. The header says the
    unit, as in "time_s", "Force [N]" or "Kraft in mN", or the line below it does; "" stands for
    none. Semicolons, tabs or commas part the columns; numbers have decimal points or commas. The
    text is UTF-8, UTF-16 or Windows-1252. Lines before the header, other columns, blank lines and
    comments (#) are skipped.

    Raises FileNotFoundError, or a ValueError that names the file and the line.
    """
    kept = _kept_lines(path)
    if not kept:
        raise ValueError(f"{path}: the log is empty")
    at, delimiter = _find_header(kept, choices)
    rows = _rows(path, kept[at:], delimiter)
    # delimiters may end a line
    width = max((i for i, cell in enumerate(rows[0][1], 1) if cell), default=0)
    rows = [(n, c[:width] if not any(c[width:]) else c) for n, c in rows]
    header, below = rows[0][1], [_bare(cell) for cell in rows[1][1]] if len(rows) > 1 else []
    every = {u for choice in (*choices, optional) for units in choice.values() for u in units}
    has_units = not any(map(_is_number, below)) and not every.isdisjoint(below)
    titles = list(zip_longest(header, below if has_units else (), fillvalue=""))[: len(header)]
    there = [{n: u} for n, u in optional.items() if _named(titles, n, u)]
    places = [_column(path, titles, choice) for choice in (*choices, *there)]
    samples = rows[1 + has_units :]
    for number, cells in samples:
        if len(cells) != len(header):
            raise ValueError(
                f"{path}: line {number} has {len(cells)} columns, the header {len(header)}: it is "
                "cut short, or decimal commas part the columns (write decimal points, or part the "
                "columns by semicolons)"
            )
    if len(samples) < 2:
        raise ValueError(f"{path}: expected two samples or more, found {len(samples)}")
    texts = _with_points(
        path, [(n, [cells[index] for _, index, _ in places]) for n, cells in samples]
    )
    values = [[number_in(path, n, cell) for cell in cells] for n, cells in texts]
    names, _, factors = zip(*places, strict=True)
    return np.array(values) * np.array(factors), [n for n, _ in samples], list(names)


def header_of(path: Path | str) -> list[str]:
    """The cells of a CSV's first line; none of an empty file."""
    return next((cells for _, cells in read_lines(path)), [])


def read_lines(path: Path | str) -> list[tuple[int, list[str]]]:
    """The cells of a CSV's lines with their numbers, but for blank ones and comments (#).

    Raises FileNotFoundError, or a ValueError that names the file.
    """
    kept = _kept_lines(path)
    return _rows(path, kept, max(",;\t", key=kept[0][1].count) if kept else ",")


def _kept_lines(path: Path | str) -> list[tuple[int, str]]:
    """The lines of a text with their numbers, but for blank ones and comments (#)."""
    data = Path(path).read_bytes()
    if data.startswith(WORKBOOKS):
        raise ValueError(f"{path}: a workbook, no text: save its sheet as CSV")
    zeros = [3 * data[start::2].count(0) > len(data) > 3 for start in (0, 1)]
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encodings = ["utf-16"]
    elif any(zeros):  # UTF-16 without a mark
        encodings = ["utf-16-le" if zeros[1] else "utf-16-be"]
    else:
        encodings = ["utf-8-sig", "cp1252"]
    for encoding in encodings:
        with contextlib.suppress(UnicodeDecodeError):
            lines = list(enumerate(data.decode(encoding).splitlines(), 1))
            break
    else:
        raise ValueError(f"{path}: no text in UTF-8, UTF-16 or Windows-1252: export it again")
    if any("\0" in line or len(line) > LONGEST_LINE for _, line in lines):
        raise ValueError(f"{path}: no text: export it again")
    return [(n, line) for n, line in lines if line.strip(" \t;,") and line.lstrip()[0] != "#"]


def _rows(
    path: Path | str, lines: Sequence[tuple[int, str]], delimiter: str
) -> list[tuple[int, list[str]]]:
    for number, line in lines:
        if line.count('"') % 2:
            raise ValueError(f"{path}: line {number}: a quotation mark is not closed: close it")
    return [(number, _cells(line, delimiter)) for number, line in lines]


def _cells(line: str, delimiter: str) -> list[str]:
    cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    return [cell.strip() for cell in cells]


def _find_header(
    kept: Sequence[tuple[int, str]], choices: Sequence[Mapping[str, Units]]
) -> tuple[int, str]:
    """The index of the header among some lines, and what parts its columns; where none has all
    columns, the first line of the most cells."""
    for at, (_, line) in enumerate(kept[:HEADER_WITHIN]):
        for delimiter in ";\t,":
            titles = [(cell, "") for cell in _cells(line, delimiter)]
            if all(any(_named(titles, *each) for each in c.items()) for c in choices):
                return at, delimiter
    counts = [max(map(line.count, ",;\t")) for _, line in kept[:HEADER_WITHIN]]
    at = counts.index(max(counts))
    return at, max(",;\t", key=kept[at][1].count)


def _named(titles: Sequence[tuple[str, str]], name: str, units: Units) -> list[tuple[int, str]]:
    """The columns of a name, with their units; `titles`: header, and the unit below it.

    Columns of a known unit come first, then those of the name itself, then of its `NAMES`.
    """
    own, named = re.escape(name.translate(UMLAUTS)), []
    kinds, others = "|".join(KINDS), "|".join((own, *NAMES.get(name, ())))
    remark = r"(?:\s*\([^)]*\)(?=\s*[\[(]))?"
    for pattern in (own, rf"(?:(?:{kinds})[\s_-]+)*(?:{others}){remark}"):
        matches = []
        for index, (title, below) in enumerate(titles):
            match = re.fullmatch(pattern + UNIT, title.translate(UMLAUTS), re.IGNORECASE)
            if match and (match["gap"] or not match["unit"] or match["unit"] in units):
                matches.append((index, match["unit"] or below))
        if known := [(index, unit) for index, unit in matches if unit in units]:
            return known
        named = named or matches
    return named


def _column(
    path: Path | str, titles: Sequence[tuple[str, str]], choice: Mapping[str, Units]
) -> tuple[str, int, float]:
    """Name, index, and unit in SI of the column that is meant."""
    named = {name: _named(titles, name, units) for name, units in choice.items()}
    for name, columns in named.items():
        known = [(index, unit) for index, unit in columns if unit in choice[name]]
        if len(known) == 1:
            return name, known[0][0], choice[name][known[0][1]]
        if known:
            break
    header = [title for title, _ in titles]
    examples = " or ".join(f"{name!r} ({', '.join(units)})" for name, units in choice.items())
    columns = next(filter(None, named.values()), [])
    if len(columns) != 1:
        name, units = next(iter(choice.items()))
        raise ValueError(
            f"{path}: expected one column {examples} with its unit, such as "
            f"'{name}_{next(iter(units))}', found {len(columns)} in {shown(header)}: rename it, or "
            "name the column that is meant"
        )
    index, unit = columns[0]
    if unit in GRAMS and "force" in choice:
        raise ValueError(
            f"{path}: {header[index]!r} is a mass: a force is in N, or in gf where a scale "
            "shows grams (1 gf = 9.80665 mN): name the column force_gf if it does"
        )
    known = [f"{', '.join(units)} as '{n} [{next(iter(units))}]'" for n, units in choice.items()]
    title = shown(header[index])
    raise ValueError(f"{path}: the unit of {title} is not known: write one of {' or '.join(known)}")


def _bare(unit: str) -> str:
    return unit.strip("[]() ")


def _is_number(cell: str) -> bool:
    return re.fullmatch(r"[+-]?[\d.,]*\d[\d.,]*(?:e[+-]?\d+)?", cell, re.IGNORECASE) is not None


def _with_points(
    path: Path | str, lines: Sequence[tuple[int, list[str]]]
) -> list[tuple[int, list[str]]]:
    """Lines of numbers with decimal points, which may have had decimal commas."""
    have = [{mark for cell in cells for mark in ",." if mark in cell} for _, cells in lines]
    if {",", "."} <= set().union(*have):
        at = next(at for at, marks in enumerate(have) if "," in marks)
        raise ValueError(
            f"{path}: line {lines[at][0]}: {lines[at][1]}: commas and points are mixed: export it "
            "with one decimal mark, and none for thousands"
        )
    return [(number, [cell.replace(",", ".") for cell in cells]) for number, cells in lines]


def number_in(path: Path | str, line: int, cell: str, what: str = "a finite number") -> float:
    """The number in a cell; ValueError that names the file and the line when there is none."""
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(
            f"{path}: line {line}: expected {what}, found {shown(cell)}: write a number"
        )
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
