"""Fabric cards: a fabric or an estimate as a JSON file, to keep, to share, and to simulate again.

A card has the fabric (see `r2s.materials.fabric_json`), the provenance of its numbers, and the
estimate without its history. It keeps the numbers of its file in double precision, so that a card
is written as it was read; its `fabric` is in JAX's default precision.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

from r2s._util.checks import expect_value as expect
from r2s._util.checks import shown
from r2s._util.files import load_json, write_json
from r2s.estimation import estimate as estimates
from r2s.estimation.estimate import Estimate
from r2s.materials import presets
from r2s.materials.fabric import Fabric, check_fabric
from r2s.materials.fabric_json import (
    LAWS,
    NUMBERS,
    check_keys,
    fabric_as_json,
    fabric_from_json,
    nan_to_null,
)
from r2s.recordings.recording import Recording

FORMAT = "r2s-card/2"
FORMAT_0_2 = "r2s-card/1"
KEYS = ("format", "name", "precision", "fabric", "provenance", "estimate")
LEFT_OUT = ("losses", "history")  # of an estimate: as long as its search


@dataclass(frozen=True)
class Provenance:
    """Where the numbers of a card come from. All fields but `method` may be empty.

    - `method`: measured or estimated, and how. `source`: a citation, or whose data.
    - `recordings`: name and sha256 (see `fingerprint`) of what an estimate was made from.
    - `version`: of r2s. `date`: as the caller gives it.
    - `assumed`: numbers of the fabric that nobody measured.
    """

    method: str
    source: str = ""
    recordings: tuple[tuple[str, str], ...] = ()
    version: str = ""
    date: str = ""
    assumed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Card:
    """A fabric card. `make` makes one; `read` and `write` are its file.

    - `name`: of the fabric. `provenance`: where its numbers come from.
    - `precision`: in which its numbers were computed, "float32" or "float64".
    - `numbers`, `found`: the fabric, and the estimate if there is one, as the file has them.
    """

    name: str
    precision: str
    numbers: Mapping[str, Any]
    provenance: Provenance
    found: Mapping[str, Any] | None = None

    @classmethod
    def make(cls, name: str, what: Fabric | Estimate, provenance: Provenance) -> "Card":
        """The card of a fabric, or of an estimate. An empty version becomes the installed one.

        Raises `ValueError` for a batch of fabrics, infinite numbers, and those that no fabric has;
        `TypeError` for a law that r2s does not have: its code cannot go on a card.
        """
        fabric = what.fabric if isinstance(what, Estimate) else what
        if not provenance.version:
            provenance = dataclasses.replace(provenance, version=version())
        numbers, stored = fabric_as_json(fabric), None
        check_fabric(fabric, may_lack=True)
        if isinstance(what, Estimate):
            stored = estimates.as_json(what)
            stored = nan_to_null({k: v for k, v in stored.items() if k not in LEFT_OUT}, "estimate")
        return cls(name, str(np.asarray(fabric.density).dtype), numbers, provenance, stored)

    @property
    def fabric(self) -> Fabric:
        """The fabric, in JAX's default precision."""
        return fabric_from_json(self.numbers)

    @property
    def estimate(self) -> Estimate | None:
        """The estimate without its history, or None."""
        return None if self.found is None else estimates.from_json(dict(self.found))


def preset(name: str) -> Card:
    """The card of a preset of `r2s.materials.presets`; `ValueError` names the presets there are.

    >>> preset("black_denim").numbers["density"]
    {'value': 0.32, 'unit': 'kg/m^2'}
    """
    if name not in presets.MEASURED:
        raise ValueError(f"no preset {name!r}; there are {', '.join(presets.MEASURED)}")
    make = presets.MEASURED[name]
    described = " ".join((make.__doc__ or "").split())
    provenance = Provenance(
        method=f"{described} Areal density and stiffness at small strains, rounded to two digits; "
        "bending: mean over directions and curvatures.",
        source="Wang, O'Brien, Ramamoorthi: Data-driven elastic models for cloth: modeling and "
        "measurement. ACM Transactions on Graphics 30(4), 2011",
        assumed=("damping", "friction", "thickness", "mass_damping"),
    )
    return Card.make(name, make(), provenance)


