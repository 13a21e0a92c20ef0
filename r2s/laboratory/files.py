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
stitch-by-stitch is one with a `file` that ends in .h5, see `read_knit`.
"""

import hashlib
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from r2s._util.extras import require
from r2s._util.files import parse
from r2s.laboratory.bending import DRAPE_DEVIATION, RADII, Cantilever, Drape
from r2s.laboratory.estimate import Test
from r2s.laboratory.pull import SPECIMEN, Pull
from r2s.recordings.force_log import METRES, NEWTONS, SHARES, header_of, read_columns

FORMAT = "r2s-laboratory/1"
DIRECTIONS = {"warp": 0.0, "bias": math.pi / 4, "weft": math.pi / 2}
# of stitch-by-stitch, see `read_knit`
CLAMP_WIDTH = 0.0355  # [m]
KNIT_PULLS = ("video2", "video3", "video4", "video5")  # the first frame of the first one is at rest
RIGHT, LEFT, LOWER, UPPER = 0, 1, -2, -1  # of the tracked pins; the last two are the clamps'


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
    for name, kind in KINDS.items():
        entries = stored.get(name, [])
        if not isinstance(entries, list):
            raise ValueError(f"{path}: {name}: expected a list, found {type(entries).__name__}")
        for number, entry in enumerate(entries, 1):
            where = f"{path}: {name[:-1]} {number}"
            tests += _entry(kind, where, entry).read(path.parent, where)
    if not tests:
        raise ValueError(f"{path}: no test: it has neither {', '.join(KINDS)}")
    return LaboratoryTests(tuple(tests), source, path.stem)


@dataclass(frozen=True)
class _Knit:
    file: str
    direction: float
    specimen: float = SPECIMEN

    def read(self, folder: Path, where: str) -> list[Test]:
        return list(read_knit(_existing(folder / self.file, where), self.direction, self.specimen))


@dataclass(frozen=True)
class _Pull:
    file: str
    direction: float
    length: float
    width: float
    specimen: float = SPECIMEN

    def read(self, folder: Path, where: str) -> list[Test]:
        file = _existing(folder / self.file, where)
        header = " ".join(header_of(file)).lower()
        units = {"extension": METRES} if "extension" in header else {"strain": SHARES}
        units |= {"force": NEWTONS} | ({"width": METRES} if "width" in header else {})
        along, force, *width = read_columns(file, units)[0].T
        extension = along if "extension" in units else along * self.length
        middle, name = width[0] if width else None, f"{where} ({file.name})"
        size = self.length, self.width
        return [Pull.make(extension, force, size, self.direction, middle, self.specimen, name)]


@dataclass(frozen=True)
class _Cantilever:
    direction: float
    overhangs: tuple[float, ...]

    def read(self, _: Path, where: str) -> list[Test]:
        return [Cantilever.make(self.overhangs, self.direction, name=where)]


@dataclass(frozen=True)
class _Drape:
    coefficient: float
    specimen_radius: float = RADII[0]
    support_radius: float = RADII[1]
    deviation: float = DRAPE_DEVIATION

    def read(self, _: Path, where: str) -> list[Test]:
        radii = self.specimen_radius, self.support_radius
        return [Drape.make(self.coefficient, radii, self.deviation, name=where)]


KINDS: dict[str, Any] = {"pulls": _Pull, "cantilevers": _Cantilever, "drapes": _Drape}


def _existing(file: Path, where: str) -> Path:
    if not file.is_file():
        raise FileNotFoundError(f"{where}: no such file: {file}")
    return file


def _entry(kind: Any, where: str, entry: Any) -> Any:
    """An entry of a file, as one of `KINDS`, its direction as an angle [rad]."""
    if kind is _Pull and isinstance(entry, dict) and str(entry.get("file")).endswith(".h5"):
        kind = _Knit
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


def read_knit(path: Path | str, direction: float, specimen: float = SPECIMEN) -> list[Pull]:
    """The uniaxial pulls in one file of stitch-by-stitch, but for the first.

    Singal et al., Nature Communications 15, 2622 (2024); repository sabetta/stitch-by-stitch (MIT
    licence), commit 0ed27f35, `data/uniaxial_experiments/experimentData/outputData_{yarn} {stitch}
    {X,Y}.h5`: force [N] and tracked pins [pixel] of five pulls of a swatch, X along the courses, Y
    along the wales. Its notebook says the width of the clamp, which gives the scale, that strain
    counts from the first frame of the second pull, and that the first pull is left out, of a swatch
    never stretched before.

    `direction`: of the pull from the warp, [rad]: 0 for Y and pi/2 for X. `specimen`: see `Pull`.

    Raises ValueError that names the file and the pull for arrays that are missing or of other
    shapes; ImportError that names the extra.
    """
    path = Path(path)
    h5py = require("h5py", "laboratory", "the pulls of stitch-by-stitch")
    try:
        with h5py.File(path, "r") as file:
            arrays = {
                name: tuple(np.asarray(file[name][key], float) for key in ("traj", "forces"))
                for name in KNIT_PULLS
            }
            clamp, fabric = (float(file[key][0]) for key in ("clampSize", "fabricSize"))
        if not min(clamp, fabric) > 0:
            raise ValueError(f"sizes must be positive, found {clamp} and {fabric}")
    except Exception as error:  # a file of another layout raises anything
        raise ValueError(f"{path}: no pulls of stitch-by-stitch: {error}") from error
    spans = {}  # between the clamps, and between the sides, [pixel]
    for name, (pins, force) in arrays.items():
        if pins.ndim != 3 or pins.shape[0] < 4 or pins.shape[1:] != (2, len(force)):
            raise ValueError(
                f"{path}: {name}: expected pins (four or more, 2, {len(force)}), found {pins.shape}"
            )
        along, across = pins[UPPER] - pins[LOWER], pins[RIGHT] - pins[LEFT]
        spans[name] = np.linalg.norm([along, across], axis=1)
    length, width = spans[KNIT_PULLS[0]][:, 0]
    scale = CLAMP_WIDTH / clamp  # [m] a pixel
    size = float(length * scale), fabric * scale
    pulls = []
    for name, (_, force) in arrays.items():
        extension = (spans[name][0] - length) * scale
        middle = spans[name][1] / width * size[1]
        title = f"{path.name}: {name}"
        pulls.append(Pull.make(extension, force, size, direction, middle, specimen, title))
    return pulls
