"""What an estimator gives back: a fabric, how far to trust it, and how it was found."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from r2s.fabrics.fabric import Fabric, constant_laws
from r2s.fabrics.parameters import ParameterSpace, Range
from r2s.laws.plate import PlateBending

FORMAT = "r2s-estimate/2"
DETERMINED = 0.025  # standard deviation, relative or absolute: then 5 % are two of them


class Nuisance(NamedTuple):
    """Something about a recording that was estimated along with the fabric.

    `deviation` is the standard deviation, in the unit of the value; NaN when there is none.
    """

    name: str
    unit: str
    value: float
    deviation: float


class Combination(NamedTuple):
    """A product of powers of parameters (those on a linear scale: a sum) that is known.

    - `exponents`: of each parameter by name, the largest 1.
    - `value`: the product, in the units that follow.
    - `deviation`: relative, if all of them are logarithmic, [-].
    """

    exponents: dict[str, float]
    value: float
    deviation: float


@dataclass(frozen=True)
class Estimate:
    """What an estimator found.

    - `approach`: which estimator, with its settings in words.
    - `fabric`: the estimate.
    - `ranges`, `values`: its parameters, in the units of the ranges.
    - `standard_errors`: their standard deviations: relative where the range is logarithmic, else
      absolute; NaN from an estimator that gives none. The ranges count as a flat prior.
    - `correlation`: of the parameters, [-].
    - `nuisances`: what was not known for sure of the recordings.
    - `loss`: at the estimate, [m^2].
    - `losses`, `history`: of every iteration and start, [m^2], and the parameters there. A stage
      counts other frames than the one before, or leaves outliers out: its losses are others.
    - `seconds`: how long it took, compilation included.
    """

    approach: str
    fabric: Fabric
    ranges: tuple[Range, ...]
    values: np.ndarray
    standard_errors: np.ndarray
    correlation: np.ndarray
    nuisances: tuple[Nuisance, ...]
    loss: float
    losses: np.ndarray
    history: np.ndarray
    seconds: float

    @property
    def identifiable(self) -> np.ndarray:
        """Which parameters the recording determines: to 5 % (or 0.05) with 95 % confidence."""
        return self.standard_errors < DETERMINED

    @property
    def combinations(self) -> list[Combination]:
        """What is determined of the parameters that are not determined one by one.

        Eigenvectors of their covariance, on the scales of their ranges, whose deviation is at most
        `DETERMINED`; the best known first.
        """
        index = np.flatnonzero(~self.identifiable & np.isfinite(self.standard_errors))
        if len(index) < 2:
            return []
        scale = self.standard_errors[index]
        covariance = self.correlation[np.ix_(index, index)] * np.outer(scale, scale)
        squares, vectors = np.linalg.eigh(covariance)
        found = []
        for square, vector in zip(squares, vectors.T, strict=True):
            vector = vector / vector[np.argmax(np.abs(vector))]
            deviation = float(np.sqrt(max(square, 0)) * np.linalg.norm(vector))
            if deviation < DETERMINED:
                kept = [(int(i), float(power)) for i, power in zip(index, vector, strict=True)]
                found.append(_combination(self, kept, deviation))
        return found


def without_standard_errors(
    approach: str,
    space: ParameterSpace,
    place: Any,
    loss: float,
    losses: np.ndarray,
    history: np.ndarray,
    seconds: float,
) -> Estimate:
    """An estimate at a point of the space's unit cube, by a method that gives no deviations."""
    unknown = np.full(space.dim, np.nan)
    return Estimate(
        approach=approach,
        fabric=space(place),
        ranges=space.ranges,
        values=np.asarray(space.values(place)),
        standard_errors=unknown,
        correlation=np.full((space.dim, space.dim), np.nan),
        nuisances=(),
        loss=loss,
        losses=losses,
        history=history,
        seconds=seconds,
    )


LEAST_EXPONENT = 0.05  # what has less of a share in a combination is not named


def _combination(estimate: Estimate, powers: list[tuple[int, float]], deviation: float):
    powers = [(i, power) for i, power in powers if abs(power) >= LEAST_EXPONENT]
    value = 1.0
    for i, power in powers:
        number = float(estimate.values[i])
        value *= number**power if estimate.ranges[i].log else float(np.exp(power * number))
    named = {estimate.ranges[i].name: round(power, 2) for i, power in powers}
    return Combination(named, value, deviation)


