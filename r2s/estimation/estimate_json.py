"""Estimates as JSON objects with units, for files; those of version 0.2.0 are read too."""

from typing import Any

import numpy as np

from r2s.estimation.estimate import Agreement, Contradiction, Estimate, Misfit, Nuisance
from r2s.materials.fabric_json import fabric_as_json, fabric_from_json
from r2s.materials.parameters import Range

FORMAT = "r2s-estimate/3"
FORMAT_0_2 = "r2s-estimate/2"


def as_json(estimate: Estimate) -> dict[str, Any]:
    """An estimate with units, for a file; a number that is not finite is None (null)."""
    parameters = {}
    numbers = zip(estimate.values, estimate.standard_errors, estimate.identifiable, strict=True)
    for bound, (value, error, identifiable) in zip(estimate.ranges, numbers, strict=True):
        parameters[bound.name] = {
            "value": _finite_or_none(value),
            "unit": bound.unit,
            "standard_error": _finite_or_none(error),
            "standard_error_is": "relative" if bound.log else "absolute",
            "identifiable": bool(identifiable),
            "bounds": [bound.low, bound.high],
        }
    return {
        "format": FORMAT,
        "approach": estimate.approach,
        "converged": estimate.converged,
        "at_bounds": estimate.at_bounds,
        "parameters": parameters,
        "correlation": _nested(estimate.correlation),
        "fabric": fabric_as_json(estimate.fabric),
        "combinations": [each._asdict() for each in estimate.combinations],
        "shape": None if estimate.shape is None else list(estimate.shape),
        "refused": estimate.refused,
        "reached": None if estimate.reached is None else list(estimate.reached),
        "unsure": estimate.unsure,
        "mesh_bias": None if estimate.mesh_bias is None else _nested(estimate.mesh_bias),
        "agreement": _stored(estimate.agreement),
        "shares": list(estimate.shares),
        "misfits": [each._asdict() for each in estimate.misfits],
        "left_out": list(estimate.left_out),
        "nuisances": [
            {
                "name": name,
                "unit": unit,
                "value": _finite_or_none(value),
                "standard_error": _finite_or_none(error),
            }
            for name, unit, value, error in estimate.nuisances
        ],
        "loss": _finite_or_none(estimate.loss),
        "loss_unit": estimate.loss_unit,
        "seconds": estimate.seconds,
        "losses": _nested(estimate.losses),
        "history": _nested(estimate.history),
    }


def from_json(stored: dict[str, Any]) -> Estimate:
    """The estimate that `as_json` made, or that version 0.2.0 wrote.

    What was left out of `losses` and `history` is empty. Raises `ValueError` when the object is of
    another format or its fabric is none, `KeyError` when a key is missing.
    """
    if stored.get("format") == FORMAT_0_2:
        stored = upgraded(stored)
    if stored.get("format") != FORMAT:
        raise ValueError(f"expected an estimate of format {FORMAT}, got {stored.get('format')}")
    parameters = stored["parameters"]
    ranges = tuple(
        Range(name, p["unit"], *p["bounds"], log=p["standard_error_is"] == "relative")
        for name, p in parameters.items()
    )
    return Estimate(
        approach=stored["approach"],
        fabric=fabric_from_json(stored["fabric"]),
        ranges=ranges,
        values=_numbers([p["value"] for p in parameters.values()]),
        standard_errors=_numbers([p["standard_error"] for p in parameters.values()]),
        correlation=_numbers(stored["correlation"]),
        nuisances=tuple(
            Nuisance(n["name"], n["unit"], _number(n["value"]), _number(n["standard_error"]))
            for n in stored["nuisances"]
        ),
        loss=_number(stored["loss"]),
        losses=_numbers(stored.get("losses", [])),
        history=_numbers(stored.get("history", [])),
        seconds=stored["seconds"],
        converged=stored["converged"],
        loss_unit=stored["loss_unit"],
        shape=None if stored.get("shape") is None else tuple(stored["shape"]),
        refused=stored.get("refused", ""),
        reached=None if stored.get("reached") is None else tuple(stored["reached"]),
        unsure=stored.get("unsure", ""),
        mesh_bias=None if stored.get("mesh_bias") is None else _numbers(stored["mesh_bias"]),
        agreement=_agreement(stored.get("agreement")),
        shares=tuple(stored.get("shares", ())),
        misfits=tuple(Misfit(**each) for each in stored.get("misfits", ())),
        left_out=tuple(stored.get("left_out", ())),
    )


def _stored(agreement: Agreement | None) -> dict[str, Any] | None:
    if agreement is None:
        return None
    odd = agreement.contradiction
    return agreement._asdict() | {"contradiction": odd and odd._asdict()}


def _agreement(stored: dict[str, Any] | None) -> Agreement | None:
    """None of a file that does not say, or says it as version 0.3.0 did before it was released."""
    if stored is None:
        return None
    odd = stored["contradiction"]
    if odd is not None:
        odd = Contradiction(**odd | {"values": tuple(odd["values"])})
    density = stored["density"]
    told = tuple(stored["told"])
    density = None if density is None else tuple(density)
    return Agreement(stored["p"], told, odd, density, stored.get("exact"))


def upgraded(stored: dict[str, Any]) -> dict[str, Any]:
    """An estimate's JSON object of version 0.2.0 in the keys of this version.

    Version 0.2.0 said whether the physics-informed network had converged, in words; of other
    methods nothing is known.
    """
    renamed = {"deviation": "standard_error", "deviation_is": "standard_error_is"}
    renamed |= {"determined": "identifiable"}

    def rename(entry: dict[str, Any]) -> dict[str, Any]:
        return {renamed.get(key, key): value for key, value in entry.items()}

    approach = stored["approach"]
    known = "not converged" not in approach if approach.startswith("pinn") else None
    fabric = stored["fabric"]
    new = {
        "format": FORMAT,
        "converged": known,
        "parameters": {name: rename(entry) for name, entry in stored["parameters"].items()},
        "combinations": [rename(entry) for entry in stored["combinations"]],
        "nuisances": [rename(entry) for entry in stored["conditions"]],
        "fabric": _fabric_0_2(fabric) if "C11" in fabric else fabric,
    }
    upgraded = {key: value for key, value in stored.items() if key != "conditions"} | new
    return upgraded | {"at_bounds": from_json({**upgraded, "at_bounds": {}}).at_bounds}


def _fabric_0_2(stored: dict[str, Any]) -> dict[str, Any]:
    """The flat form of a fabric of constant stiffness, as `r2s.materials.fabric_json` has it."""
    membrane = {name.lower(): stored[name] for name in ("C11", "C12", "C22", "C33")}
    bending = {"stiffness": stored["bending"], "poissons_ratio": stored["bending_poissons_ratio"]}
    others = ("density", "damping", "friction", "thickness", "mass_damping")
    return {
        **{name: stored[name] for name in others},
        "membrane": {"law": "OrthotropicMembrane", **membrane},
        "bending": {"law": "PlateBending", **bending},
    }


def _finite_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _nested(values: np.ndarray) -> Any:
    """Nested lists, with None for numbers that are not finite: JSON has no word for them."""
    plain = values.astype(object)
    plain[~np.isfinite(values)] = None
    return plain.tolist()


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def _numbers(values: Any) -> np.ndarray:
    return np.array(values, dtype=float)  # None becomes NaN
