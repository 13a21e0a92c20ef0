"""Fabric cards: a fabric or an estimate as a JSON file, to keep, to share, and to simulate again.

A card has the fabric as it is simulated (its laws with every number and unit), where the numbers
come from, and, of an estimate, all that `r2s.estimation.estimate.as_json` says but its history:
bounds, deviations, correlation, what is not determined. A card holds what the file holds, double
precision and all, so that writing one that was read gives the same file; its `fabric` is in JAX's
default precision. A number that is not known (NaN) is null.
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from r2s.estimation import estimate as estimates
from r2s.estimation.estimate import Estimate
from r2s.fabrics import presets
from r2s.fabrics.fabric import Fabric
from r2s.files import write_json
from r2s.laws.bending import HingeBending, OrthotropicBending, SpringBending
from r2s.laws.membrane import OrthotropicMembrane, SpringMembrane
from r2s.laws.plate import OrthotropicPlate, PlateBending
from r2s.laws.tables import (
    DiffSimTableBending,
    DiffSimTableMembrane,
    TableBending,
    TableMembrane,
)
from r2s.recordings.recording import Recording

FORMAT = "r2s-card/1"
KEYS = ("format", "name", "precision", "fabric", "provenance", "estimate")
NUMBERS = {"density": "kg/m^2", "damping": "s", "friction": "-", "thickness": "m"}
NUMBERS |= {"mass_damping": "1/s"}
MEMBRANES = (OrthotropicMembrane, SpringMembrane, TableMembrane, DiffSimTableMembrane)
BENDINGS = (PlateBending, OrthotropicPlate, HingeBending, OrthotropicBending, SpringBending)
LAWS = {
    "membrane": (MEMBRANES, "N/m"),
    "bending": ((*BENDINGS, TableBending, DiffSimTableBending), "N m"),
}
OTHER_UNITS = {"poissons_ratio": "-", "spacing": "m", "SpringBending.stiffness": "N/m"}
LEFT_OUT = ("losses", "history")  # of an estimate: as long as its search, and no use afterwards


@dataclass(frozen=True)
class Provenance:
    """Where the numbers of a card come from. All but `method` may be empty.

    - `method`: measured or estimated, and how.
    - `source`: a citation, or whose data.
    - `recordings`: what an estimate was made from: name and sha256, as of `fingerprint`.
    - `version`: of r2s.
    - `date`: as the caller has it; r2s looks at no clock.
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

    - `name`: of the fabric.
    - `precision`: in which its numbers were computed, "float32" or "float64".
    - `numbers`: the fabric, as in the file.
    - `provenance`: where that comes from.
    - `found`: the estimate, as in the file; None: there is none.
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
        if jnp.ndim(fabric.density):
            shape = jnp.shape(fabric.density)
            raise ValueError(f"a card holds one fabric, got a batch of shape {shape}")
        if not provenance.version:
            provenance = dataclasses.replace(provenance, version=version())
        numbers, found = _plain(_fabric_json(fabric), "fabric"), None
        if isinstance(what, Estimate):
            full = estimates.as_json(what)
            found = _plain({k: v for k, v in full.items() if k not in LEFT_OUT}, "estimate")
        card = cls(name, str(np.asarray(fabric.density).dtype), numbers, provenance, found)
        _check(card.fabric)
        return card

    @property
    def fabric(self) -> Fabric:
        """The fabric, in JAX's default precision."""
        return _fabric_from(self.numbers)

    @property
    def estimate(self) -> Estimate | None:
        """The estimate without its history, or None."""
        if self.found is None:
            return None
        empty = {"losses": [], "history": []}
        return estimates.from_json(_known({**self.found, **empty}))


def preset(name: str) -> Card:
    """The card of a preset of `r2s.fabrics.presets`; `ValueError` names the presets there are.

    >>> preset("black_denim").numbers["density"]
    {'value': 0.32, 'unit': 'kg/m^2'}
    """
    if name not in presets.MEASURED:
        raise ValueError(f"no preset {name!r}; there are {', '.join(presets.MEASURED)}")
    make = presets.MEASURED[name]
    described = " ".join((make.__doc__ or "").split())
    about = Provenance(
        method=f"{described} Areal density and stiffness at small strains, rounded to two digits; "
        "bending: mean over directions and curvatures.",
        source="Wang, O'Brien, Ramamoorthi: Data-driven elastic models for cloth: modeling and "
        "measurement. ACM Transactions on Graphics 30(4), 2011",
        assumed=("damping", "friction", "thickness", "mass_damping"),
    )
    return Card.make(name, make(), about)


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
    """Write a card, whole or not at all; raises as `r2s.files.write_json`."""
    write_json(path, as_json(card))


