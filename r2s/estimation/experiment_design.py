"""Experiment design: what a motion would reveal of a fabric, before anybody makes it."""

import inspect

import jax

from r2s import scenarios
from r2s.estimation.estimate import Estimate
from r2s.estimation.identifiability import sensitivity
from r2s.estimation.problem import Problem
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
from r2s.scenarios import synthetic


def evaluate_design(
    scenario: str, fabric: str, numbers: dict[str, float], noise: float = 1e-3, seed: int = 0
) -> Estimate:
    """What a motion would reveal of a fabric: standard errors and combinations.

    - `scenario`, `numbers`: the motion, one of `r2s.scenarios.SIX` and its arguments.
    - `fabric`: a preset, which counts as the true fabric.
    - `noise`: of the clouds, [m].
    - `seed`: of the noise.

    Raises `ValueError` for a scenario, preset or number that does not exist, and for numbers out of
    range.
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
