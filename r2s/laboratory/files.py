"""Laboratory tests of one fabric in a JSON file, curves of pulls in CSV files beside it.

```json
{"format": "r2s-laboratory/1",
 "source": "own tests, three specimens",
 "pulls": [{"file": "warp.csv", "direction": "warp", "length": 0.2, "width": 0.05}],
 "cantilevers": [{"direction": "warp", "overhangs": [0.061, 0.060, 0.063]}],
 "drapes": [{"coefficient": 0.42, "specimen_radius": 0.15, "support_radius": 0.09}]}
```

Lengths are in metres, a direction is "warp", "weft", "bias" or an angle from the warp [rad]. The
columns of a curve are `extension` (m, mm, cm) or `strain` (-, %, mm/mm), `force` (N, mN, cN, kN,
gf, kgf) and, where the width in the middle was measured, `width`, or other names that testers give
them; see `read_choices`. A pull of stitch-by-stitch is one with a `file` that ends in .h5, see
`read_knit`.

The zero of a pull is read from its curve, and estimated. A pull may have a `pretension` [N] under
which the strip was clamped (ISO 13934-1: 2 N up to 200 g/m^2, 5 N up to 500 g/m^2, 10 N above), or
the extension at rest, `zero` [m], where it is known.
"""

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from r2s._util.checks import expect, shown
from r2s._util.extras import require
from r2s._util.files import load_json, parse
from r2s.laboratory.bending import DRAPE_DEVIATION, RADII, Cantilever, Drape
from r2s.laboratory.estimate import Test
from r2s.laboratory.pull import SPECIMEN, Pull
from r2s.recordings.force_log import METRES, NEWTONS, SHARES, read_choices

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


@dataclass(frozen=True)
class _Directed:
    direction: float

    def __post_init__(self) -> None:
        names = ", ".join(DIRECTIONS)
        is_angle = 0 <= self.direction <= math.pi
        expect(is_angle, f"direction: {names}, or 0 to pi rad, found {self.direction:g}")


@dataclass(frozen=True)
class _Pull(_Directed):
    file: str
    length: float = math.nan  # a file of stitch-by-stitch has its own
    width: float = math.nan
    specimen: float = SPECIMEN
    pretension: float | None = None
    zero: float | None = None

    def read(self, folder: Path, where: str) -> list[Pull]:
        file = folder / self.file
        if not file.is_file():
            raise FileNotFoundError(f"{where}: no such file: {file}")
        if file.suffix == ".h5":
            return read_knit(file, self.direction, self.specimen)
        choices = [{"extension": METRES, "strain": SHARES}, {"force": NEWTONS}]
        values, _, names = read_choices(file, choices, {"width": METRES})
        along, force, *width = values.T
        extension = along if names[0] == "extension" else along * self.length
        middle, name = width[0] if width else None, f"{where} ({file.name})"
        size = self.length, self.width
        given = {"pretension": self.pretension, "zero": self.zero}
        specimen = self.specimen
        return [Pull.make(extension, force, size, self.direction, middle, specimen, name, **given)]


@dataclass(frozen=True)
class _Cantilever(_Directed):
    overhangs: tuple[float, ...]

    def read(self, _: Path, where: str) -> list[Cantilever]:
        return [Cantilever.make(self.overhangs, self.direction, name=where)]


@dataclass(frozen=True)
class _Drape:
    coefficient: float
    specimen_radius: float = RADII[0]
    support_radius: float = RADII[1]
    deviation: float = DRAPE_DEVIATION

    def read(self, _: Path, where: str) -> list[Drape]:
        radii = self.specimen_radius, self.support_radius
        return [Drape.make(self.coefficient, radii, self.deviation, name=where)]


@dataclass(frozen=True)
class _File:
    format: str
    source: str = ""
    pulls: tuple[_Pull, ...] = ()
    cantilevers: tuple[_Cantilever, ...] = ()
    drapes: tuple[_Drape, ...] = ()

    def __post_init__(self) -> None:
        expect(self.format == FORMAT, f"expected the format {FORMAT}, found {shown(self.format)}")


def read_tests(path: Path | str) -> LaboratoryTests:
    """Read a file of laboratory tests.

    Raises FileNotFoundError, or a ValueError that names the file and the test: no JSON, another
    format, keys that are missing or unknown, units and values that no test has, no test at all.
    """
    path = Path(path)
    stored = load_json(path, each=_with_angle)
    if isinstance(stored, dict) and "fabric" in stored:
        raise ValueError(f"{path}: this is a card; laboratory tests or recordings are expected")
    content = parse(_File, stored, f"{path}")
    tests: list[Test] = []
    for kind in ("pulls", "cantilevers", "drapes"):
        for number, entry in enumerate(getattr(content, kind), 1):
            tests += entry.read(path.parent, f"{path}: {kind[:-1]} {number}")
    expect(bool(tests), f"{path}: no test: it has neither pulls, nor cantilevers, nor drapes")
    return LaboratoryTests(tuple(tests), content.source, path.stem)


def _with_angle(entry: dict) -> dict:
    """An object of the file, in which an angle [rad] replaces the name of a direction."""
    if entry.get("direction") not in list(DIRECTIONS):
        return entry
    return entry | {"direction": DIRECTIONS[entry["direction"]]}


def read_knit(path: Path | str, direction: float, specimen: float = SPECIMEN) -> list[Pull]:
    """The uniaxial pulls in one file of stitch-by-stitch, but for the first.

    Singal et al., Nature Communications 15, 2622 (2024); repository sabetta/stitch-by-stitch (MIT
    licence), commit 0ed27f35, `data/uniaxial_experiments/experimentData/outputData_{yarn} {stitch}
    {X,Y}.h5`: force [N] and tracked pins [pixel] of five pulls of a swatch, X along the courses, Y
    along the wales. Its notebook says the width of the clamp, which gives the scale, that strain
    counts from the first frame of the second pull, and that the first pull is left out, of a swatch
    never stretched before.

    `direction`: of the pull from the warp, [rad]: 0 for Y and pi/2 for X. `specimen`: see `Pull`.

    Raises ValueError that names the file, and ImportError that names the extra.
    """
    path = Path(path)
    h5py = require("h5py", "laboratory", "the pulls of stitch-by-stitch")
    try:
        with h5py.File(path, "r") as file:
            forces = [np.asarray(file[name]["forces"], float) for name in KNIT_PULLS]
            pins = [np.asarray(file[name]["traj"], float) for name in KNIT_PULLS]
            clamp, fabric = (float(file[key][0]) for key in ("clampSize", "fabricSize"))
        # between the clamps, and between the sides, [pixel]
        spans = [
            np.linalg.norm([at[UPPER] - at[LOWER], at[RIGHT] - at[LEFT]], axis=1) for at in pins
        ]
    except Exception as error:  # a file of another layout raises anything
        raise ValueError(f"{path}: no pulls of stitch-by-stitch: {error}") from error
    expect(min(clamp, fabric) > 0, f"{path}: sizes must be positive, found {clamp} and {fabric}")
    length, width = spans[0][:, 0]
    scale = CLAMP_WIDTH / clamp  # [m] a pixel
    size = float(length * scale), fabric * scale
    pulls = []
    for name, (along, across), force in zip(KNIT_PULLS, spans, forces, strict=True):
        extension, middle = (along - length) * scale, across / width * size[1]
        title = f"{path}: {name}"
        strip = extension, force, size, direction, middle, specimen
        pulls.append(Pull.make(*strip, title, zero=0.0))  # the notebook's
    return pulls