def read(path: Path | str) -> Card:
    """Read what `write` wrote.

    Raises `OSError`; `ValueError` that names the file and the key: no JSON, another format, keys
    that are missing or unknown, values of another type, numbers that no fabric has, an estimate
    of another fabric.
    """
    try:
        return from_json(json.loads(Path(path).read_text(encoding="utf-8")))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def as_json(card: Card) -> dict[str, Any]:
    """What the file of a card holds."""
    about = dataclasses.asdict(card.provenance)
    about["recordings"] = [{"name": n, "sha256": h} for n, h in card.provenance.recordings]
    about["assumed"] = list(card.provenance.assumed)
    found = None if card.found is None else dict(card.found)
    values = (FORMAT, card.name, card.precision, dict(card.numbers), about, found)
    return dict(zip(KEYS, values, strict=True))


def from_json(stored: Any) -> Card:
    """The card that `as_json` made; `ValueError` names the key that is wrong."""
    if not isinstance(stored, dict) or stored.get("format") != FORMAT:
        found = stored.get("format") if isinstance(stored, dict) else type(stored).__name__
        raise ValueError(f"no fabric card: format must be {FORMAT!r}, found {found!r}")
    _keys(stored, KEYS, "")
    for name in ("name", "precision"):
        _expect(isinstance(stored[name], str), name, "text", stored[name])
    about, found = _provenance_from(stored["provenance"]), stored["estimate"]
    card = Card(stored["name"], stored["precision"], stored["fabric"], about, found)
    fabric = card.fabric
    _check(fabric)
    try:
        estimate = card.estimate
    except KeyError as error:
        raise ValueError(f"estimate: missing: {error.args[0]}") from error
    except (TypeError, AttributeError) as error:
        raise ValueError(f"estimate: not readable: {error}") from error
    except ValueError as error:
        raise ValueError(f"estimate: {error}") from error
    if estimate is not None and not _same(estimate.fabric, fabric):
        raise ValueError(
            "estimate: its fabric has other numbers than the card's: a fabric that was changed is "
            "no longer what was estimated, so set estimate to null and say in provenance: method "
            "what was changed"
        )
    return card


def _same(one: Fabric, other: Fabric) -> bool:
    leaves = jax.tree.leaves((one, other))
    half = len(leaves) // 2
    pairs = zip(leaves[:half], leaves[half:], strict=True)
    alike = jax.tree.structure(one) == jax.tree.structure(other)
    return alike and all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def _fabric_json(fabric: Fabric) -> dict[str, Any]:
    stored: dict[str, Any] = {}
    for name, unit in NUMBERS.items():
        stored[name] = _entry(getattr(fabric, name), unit)
    for part, (laws, _) in LAWS.items():
        law = getattr(fabric, part)
        if type(law) not in laws:
            raise TypeError(
                f"a card holds a {part} law of r2s ({', '.join(k.__name__ for k in laws)}), got "
                f"{type(law).__name__}"
            )
        fields = {name: _entry(getattr(law, name), _unit(part, law, name)) for name in _names(law)}
        stored[part] = {"law": type(law).__name__, **fields}
    return stored


def _entry(value: Any, unit: str) -> dict[str, Any]:
    return {"value": np.asarray(value).tolist(), "unit": unit}


def _names(law: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(law)]


def _unit(part: str, law: Any, name: str) -> str:
    kind = (law if isinstance(law, type) else type(law)).__name__
    return OTHER_UNITS.get(f"{kind}.{name}") or OTHER_UNITS.get(name) or LAWS[part][1]


def _fabric_from(stored: Any) -> Fabric:
    _keys(stored, (*NUMBERS, *LAWS), "fabric")
    numbers = {n: _value(stored[n], unit, f"fabric: {n}", ()) for n, unit in NUMBERS.items()}
    laws = {part: _law_from(stored[part], part) for part in LAWS}
    return Fabric(**numbers, **laws)


