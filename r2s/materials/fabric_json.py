"""A fabric as JSON: every number, also those of its laws, beside its unit. NaN is null: unknown."""

import dataclasses
import inspect
import math
import sys
from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from r2s._util.checks import expect_value as expect
from r2s.materials.bending import HingeBending
from r2s.materials.fabric import NUMBERS, Fabric, check_fabric
from r2s.materials.membrane import OrthotropicMembrane, SpringMembrane
from r2s.materials.parameters import EXTENDED
from r2s.materials.plate import OrthotropicPlate, PlateBending, PlateLaw
from r2s.materials.tables import TableBending, TableMembrane

KINDS = [space.kind for space in EXTENDED.values()]  # which estimates may have
PLATES = [kind for kind in KINDS if issubclass(kind, PlateLaw)]
YARNS = [kind for kind in KINDS if kind not in PLATES]
MEMBRANES = OrthotropicMembrane, *YARNS, SpringMembrane, TableMembrane
BENDINGS = PlateBending, OrthotropicPlate, *PLATES, HingeBending, TableBending
LAWS = {"membrane": (MEMBRANES, "N/m"), "bending": (BENDINGS, "N m")}
TABLE_SHAPES = {TableMembrane: (6, 4), TableBending: (3, 5)}


def fabric_as_json(fabric: Fabric) -> dict[str, Any]:
    """The JSON object of one fabric.

    Raises `TypeError` for a law that r2s does not have, since its code cannot go into a file;
    `ValueError` for a batch of fabrics and for infinite numbers.
    """
    if jnp.ndim(fabric.density):
        raise ValueError(f"expected one fabric, got a batch of shape {jnp.shape(fabric.density)}")
    stored: dict[str, Any] = {n: _entry(getattr(fabric, n), unit) for n, unit in NUMBERS.items()}
    for part, (laws, _) in LAWS.items():
        law = getattr(fabric, part)
        if type(law) not in laws:
            raise TypeError(
                f"a file holds a {part} law of r2s ({', '.join(k.__name__ for k in laws)}), got "
                f"{type(law).__name__}"
            )
        stored[part] = _law_as_json(law, part)
    return nan_to_null(stored, "fabric")


def fabric_from_json(stored: Any) -> Fabric:
    """The fabric that `fabric_as_json` wrote, in JAX's default precision.

    Raises `ValueError` that names the key: missing or unknown keys, another unit, values of
    another type, numbers that no fabric has.
    """
    check_keys(stored, (*NUMBERS, *LAWS), "fabric")
    numbers = {n: _value(stored[n], unit, f"fabric: {n}", ()) for n, unit in NUMBERS.items()}
    laws = {part: _law_from(stored[part], part, f"fabric: {part}") for part in LAWS}
    fabric = Fabric(**numbers, **laws)
    check_fabric(fabric, may_lack=True)
    return fabric


def nan_to_null(value: Any, where: str) -> Any:
    """Nested JSON values with None for NaN; `ValueError` that says where a number is infinite."""
    if isinstance(value, Mapping):
        return {key: nan_to_null(entry, f"{where}: {key}") for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [nan_to_null(entry, f"{where}[{i}]") for i, entry in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        if math.isnan(value):
            return None
        raise ValueError(f"{where}: a file holds finite numbers, found {value}")
    return value


def check_keys(stored: Any, expected: Iterable[str], where: str) -> None:
    """Raise `ValueError` unless an object has exactly the `expected` keys."""
    prefix = f"{where}: " if where else ""
    expect(isinstance(stored, Mapping), where or "the card", "an object", stored)
    if missing := [key for key in expected if key not in stored]:
        raise ValueError(f"{prefix}missing: {', '.join(missing)}")
    if unknown := sorted(set(stored) - set(expected)):
        raise ValueError(f"{prefix}unknown: {', '.join(unknown)}; known: {', '.join(expected)}")


def _law_as_json(law: Any, part: str) -> dict[str, Any]:
    stored: dict[str, Any] = {"law": type(law).__name__}
    for name, within in _fields(type(law)).items():
        value, unit = getattr(law, name), _unit(part, type(law), name)
        stored[name] = _law_as_json(value, part) if within else _entry(value, unit)
    return stored


def _entry(value: Any, unit: str) -> dict[str, Any]:
    return {"value": np.asarray(value).tolist(), "unit": unit}


def _fields(law: type) -> dict[str, bool]:
    """The names of a law's fields, and whether each is a law itself."""
    kinds = {field.name: field.type for field in dataclasses.fields(law)}
    return {n: inspect.isclass(k) and issubclass(k, eqx.Module) for n, k in kinds.items()}


def _unit(part: str, law: type, name: str) -> str:
    return getattr(law, "units", {}).get(name, LAWS[part][1])


def _law_from(stored: Any, part: str, where: str) -> Any:
    kinds = {kind.__name__: kind for kind in LAWS[part][0]}
    name = stored.get("law") if isinstance(stored, dict) else None
    expect(
        isinstance(name, str) and name in kinds, f"{where}: law", f"one of {', '.join(kinds)}", name
    )
    kind = kinds[name]  # pyright: ignore[reportArgumentType]
    names = _fields(kind)
    check_keys(stored, ("law", *names), where)
    fields, shape = {}, TABLE_SHAPES.get(kind, ())
    for name, within in names.items():
        value, at = stored[name], f"{where}: {name}"
        unit = _unit(part, kind, name)
        fields[name] = _law_from(value, part, at) if within else _value(value, unit, at, shape)
    return kind(**fields)


def _value(stored: Any, unit: str, where: str, shape: tuple[int, ...]) -> jax.Array:
    check_keys(stored, ("value", "unit"), where)
    expect(stored["unit"] == unit, f"{where}: unit", repr(unit), stored["unit"])
    values = np.array(stored["value"], object)
    expected = f"numbers of shape {shape}" if shape else "a number, or null"
    fits = values.shape == shape and all(map(_is_number, values.flat))
    expect(fits, f"{where}: value", expected, stored["value"])
    return jnp.asarray(values.astype(float), float)  # None is NaN


def _is_number(value: Any) -> bool:
    """Whether JSON gave a number that fits into 64 bits, NaN, or null."""
    if isinstance(value, int):
        return not isinstance(value, bool) and abs(value) <= sys.float_info.max
    return isinstance(value, float | None)