def as_json(estimate: Estimate) -> dict[str, Any]:
    """An estimate with units, for a file. What is not determined has its bounds, and says so."""
    parameters = {}
    rows = zip(
        estimate.ranges,
        estimate.values,
        estimate.standard_errors,
        estimate.identifiable,
        strict=True,
    )
    for bound, value, deviation, determined in rows:
        parameters[bound.name] = {
            "value": float(value),
            "unit": bound.unit,
            "deviation": float(deviation) if np.isfinite(deviation) else None,
            "deviation_is": "relative" if bound.log else "absolute",
            "determined": bool(determined),
            "bounds": [bound.low, bound.high],
        }
    return {
        "format": FORMAT,
        "approach": estimate.approach,
        "parameters": parameters,
        "correlation": _plain(estimate.correlation),
        "fabric": _fabric_json(estimate.fabric),
        "combinations": [each._asdict() for each in estimate.combinations],
        "conditions": [
            c._asdict() | {"deviation": c.deviation if np.isfinite(c.deviation) else None}
            for c in estimate.nuisances
        ],
        "loss": estimate.loss,
        "loss_unit": "m^2",
        "seconds": estimate.seconds,
        "losses": _plain(estimate.losses),
        "history": _plain(estimate.history),
    }


def _fabric_json(fabric: Fabric) -> dict[str, Any]:
    law, bending = constant_laws(fabric)
    numbers = {
        "density": (fabric.density, "kg/m^2"),
        "C11": (law.c11, "N/m"),
        "C12": (law.c12, "N/m"),
        "C22": (law.c22, "N/m"),
        "C33": (law.c33, "N/m"),
        "bending": (bending.stiffness, "N m"),
        "bending_poissons_ratio": (bending.poissons_ratio, "-"),
        "damping": (fabric.damping, "s"),
        "friction": (fabric.friction, "-"),
        "thickness": (fabric.thickness, "m"),
        "mass_damping": (fabric.mass_damping, "1/s"),
    }
    return {name: {"value": float(value), "unit": unit} for name, (value, unit) in numbers.items()}


def _fabric_from(stored: dict[str, Any]) -> Fabric:
    numbers = {name: value["value"] for name, value in stored.items()}
    fabric = Fabric.make(
        numbers["density"],
        (numbers["C11"], numbers["C12"], numbers["C22"], numbers["C33"]),
        numbers["bending"],
        numbers["damping"],
        numbers["friction"],
        numbers["thickness"],
        numbers["mass_damping"],
    )
    bending = PlateBending.make(numbers["bending"], numbers["bending_poissons_ratio"])
    return replace(fabric, bending=bending)


def _plain(values: np.ndarray) -> Any:
    """Nested lists, with None for what is not finite: JSON has no word for it."""
    plain = values.astype(object)
    plain[~np.isfinite(values)] = None
    return plain.tolist()


def _numbers(values: Any) -> np.ndarray:
    return np.array(values, dtype=float)  # None becomes NaN


def from_json(stored: dict[str, Any]) -> Estimate:
    """The estimate that `as_json` made, with its history.

    Raises `ValueError` when it is of another format.
    """
    if stored.get("format") != FORMAT:
        raise ValueError(f"expected an estimate of format {FORMAT}, got {stored.get('format')}")
    parameters = stored["parameters"]
    ranges = tuple(
        Range(name, p["unit"], *p["bounds"], log=p["deviation_is"] == "relative")
        for name, p in parameters.items()
    )
    return Estimate(
        approach=stored["approach"],
        fabric=_fabric_from(stored["fabric"]),
        ranges=ranges,
        values=np.array([p["value"] for p in parameters.values()]),
        standard_errors=_numbers([p["deviation"] for p in parameters.values()]),
        correlation=_numbers(stored["correlation"]),
        nuisances=tuple(
            Nuisance(**c | {"deviation": np.nan if c["deviation"] is None else c["deviation"]})
            for c in stored["conditions"]
        ),
        loss=stored["loss"],
        losses=_numbers(stored["losses"]),
        history=_numbers(stored["history"]),
        seconds=stored["seconds"],
    )