def fingerprint(recording: Recording) -> str:
    """The sha256 of a recording's data and description, whatever the precision it was read in."""
    digest = hashlib.sha256(json.dumps(dataclasses.asdict(recording.info)).encode())
    for leaf in jax.tree.leaves(recording):
        values = np.ascontiguousarray(leaf)
        floats = np.issubdtype(values.dtype, np.floating)
        digest.update(repr(values.shape).encode())
        digest.update((values.astype(np.float32) if floats else values).tobytes())
    return digest.hexdigest()


def version() -> str:
    """The version of r2s that is installed; "unknown" where it is only on the path."""
    try:
        return metadata.version("r2s")
    except metadata.PackageNotFoundError:
        return "unknown"


def write(path: Path | str, card: Card) -> None:
    """Write a card, whole or not at all; raises as `r2s._util.files.write_json`."""
    write_json(path, as_json(card))


def read(path: Path | str) -> Card:
    """Read what `write` wrote.

    Raises `OSError`; `ValueError` that names the file and the key: no JSON, another format, keys
    that are missing or unknown, values of another type, numbers that no fabric has, an estimate
    of another fabric.
    """
    stored = load_json(path)
    try:
        return from_json(stored)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def as_json(card: Card) -> dict[str, Any]:
    """The JSON object in the file of a card."""
    provenance = dataclasses.asdict(card.provenance)
    provenance["recordings"] = [{"name": n, "sha256": h} for n, h in card.provenance.recordings]
    provenance["assumed"] = list(card.provenance.assumed)
    return {
        "format": FORMAT,
        "name": card.name,
        "precision": card.precision,
        "fabric": dict(card.numbers),
        "provenance": provenance,
        "estimate": None if card.found is None else dict(card.found),
    }


def from_json(stored: Any) -> Card:
    """The card that `as_json` made, or version 0.2.0; `ValueError` names the key that is wrong."""
    form = stored.get("format") if isinstance(stored, dict) else type(stored).__name__
    if form not in (FORMAT, FORMAT_0_2):
        raise ValueError(
            f"no fabric card: format must be {FORMAT!r}, found {shown(form)}: "
            "r2s estimate writes one"
        )
    check_keys(stored, KEYS, "")
    for name in ("name", "precision"):
        expect(isinstance(stored[name], str), name, "text", stored[name])
    provenance, found = _provenance_from(stored["provenance"]), stored["estimate"]
    fabric = fabric_from_json(stored["fabric"])
    try:
        if found is not None and form == FORMAT_0_2:
            found = estimates.upgraded(found)
        card = Card(stored["name"], stored["precision"], stored["fabric"], provenance, found)
        estimate = card.estimate
    except KeyError as error:
        raise ValueError(f"estimate: missing: {error.args[0]}") from error
    except (TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"estimate: {error}") from error
    if estimate is not None and fabric_as_json(estimate.fabric) != fabric_as_json(fabric):
        raise ValueError(
            "estimate: its fabric has other numbers than the card's: a fabric that was changed is "
            "no longer what was estimated, so set estimate to null and say in provenance: method "
            "what was changed"
        )
    return card


def _provenance_from(stored: Any) -> Provenance:
    names = [field.name for field in dataclasses.fields(Provenance)]
    check_keys(stored, names, "provenance")
    for name in ("method", "source", "version", "date"):
        expect(isinstance(stored[name], str), f"provenance: {name}", "text", stored[name])
    expect(isinstance(stored["recordings"], list), "provenance: recordings", "a list", "none")
    for i, recording in enumerate(stored["recordings"]):
        check_keys(recording, ("name", "sha256"), f"provenance: recordings[{i}]")
    recordings = tuple((each["name"], each["sha256"]) for each in stored["recordings"])
    known, assumed = {*NUMBERS, *LAWS}, stored["assumed"]
    expect(isinstance(assumed, list), "provenance: assumed", "a list", assumed)
    fits = all(isinstance(name, str) and name.split(" ")[0] in known for name in assumed)
    expect(fits, "provenance: assumed", f"some of {', '.join(sorted(known))}", assumed)
    return Provenance(**{**stored, "recordings": recordings, "assumed": tuple(assumed)})
