"""A fabric estimated from runs of DiffSim, and what it predicts of others."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from r2s.estimation.estimate import Estimate
from r2s.estimation.judgement import descend
from r2s.estimation.method import Budget
from r2s.estimation.problem import NuisancePrior, Problem
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.scenarios.scenario import rollout
from r2s.study.diffsim_runs import COUNT, Made, read, sampled, scenario_of, truth

DATA = Path(__file__).parents[2] / "shared" / "data" / "diffsim_reference"
LIFT, REST, EDGE = "lift1_{}_9_dt10", "rest_{}_9_dt40", "edge_{}_9_dt40"
WIND = "hang2wind_{}_9_dt10"
EXACT = NuisancePrior(0.0, 0.0)

_motion = eqx.filter_jit(rollout)


def predicted(made: Made, fabric: Fabric, at_rest: bool = False) -> np.ndarray:
    """The vertices (frame, vertex, 3) [m] that a fabric would show in the frames that count.

    Raises `RuntimeError` when the run failed.
    """
    moved = _motion(scenario_of(made, at_rest), fabric)
    if not bool(jnp.all(moved.ok)):
        raise RuntimeError(f"{made.told['name']}: {moved.explain()}")
    return np.asarray(moved.x, np.float64)


def errors(found: np.ndarray, made: np.ndarray) -> np.ndarray:
    """Root mean square over the vertices [m], of each frame."""
    return np.sqrt(np.mean(np.sum((found - made) ** 2, axis=-1), axis=1))


def worst_error(name: str, fabric: Fabric, at_rest: bool = False) -> float:
    """The error of a fabric in a run, in the worst frame [% of the side]."""
    made = read(DATA, name)
    each = errors(predicted(made, fabric, at_rest), truth(made, at_rest))
    return 100 * float(np.max(each)) / float(np.max(np.ptp(np.asarray(made.mesh.rest), axis=0)))


def estimated(fabric: str, number: int, budget: Budget) -> Estimate:
    """The fabric of known density from clouds, of `number` points, of its lift and rest shape."""
    problems = []
    for i, (name, at_rest) in enumerate(((LIFT, False), (REST, True))):
        made = read(DATA, name.format(fabric))
        space = OrthotropicSpace.make(made.told["material_json"]["density"])
        key = jax.random.fold_in(jax.random.key(0), i)
        clouds = sampled(truth(made, at_rest), made.mesh, number, key)
        scenario, frames = scenario_of(made, at_rest), tuple(range(COUNT))
        problems.append(Problem(scenario, space, frames, clouds, nuisance_prior=EXACT))
    return descend(tuple(problems), budget, key=jax.random.key(1))
