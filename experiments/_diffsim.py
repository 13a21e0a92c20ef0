"""What fabrics, estimated or not, predict of runs of DiffSim."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Float

from r2s.estimation import default_spaces
from r2s.estimation.estimate import Estimate
from r2s.estimation.judgement import descend
from r2s.estimation.problem import NuisancePrior, Problem
from r2s.evaluation.horizon import floor_of, horizon_of, skill, within
from r2s.evaluation.surface_distance import POINTS, to_surface
from r2s.fabrics import prior
from r2s.fabrics.arcsim import read_material
from r2s.fabrics.fabric import Fabric
from r2s.files import write_json
from r2s.geometry.surface import sample
from r2s.scenarios.scenario import Scenario, rollout
from r2s.study.diffsim_runs import FRAME, Made, read, sampled, scenario_of, truth
from r2s.study.ensembles import PATH, STIFFNESS

FABRICS = ("camel", "denim")
MOTIONS = {"lift": "lift1_{}_9_dt{}", "wind": "hang2wind_{}_9_dt{}"}
STEP, COARSE = 10, 40  # [ms], of the runs that are judged by, and of others
FRAMES, SEEN = 60, 10  # frames of a run, and of them those that an estimate is made from
DRAWS = 8
CLOUD = 2000  # points of a frame that an estimate sees
RESOLUTION = 3  # samples a side of each face that are judged by

_rollout = eqx.filter_jit(rollout)


class Judged(NamedTuple):
    """A run that is judged by.

    - `made`: the run. `points`: of its sheet, in each frame, [m].
    - `times`: of the frames, [s]. `causes`: see `floor_of`. `apart`: see `horizon_of`.
    """

    made: Made
    points: list[np.ndarray]
    times: Float[np.ndarray, " frame"]
    causes: dict[str, Float[np.ndarray, "member frame"]]
    apart: Float[np.ndarray, "other frame"]

    @property
    def floor(self) -> Float[np.ndarray, " frame"]:
        return floor_of(self.causes)

    @property
    def horizon(self) -> float:
        return horizon_of(self.times, self.floor, self.apart)

    @property
    def inside(self) -> np.ndarray:
        return within(self.times, self.horizon)

    def away(self, x: Float[np.ndarray, "frame vertex 3"]) -> Float[np.ndarray, " frame"]:
        """Distances [m] of the run's points from a sheet."""
        return to_surface(self.points, x, self.made.mesh.faces)


def run_of(folder: Path, motion: str, fabric: str, step: int = STEP) -> Made:
    """The run of a fabric in steps of so many [ms]."""
    return read(folder, MOTIONS[motion].format(fabric, step))


def table_fabric(made: Made, scratch: Path) -> Fabric:
    """The fabric of a run on the laws of r2s: its tables, with the damping of its steps."""
    path = scratch / f"{made.told['name']}.json"
    write_json(path, made.told["material_json"])
    return read_material(path, diffsim=True, damping=STEP / 1000, friction=0.0)


def moved(scenario: Scenario, fabric: Fabric) -> Float[np.ndarray, "frame vertex 3"]:
    """A motion [m]; NaN from where it diverged."""
    found = _rollout(scenario, fabric)
    ok = np.logical_and.accumulate(np.asarray(found.ok))[:, None, None]
    return np.where(ok, np.asarray(found.x, np.float64), np.nan)


