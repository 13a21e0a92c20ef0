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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from r2s._util.files import parse
from r2s.laboratory.cantilever import Cantilever
from r2s.laboratory.drape import DEVIATION, RADII, Drape
from r2s.laboratory.estimate import Test
from r2s.laboratory.knits import read_knit
from r2s.laboratory.pull import SPECIMEN, Pull
from r2s.recordings.force_log import METRES, NEWTONS, SHARES, header_of, read_columns

FORMAT = "r2s-laboratory/1"
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
        entries = stored.get(kind, [])
        if not isinstance(entries, list):
            raise ValueError(f"{path}: {kind}: expected a list, found {type(entries).__name__}")
        for number, entry in enumerate(entries, 1):
            tests += make(path.parent, f"{path}: {kind[:-1]} {number}", entry)
    if not tests:
        raise ValueError(f"{path}: no test: it has neither {', '.join(KINDS)}")
    return LaboratoryTests(tuple(tests), source, path.stem)


@dataclass(frozen=True)
class _Knit:
    file: str
    direction: float
    specimen: float = SPECIMEN


@dataclass(frozen=True)
class _Pull:
    file: str
    direction: float
    length: float
    width: float
    specimen: float = SPECIMEN


@dataclass(frozen=True)
class _Cantilever:
    direction: float
    overhangs: tuple[float, ...]


@dataclass(frozen=True)
class _Drape:
    coefficient: float
    specimen_radius: float = RADII[0]
    support_radius: float = RADII[1]
    deviation: float = DEVIATION


def _entry(kind: type, where: str, entry: Any) -> Any:
    """The dataclass `kind` from an entry of a file, its direction as an angle [rad]."""
    if isinstance(entry, dict) and "direction" in entry:
        direction: Any = DIRECTIONS.get(str(entry["direction"]), entry["direction"])
        is_number = isinstance(direction, int | float) and not isinstance(direction, bool)
        if not is_number or not 0 <= direction <= math.pi:
            raise ValueError(
                f"{where}: direction: expected {', '.join(DIRECTIONS)}, or an angle from the warp, "
                f"0 to pi rad, found {direction!r}"
            )
        entry = entry | {"direction": direction}
    try:
        return parse(kind, entry, where)
    except OverflowError as error:
        raise ValueError(f"{where}: a number is too large: {error}") from error


def _pulls(folder: Path, where: str, entry: Any) -> list[Test]:
    is_knit = isinstance(entry, dict) and str(entry.get("file")).endswith(".h5")
    one = _entry(_Knit if is_knit else _Pull, where, entry)
    file = folder / one.file
    if not file.is_file():
        raise FileNotFoundError(f"{where}: no such file: {file}")
    if is_knit:
        return list(read_knit(file, one.direction, one.specimen))
    header = " ".join(header_of(file)).lower()
    names = {"extension": METRES} if "extension" in header else {"strain": SHARES}
    names |= {"force": NEWTONS} | ({"width": METRES} if "width" in header else {})
    along, force, *width = read_columns(file, names).values.T
    extension = along if "extension" in names else along * one.length
    middle, name = width[0] if width else None, f"{where} ({file.name})"
    size = one.length, one.width
    return [Pull.make(extension, force, size, one.direction, middle, one.specimen, name)]


def _cantilevers(folder: Path, where: str, entry: Any) -> list[Test]:
    del folder
    one = _entry(_Cantilever, where, entry)
    return [Cantilever.make(one.overhangs, one.direction, name=where)]


def _drapes(folder: Path, where: str, entry: Any) -> list[Test]:
    del folder
    one = _entry(_Drape, where, entry)
    radii = one.specimen_radius, one.support_radius
    return [Drape.make(one.coefficient, radii, one.deviation, name=where)]


KINDS: dict[str, Callable[[Path, str, Any], list[Test]]] = {
    "pulls": _pulls,
    "cantilevers": _cantilevers,
    "drapes": _drapes,
}
