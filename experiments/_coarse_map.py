"""From what a coarse sheet fits to what the fabric is: a linear map, judged on other fabrics."""

import jax
import jax.random as jr
import numpy as np
from _tables import Line
from jaxtyping import Float, PRNGKeyArray

from r2s.estimation.default_spaces import on_cloth
from r2s.estimation.diffcloud import DiffCloud
from r2s.fabrics import prior
from r2s.fabrics.fabric import Fabric
from r2s.recordings.recording import Recording
from r2s.scenarios import lifting, synthetic
from r2s.scenarios.in_explicit_steps import explicit_cloth
from r2s.scenarios.scenario import rollout

DENSITY = 0.2  # [kg/m^2]
FINE = (33, 33)
FEW = 30_000  # substeps a second
RIDGE = 0.1  # of the variance: draws are few

Table = Float[np.ndarray, "draw parameter"]


def fitted(draw: str, shape: str) -> Line:
    """Places in the unit cube of a draw of the prior, and of the fit of a coarse sheet to its lift
    on `FINE`; `shape`: its vertices a side."""
    fabric = jax.tree.map(lambda leaf: leaf[0], prior.draws(DENSITY, 1, jr.key(int(draw))))
    recording = _lift(fabric, jr.key(int(draw)))
    space = on_cloth(DENSITY)
    method = DiffCloud(shape=(int(shape), int(shape)))
    budget = method.budget._replace(coarse=16, starts=2, iterations=20)
    found = method.estimate([recording], space, budget, key=jr.key(0))
    places = space.to_unit(fabric), space.to_unit(found.fabric)
    both = zip(space.ranges, *(np.asarray(place).tolist() for place in places), strict=True)
    return {
        f"{which}: {bound.name}": f"{place:.4f}"
        for bound, *each in both
        for which, place in zip(("true", "fit"), each, strict=True)
    }


def _lift(fabric: Fabric, key: PRNGKeyArray) -> Recording:
    """In explicit steps where they are few; what is stiffer moves alike in implicit ones."""
    experiment = lifting()
    scenario = experiment.scenario(FINE)
    solver = explicit_cloth(scenario, fabric)
    is_soft = solver.substeps / solver.dt < FEW
    motion = rollout(scenario, fabric, solver=solver) if is_soft else None
    return synthetic.record(experiment, fabric, "draw", shape=FINE, motion=motion, key=key)


def judged(lines: list[Line]) -> list[Line]:
    """For each parameter the root mean square error of its place in the range, over draws that were
    left out one by one: of the mean of the others, of the fit as it is, of a linear map of this
    parameter's fit, and of a map of all parameters' fits."""
    bounds = on_cloth(DENSITY).ranges
    true, fit = (
        np.array([[float(line[f"{which}: {bound.name}"]) for bound in bounds] for line in lines])
        for which in ("true", "fit")
    )
    guesses = {
        "mean of the others": _left_out(np.zeros((len(true), 0)), true),
        "fit": fit,
        "map of its own": np.stack(
            [_left_out(fit[:, [i]], true[:, [i]])[:, 0] for i in range(len(bounds))], axis=1
        ),
        "map of all": _left_out(fit, true),
    }
    return [
        {"parameter": bound.name, "draws": f"{len(true)}"}
        | {name: f"{np.sqrt(np.mean((g - true)[:, i] ** 2)):.3f}" for name, g in guesses.items()}
        for i, bound in enumerate(bounds)
    ]


def _left_out(seen: Table, wanted: Table) -> Table:
    """Each line of `wanted` by a ridge regression on all the other lines."""
    found = []
    for i in range(len(seen)):
        x, y = np.delete(seen, i, axis=0), np.delete(wanted, i, axis=0)
        middle, mean = x.mean(axis=0), y.mean(axis=0)
        x, y = x - middle, y - mean
        penalty = RIDGE * np.diag(np.sum(x**2, axis=0))
        slope = (
            np.linalg.solve(x.T @ x + penalty, x.T @ y) if x.shape[1] else np.zeros((0, y.shape[1]))
        )
        found.append(mean + (seen[i] - middle) @ slope)
    return np.stack(found)
