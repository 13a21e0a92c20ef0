"""What an estimator is given, and what it gives back."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from r2s.fabric import Fabric, constant_laws
from r2s.family import OrthotropicFamily, Range
from r2s.recording import Recording, subsample
from r2s.scenario import Scenario, from_recording

FORMAT = "r2s-estimate/1"
DETERMINED = 0.05  # standard deviation, relative or absolute, up to which a parameter is known


class Problem(eqx.Module):
    """A recording to be explained by a member of a family.

    - `scenario`: how the sheet is held and moved.
    - `points`, `mask`: the clouds of the frames that count, [m].
    - `frames`: which frames of the scenario these are.
    - `family`: the fabrics to choose from.
    - `misalignment`: how far the cameras' frame may be off the gripper's, as the standard
      deviations of a shift [m] and of a turn about the vertical [rad]. It is estimated along with
      the fabric, so that an error of calibration is not taken for a property of the fabric.
    """

    scenario: Scenario
    points: Float[Array, "frame point 3"]
    mask: Bool[Array, "frame point"]
    frames: tuple[int, ...] = eqx.field(static=True)
    family: OrthotropicFamily
    misalignment: tuple[float, float] = eqx.field(static=True, default=(0.015, 0.15))

    @classmethod
    def make(
        cls,
        recording: Recording,
        family: OrthotropicFamily,
        *,
        num_points: int = 300,
        voxel: float = 0.008,
        shape: tuple[int, int] = (9, 9),
        seed: int = 0,
    ) -> "Problem":
        """A problem from a recording, its clouds thinned to `num_points` a frame.

        `voxel` [m] is the distance below which points are merged, `shape` the vertices of the
        simulated sheet.
        """
        thinned = subsample(recording, num_points, voxel, seed)
        first, last = recording.info.frames_used
        return cls(
            scenario=from_recording(recording, shape),
            points=thinned.points[first : last + 1],
            mask=thinned.mask[first : last + 1],
            frames=tuple(range(first, last + 1)),
            family=family,
        )


@dataclass(frozen=True)
class Estimate:
    """What an estimator found.

    - `approach`: which estimator, with its settings in words.
    - `fabric`: the estimate.
    - `ranges`, `values`: its parameters, in the units of the ranges.
    - `deviations`: their standard deviations: relative where the range is logarithmic, else
      absolute; NaN from an estimator that gives none. The ranges count as a flat prior.
    - `correlation`: of the parameters, [-].
    - `misalignment`: of the cameras: shift [m] (x, y, z) and turn about the vertical [rad].
    - `loss`: at the estimate, [m^2].
    - `losses`, `history`: of every iteration and start, [m^2], and the parameters there.
    - `seconds`: how long it took, compilation included.
    """

    approach: str
    fabric: Fabric
    ranges: tuple[Range, ...]
    values: np.ndarray
    deviations: np.ndarray
    correlation: np.ndarray
    misalignment: np.ndarray
    loss: float
    losses: np.ndarray
    history: np.ndarray
    seconds: float

    @property
    def determined(self) -> np.ndarray:
        """Which parameters the recording determines: those known to `DETERMINED` or better."""
        return self.deviations < DETERMINED


def as_json(estimate: Estimate) -> dict[str, Any]:
    """An estimate with units, for a file. What is not determined has its bounds, and says so."""
    parameters = {}
    rows = zip(
        estimate.ranges, estimate.values, estimate.deviations, estimate.determined, strict=True
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
    shift = estimate.misalignment.tolist()
    return {
        "format": FORMAT,
        "approach": estimate.approach,
        "parameters": parameters,
        "correlation": _plain(estimate.correlation),
        "fabric": _fabric_json(estimate.fabric),
        "misalignment": {
            "shift": shift[:3],
            "shift_unit": "m",
            "turn": shift[3],
            "turn_unit": "rad",
        },
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
        "damping": (fabric.damping, "s"),
        "friction": (fabric.friction, "-"),
        "thickness": (fabric.thickness, "m"),
        "mass_damping": (fabric.mass_damping, "1/s"),
    }
    return {name: {"value": float(value), "unit": unit} for name, (value, unit) in numbers.items()}


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
    numbers = {name: value["value"] for name, value in stored["fabric"].items()}
    return Estimate(
        approach=stored["approach"],
        fabric=Fabric.make(
            numbers["density"],
            (numbers["C11"], numbers["C12"], numbers["C22"], numbers["C33"]),
            numbers["bending"],
            numbers["damping"],
            numbers["friction"],
            numbers["thickness"],
            numbers.get("mass_damping", 0.0),  # not in the files of version 0.1
        ),
        ranges=ranges,
        values=np.array([p["value"] for p in parameters.values()]),
        deviations=_numbers([p["deviation"] for p in parameters.values()]),
        correlation=_numbers(stored["correlation"]),
        misalignment=np.array([*stored["misalignment"]["shift"], stored["misalignment"]["turn"]]),
        loss=stored["loss"],
        losses=_numbers(stored["losses"]),
        history=_numbers(stored["history"]),
        seconds=stored["seconds"],
    )
