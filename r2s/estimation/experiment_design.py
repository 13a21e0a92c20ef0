"""A motion that is planned: what it would reveal, in words."""

import inspect

import jax

from r2s import scenarios
from r2s.estimation.estimate import Estimate
from r2s.estimation.identifiability import sensitivity
from r2s.estimation.problem import Problem
from r2s.fabrics import presets
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.scenarios import synthetic


def planned(
    scenario: str, fabric: str, numbers: dict[str, float], noise: float = 1e-3, seed: int = 0
) -> Estimate:
    """What a scenario with these numbers would reveal of a preset; `noise` of the clouds [m].

    Raises `ValueError` for an unknown scenario, preset or number, and for numbers out of range.
    """
    if scenario not in scenarios.SIX:
        raise ValueError(f"a scenario is one of {', '.join(scenarios.SIX)}, got {scenario!r}")
    if fabric not in presets.FIVE:
        raise ValueError(f"a preset is one of {', '.join(presets.FIVE)}, got {fabric!r}")
    if not noise >= 0:
        raise ValueError(f"noise must not be negative [m], got {noise:g}")
    try:
        experiment = scenarios.SIX[scenario](**numbers)
    except TypeError as error:
        known = inspect.signature(getattr(scenarios, scenario)).parameters
        raise ValueError(f"{scenario}: {error}; it takes {', '.join(known)}") from None
    chosen = presets.FIVE[fabric]()
    seen = synthetic.sensing(experiment)._replace(noise=noise)
    key = jax.random.key(seed)
    recording = synthetic.record(experiment, chosen, fabric, seen=seen, key=key)
    space = OrthotropicSpace.make(float(chosen.density))
    return sensitivity(Problem.make(recording, space), chosen)


def describe(estimate: Estimate) -> list[str]:
    """One line a parameter, a combination, and what was in doubt: how well each is known."""
    lines = []
    rows = zip(
        estimate.ranges,
        estimate.values,
        estimate.standard_errors,
        estimate.identifiable,
        strict=True,
    )
    for bound, value, deviation, determined in rows:
        unit = "" if bound.unit == "-" else f" {bound.unit}"
        spread = f"{deviation:.1%}" if bound.log else f"{deviation:.3f}"
        word = "determined" if determined else "not determined"
        lines.append(f"{bound.name:14s}{value:10.4g}{unit:6s} +- {spread:8s}{word}")
    for found in estimate.combinations:
        powers = " ".join(f"{name}^{power:g}" for name, power in found.exponents.items())
        lines.append(f"known to {found.deviation:.1%}: {powers}")
    for name, unit, value, deviation in estimate.nuisances:
        unit = "" if unit == "-" else f" {unit}"
        lines.append(f"{name:14s}{value:10.4g}{unit:6s} +- {deviation:.2g}")
    return lines