def _law_from(stored: Any, part: str) -> Any:
    kinds = {kind.__name__: kind for kind in LAWS[part][0]}
    where = f"fabric: {part}"
    name = stored.get("law") if isinstance(stored, dict) else None
    _expect(name in kinds, f"{where}: law", f"one of {', '.join(kinds)}", name)
    kind = kinds[name]  # pyright: ignore[reportArgumentType]
    _keys(stored, ("law", *_names(kind)), where)
    shape = ((6, 4) if part == "membrane" else (3, 5)) if "Table" in kind.__name__ else ()
    return kind(
        **{n: _value(stored[n], _unit(part, kind, n), f"{where}: {n}", shape) for n in _names(kind)}
    )


def _value(stored: Any, unit: str, where: str, shape: tuple[int, ...]) -> jax.Array:
    _keys(stored, ("value", "unit"), where)
    _expect(stored["unit"] == unit, f"{where}: unit", repr(unit), stored["unit"])
    values = np.array(_known(stored["value"]), object)
    numbers = [isinstance(v, int | float) and not isinstance(v, bool) for v in values.flat]
    expected = f"numbers of shape {shape}" if shape else "a number, or null"
    fits = values.shape == shape and all(numbers)
    _expect(fits, f"{where}: value", expected, stored["value"])
    return jnp.asarray(values.astype(float), float)


def _provenance_from(stored: Any) -> Provenance:
    names = [field.name for field in dataclasses.fields(Provenance)]
    _keys(stored, names, "provenance")
    for name in ("method", "source", "version", "date"):
        _expect(isinstance(stored[name], str), f"provenance: {name}", "text", stored[name])
    seen = []
    _expect(isinstance(stored["recordings"], list), "provenance: recordings", "a list", "none")
    for i, each in enumerate(stored["recordings"]):
        _keys(each, ("name", "sha256"), f"provenance: recordings[{i}]")
        seen.append((each["name"], each["sha256"]))
    known = {*NUMBERS, *LAWS}
    assumed = stored["assumed"]
    _expect(isinstance(assumed, list), "provenance: assumed", "a list", assumed)
    fits = all(isinstance(name, str) and name.split(" ")[0] in known for name in assumed)
    _expect(fits, "provenance: assumed", f"some of {', '.join(sorted(known))}", assumed)
    return Provenance(**{**stored, "recordings": tuple(seen), "assumed": tuple(assumed)})


def _check(fabric: Fabric) -> None:
    """Raise `ValueError` for numbers that no fabric has; NaN passes as not known."""
    for name, unit in NUMBERS.items():
        value = float(getattr(fabric, name))
        positive = name in ("density", "thickness")
        if value < 0 or (positive and value == 0):
            word = "positive" if positive else "not negative"
            raise ValueError(f"fabric: {name} must be {word} [{unit}], found {value}")


def _plain(value: Any, where: str) -> Any:
    """With None for NaN; `ValueError` for an infinite number, which JSON has no word for."""
    if isinstance(value, Mapping):
        return {key: _plain(each, f"{where}: {key}") for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each, f"{where}[{i}]") for i, each in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        if math.isnan(value):
            return None
        raise ValueError(f"{where}: a card holds finite numbers, found {value}")
    return value


def _known(value: Any) -> Any:
    """With NaN for None."""
    if isinstance(value, Mapping):
        return {key: _known(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_known(each) for each in value]
    return math.nan if value is None else value


def _keys(stored: Any, expected: Any, where: str) -> None:
    prefix = f"{where}: " if where else ""
    _expect(isinstance(stored, Mapping), where or "the card", "an object", stored)
    if missing := [key for key in expected if key not in stored]:
        raise ValueError(f"{prefix}missing: {', '.join(missing)}")
    if unknown := sorted(set(stored) - set(expected)):
        raise ValueError(f"{prefix}unknown: {', '.join(unknown)}; known: {', '.join(expected)}")


def _expect(holds: bool, where: str, expected: str, found: Any) -> None:
    if not holds:
        raise ValueError(f"{where}: expected {expected}, found {found!r}")
