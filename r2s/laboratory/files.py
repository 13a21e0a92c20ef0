"""Laboratory tests of one fabric in a JSON file, curves of pulls in CSV files beside it.

```json
{"format": "r2s-laboratory/1",
 "source": "own tests, three specimens",
 "pulls": [{"file": "warp.csv", "direction": "warp", "length": 0.2, "width": 0.05}],
 "cantilevers": [{"direction": "warp", "overhangs": [0.061, 0.060, 0.063]}],
 "drapes": [{"coefficient": 0.42, "specimen_radius": 0.15, "support_radius": 0.09}]}
```

Lengths are in metres, a direction is "warp", "weft", "bias" or an angle from the warp [rad]. The
columns of a curve are `extension` (m, mm, cm) or `strain` (-, %), `force` (N, mN, cN, kN, gf, kgf)
and, where the width in the middle was measured, `width`; the header says their units. A pull of
stitch-by-stitch is one with a `file` that ends in .h5, see `r2s.laboratory.knits`.
"""

import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from r2s.laboratory.cantilever import Cantilever
from r2s.laboratory.drape import DEVIATION, RADII, Drape
from r2s.laboratory.estimate import Test
from r2s.laboratory.knits import read_knit
from r2s.laboratory.pull import SPECIMEN, Pull
from r2s.recordings.readers.columns import METRES, NEWTONS, SHARES, header_of, read_columns

FORMAT = "r2s-laboratory/1"
LARGEST = 1e12  # that is still a number of a test
DIRECTIONS = {"warp": 0.0, "bias": math.pi / 4, "weft": math.pi / 2}


class LaboratoryTests(NamedTuple):
    """- `tests`: of one fabric. `source`: whose they are. `name`: of their file."""

    tests: tuple[Test, ...]
    source: str
    name: str

    @property
    def fingerprint(self) -> str:
        """The sha256 of all numbers of the tests, in the order of their file."""
        digest = hashlib.sha256()
        for test in self.tests:
            digest.update(type(test).__name__.encode())
            for leaf in jax.tree.leaves(test):
                digest.update(np.asarray(leaf, np.float32).tobytes())
        return digest.hexdigest()


def read_tests(path: Path | str) -> LaboratoryTests:
    """Read a file of laboratory tests.

    Raises FileNotFoundError, or a ValueError that names the file and the test: no JSON, another
    format, keys that are missing or unknown, units and values that no test has, no test at all.
    """
    path = Path(path)
    try:
        stored = json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: no JSON: {error}") from error
    if not isinstance(stored, dict) or stored.get("format") != FORMAT:
        found = stored.get("format") if isinstance(stored, dict) else type(stored).__name__
        raise ValueError(f"{path}: laboratory tests have the format {FORMAT!r}, found {found!r}")
    if unknown := sorted(set(stored) - {"format", "source", *KINDS}):
        raise ValueError(
            f"{path}: unknown: {', '.join(unknown)}; known: source, {', '.join(KINDS)}"
        )
    source = stored.get("source", "")
    if not isinstance(source, str):
        raise ValueError(f"{path}: source: expected text, found {source!r}")
    tests: list[Test] = []
    for kind, make in KINDS.items():
        each = stored.get(kind, [])
        if not isinstance(each, list):
            raise ValueError(f"{path}: {kind}: expected a list, found {type(each).__name__}")
        for number, one in enumerate(each, 1):
            where = f"{path}: {kind[:-1]} {number}"
            if not isinstance(one, dict):
                raise ValueError(f"{where}: expected an object, found {one!r}")
            tests += make(path.parent, where, dict(one))
    if not tests:
        raise ValueError(f"{path}: no test: it has neither {', '.join(KINDS)}")
    return LaboratoryTests(tuple(tests), source, path.stem)


def _pulls(folder: Path, where: str, one: dict[str, Any]) -> list[Test]:
    direction = _direction(where, one)
    file = folder / str(_taken(where, one, "file"))
    if not file.is_file():
        raise FileNotFoundError(f"{where}: no such file: {file}")
    specimen = _number(where, one, "specimen", SPECIMEN)
    if file.suffix == ".h5":
        _nothing_left(where, one)
        return list(read_knit(file, direction, specimen))
    length, wide = (_number(where, one, name) for name in ("length", "width"))
    _nothing_left(where, one)
    header = " ".join(header_of(file)).lower()
    along = {"extension": METRES} if "extension" in header else {"strain": SHARES}
    names = along | {"force": NEWTONS} | ({"width": METRES} if "width" in header else {})
    columns = read_columns(file, names).values.T
    extension = columns[0] * (1 if "extension" in names else length)
    middle = columns[2] if len(columns) > 2 else None
    name = f"{where} ({file.name})"
    return [
        Pull.make(extension, columns[1], (length, wide), direction, middle, specimen, name),
    ]


def _cantilevers(folder: Path, where: str, one: dict[str, Any]) -> list[Test]:
    del folder
    direction = _direction(where, one)
    overhangs = _taken(where, one, "overhangs")
    _nothing_left(where, one)
    if not isinstance(overhangs, list) or not all(_is_number(value) for value in overhangs):
        raise ValueError(f"{where}: overhangs: expected a list of numbers [m], found {overhangs!r}")
    return [Cantilever.make(overhangs, direction, name=where)]


def _drapes(folder: Path, where: str, one: dict[str, Any]) -> list[Test]:
    del folder
    value = _number(where, one, "coefficient")
    radii = (
        _number(where, one, "specimen_radius", RADII[0]),
        _number(where, one, "support_radius", RADII[1]),
    )
    deviation = _number(where, one, "deviation", DEVIATION)
    _nothing_left(where, one)
    return [Drape.make(value, radii, deviation, name=where)]


KINDS: dict[str, Callable[[Path, str, dict[str, Any]], list[Test]]] = {
    "pulls": _pulls,
    "cantilevers": _cantilevers,
    "drapes": _drapes,
}


def _taken(where: str, one: dict[str, Any], key: str) -> Any:
    if key not in one:
        raise ValueError(f"{where}: missing: {key}")
    return one.pop(key)


def _nothing_left(where: str, one: dict[str, Any]) -> None:
    if one:
        raise ValueError(f"{where}: unknown: {', '.join(sorted(one))}")


def _number(where: str, one: dict[str, Any], key: str, default: float | None = None) -> float:
    value = _taken(where, one, key) if default is None else one.pop(key, default)
    if not _is_number(value):
        raise ValueError(f"{where}: {key}: expected a number, found {value!r}")
    return float(value)


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < LARGEST  # no infinity, nor an integer that no float holds


def _direction(where: str, one: dict[str, Any]) -> float:
    value = _taken(where, one, "direction")
    if isinstance(value, str) and value in DIRECTIONS:
        return DIRECTIONS[value]
    if isinstance(value, int | float) and _is_number(value) and 0 <= value <= math.pi:
        return float(value)
    known = ", ".join(DIRECTIONS)
    raise ValueError(
        f"{where}: direction: expected {known}, or an angle from the warp, 0 to pi rad, found "
        f"{value!r}"
    )