def judged(folder: Path, motion: str, fabric: str, scratch: Path) -> Judged:
    """A run with its floor: what a tenth of a per cent of stiffness and a fifth of a millimetre of
    path change in the cloth of r2s, and a third of what DiffSim's steps of 40 ms differ by from its
    steps of 10 ms, whose error is of first order."""
    made = run_of(folder, motion, fabric)
    points = _points(truth(made, count=FRAMES), made)
    empty = Judged(made, points, FRAME * np.arange(1, FRAMES + 1), {}, np.zeros((0, FRAMES)))
    scenario, own = scenario_of(made, count=FRAMES), table_fabric(made, scratch)
    here = moved(scenario, own)
    around = empty._replace(points=_points(here, made))
    path = scenario.path.at[:, 0, 0].add(PATH).at[:, -1, 1].add(-PATH)
    causes = {
        "stiffness": around.away(moved(scenario, _scaled(own, 1 + STIFFNESS))),
        "path": around.away(moved(dataclasses.replace(scenario, path=path), own)),
        "step": empty.away(truth(run_of(folder, motion, fabric, COARSE), count=FRAMES)) / 3,
    }
    others = [name for name in FABRICS if name != fabric]
    apart = [empty.away(truth(run_of(folder, motion, name), count=FRAMES)) for name in others]
    causes = {name: each[None] for name, each in causes.items()}
    return empty._replace(causes=causes, apart=np.stack(apart))


def estimate(folder: Path, motion: str, fabric: str) -> Estimate:
    """The fabric from clouds of the first `SEEN` frames of a run, its density known."""
    made = run_of(folder, motion, fabric)
    density = made.told["material_json"]["density"]
    clouds = sampled(truth(made, count=SEEN), made.mesh, CLOUD, jr.key(0))
    problem = Problem(
        scenario_of(made, count=SEEN),
        default_spaces.on_cloth(density),
        tuple(range(SEEN)),
        clouds,
        nuisance_prior=NuisancePrior(0.0, 0.0),
    )
    return descend(problem, key=jr.key(1))


def line(
    folder: Path, motion: str, fabric: str, estimates: dict[str, Fabric], scratch: Path
) -> dict[str, str]:
    """Of a run: floor and horizon, and the errors of the true fabric, draws and estimates."""
    run = judged(folder, motion, fabric, scratch)
    scenario, inside = scenario_of(run.made, count=FRAMES), run.inside
    density = run.made.told["material_json"]["density"]
    draws = prior.draws(density, DRAWS, jr.key(0))
    drawn = [jax.tree.map(lambda leaf, k=k: leaf[k], draws) for k in range(DRAWS)]

    def error(fabric: Fabric) -> float:
        return float(np.mean(run.away(moved(scenario, fabric))[inside]))

    floor, default = float(np.mean(run.floor[inside])), [error(each) for each in drawn]
    fabrics = {"true fabric": table_fabric(run.made, scratch)} | estimates
    errors = {name: error(each) for name, each in fabrics.items()}
    skills = {name: skill(each, float(np.mean(default)), floor) for name, each in errors.items()}
    of_causes = {f"floor: {name}": each[0, inside] for name, each in run.causes.items()}
    return {
        "horizon [s]": "never" if np.isinf(run.horizon) else f"{run.horizon:.2f}",
        "between fabrics": _millimetres(float(np.sqrt(np.mean(run.apart**2)))),
        **{name: _millimetres(float(np.mean(each))) for name, each in of_causes.items()},
        "floor": _millimetres(floor),
        **{name: _millimetres(each) for name, each in errors.items()},
        "default": f"{1e3 * np.mean(default):.1f} "
        f"({1e3 * min(default):.1f} to {1e3 * max(default):.1f})",
        **{f"skill: {name}": _skill(each) for name, each in skills.items()},
    }


def _points(x: Float[np.ndarray, "frame vertex 3"], made: Made) -> list[np.ndarray]:
    """The same places of the sheet in all frames [m]; as many as are compared."""
    found = jax.vmap(lambda frame: sample(frame, made.mesh.faces, RESOLUTION))(jnp.asarray(x))
    chosen = np.random.default_rng(0).permutation(found.shape[1])[:POINTS]
    return list(np.asarray(found)[:, chosen])


def _scaled(fabric: Fabric, factor: float) -> Fabric:
    def where(f: Fabric) -> list:
        return [f.membrane.stiffness, f.bending.stiffness]

    return eqx.tree_at(where, fabric, [factor * each for each in where(fabric)])


def _millimetres(value: float) -> str:
    return f"{1e3 * value:.1f}"


def _skill(value: float) -> str:
    return "not told" if np.isnan(value) else f"{value:.2f}"
