"""Thirty recordings of known sheets, and what an estimate from each of them comes to.

Most sheets are stiff in bending, so that the meshes of estimates resolve them. None is more than
two and a half standard deviations from the prior mean of its weight: beyond that, intervals of what
a recording does not determine would miss it whatever the search does.
"""

import dataclasses
import math
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from _tables import Line
from scipy.stats import norm

from r2s import scenarios
from r2s.estimation.consistency import fits
from r2s.estimation.default_spaces import identified_law, on_cloth, with_law
from r2s.estimation.estimate import Estimate
from r2s.estimation.gauss_newton import loss_from
from r2s.estimation.mesh_refinement import in_mesh_steps
from r2s.estimation.methods import DiffCloud
from r2s.estimation.normal_equations import marker_distances, point_distances
from r2s.estimation.prediction import Prediction, free_nuisances, predictions_at, theta_length
from r2s.estimation.problem import Problem
from r2s.materials import presets, prior
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace
from r2s.materials.stiffening import SofteningPlate, StiffeningMembrane
from r2s.recordings.recording import Recording, load, save
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import Scenario, rollout
from r2s.study.mujoco import Material, as_plate, moved

NOISE = 1e-3  # [m], of the clouds
STRICT = 3e-3  # [m], of a loss in which what lies farther off hardly counts
STEP = 1 / 180  # [s], of truths in implicit steps on fine meshes


class Case(NamedTuple):
    """A recording of a known sheet.

    - `scenario`, `motion`: one of `r2s.scenarios.SCENARIOS`, and its numbers.
    - `fabric`: its numbers at small strain.
    - `shape`, `elements`: of the mesh that moved; `simulator`: "implicit", "stiffening" (explicit
      steps, laws that change with the strain) or "mujoco" (of `material`).
    - `outliers`: share of the points. `size` [m].
    """

    scenario: str
    fabric: Fabric
    shape: tuple[int, int]
    elements: str = "wrinkling"
    simulator: str = "implicit"
    material: Material | None = None
    motion: tuple[tuple[str, float], ...] = ()
    outliers: float = 0.0
    size: tuple[float, float] = (0.45, 0.45)


def _stiff(
    density: float, yarns: tuple[float, float], shear: float, bending: float, friction: float
):
    """A fabric from its uniaxial stiffness, with a coupling of 0.2 and a damping of 6 ms."""
    coupling = 0.2
    c11, c22 = (stiffness / (1 - coupling**2) for stiffness in yarns)
    stiffness = c11, coupling * (c11 * c22) ** 0.5, c22, shear
    return Fabric.make(density, stiffness, bending, damping=6e-3, friction=friction, thickness=1e-3)


def _with_losses(name: str, damping: float, friction: float) -> Fabric:
    losses = {"damping": damping, "friction": friction}
    return dataclasses.replace(
        presets.MEASURED[name](), **{k: jnp.asarray(v, float) for k, v in losses.items()}
    )


DENIM, PINK = _with_losses("black_denim", 6e-3, 0.45), _with_losses("pink_solid", 4e-3, 0.55)
TROUSERS = _with_losses("royal_target", 8e-3, 0.35)
LINEN = _stiff(0.2, (400.0, 300.0), 40.0, 1.5e-5, 0.4)
CANVAS = _stiff(0.3, (900.0, 700.0), 60.0, 1.2e-4, 0.6)
TARPAULIN = _stiff(0.4, (500.0, 800.0), 80.0, 2e-4, 0.3)
FAST, LOW, FAR = (("moving", 1.6),), (("height", 0.2),), (("height", 0.4), ("inward", 0.05))


def _of_mujoco(
    young_thickness: float, bending: float, density: float, friction: float, shape, size, motion=()
) -> Case:
    """A lift of MuJoCo's flex from what r2s calls its stiffness [N/m] and bending [N m]."""
    poisson = 0.3
    stiff = young_thickness / (1 - poisson**2)
    thickness = (12 * bending / stiff) ** 0.5
    material = Material(
        young_thickness / thickness, poisson, thickness, 4e-3, density, 1e-3, friction
    )
    return Case(
        "lifting",
        as_plate(material),
        shape,
        simulator="mujoco",
        material=material,
        motion=motion,
        size=size,
    )


CASES: dict[str, Case] = {
    # lifts on the meshes that estimates go to
    "lift same denim": Case("lifting", DENIM, (17, 17)),
    "lift same linen": Case("lifting", LINEN, (17, 17), motion=FAST, outliers=0.01),
    "lift same trousers": Case("lifting", TROUSERS, (17, 17), motion=FAR),
    "lift same canvas": Case("lifting", CANVAS, (17, 17), motion=LOW),
    # on finer ones
    "lift finer denim": Case("lifting", DENIM, (33, 33), motion=LOW),
    "lift finer linen": Case("lifting", LINEN, (33, 33), motion=FAR),
    "lift finer trousers": Case("lifting", TROUSERS, (33, 33), outliers=0.01),
    "lift finer canvas": Case("lifting", CANVAS, (25, 25)),
    # of other elements
    "lift alternating linen": Case("lifting", LINEN, (25, 25), "alternating"),
    "lift falling trousers": Case("lifting", TROUSERS, (25, 25), "falling", motion=LOW),
    "lift rising canvas": Case("lifting", CANVAS, (25, 25), "rising", motion=FAST),
    "lift quadrilaterals tarpaulin": Case("lifting", TARPAULIN, (25, 25), "quadrilaterals"),
    # whose laws change with the strain
    "lift stiffening linen": Case("lifting", LINEN, (25, 25), simulator="stiffening"),
    "lift stiffening trousers": Case(
        "lifting", TROUSERS, (25, 25), simulator="stiffening", motion=FAST, outliers=0.01
    ),
    "lift stiffening canvas": Case("lifting", CANVAS, (25, 25), simulator="stiffening", motion=FAR),
    # of MuJoCo
    "lift mujoco 1": _of_mujoco(300.0, 6.2e-5, 0.3, 0.5, (19, 25), (0.45, 0.6), FAST),
    "lift mujoco 2": _of_mujoco(300.0, 6.2e-5, 0.3, 0.5, (25, 33), (0.45, 0.6), FAR),
    "lift mujoco 3": _of_mujoco(200.0, 7e-5, 0.2, 0.4, (25, 25), (0.45, 0.45)),
    "lift mujoco 4": _of_mujoco(400.0, 1.2e-4, 0.25, 0.6, (33, 33), (0.45, 0.45), LOW),
    "lift mujoco 5": _of_mujoco(300.0, 7e-5, 0.2, 0.3, (33, 33), (0.45, 0.45), FAST),
    "lift mujoco 6": _of_mujoco(150.0, 1.2e-4, 0.35, 0.45, (25, 33), (0.45, 0.6)),
    # winds
    "wind same canvas": Case("wind", CANVAS, (17, 17)),
    "wind same tarpaulin": Case("wind", TARPAULIN, (17, 17), motion=(("speed", 3.2),)),
    "wind finer canvas": Case("wind", CANVAS, (25, 25), motion=(("aside", 15.0),)),
    "wind finer tarpaulin": Case("wind", TARPAULIN, (25, 25), outliers=0.01),
    "wind quadrilaterals canvas": Case("wind", CANVAS, (25, 25), "quadrilaterals"),
    # pulls
    "pull same pink": Case("stretching", PINK, (17, 17)),
    "pull finer denim": Case("stretching", DENIM, (33, 33), motion=(("strain", 0.03),)),
    "pull finer linen": Case("stretching", LINEN, (25, 25)),
    "pull finer canvas": Case("stretching", CANVAS, (25, 25), motion=(("strain", 0.02),)),
}


def recorded(name: str, folder: Path) -> Recording:
    """The recording of a case, made where the folder does not have it."""
    file = folder / f"{name.replace(' ', '_')}.npz"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        save(_made(name), file)
    return load(file)


def _made(name: str) -> Recording:
    case, key = CASES[name], jr.fold_in(jr.key(66), list(CASES).index(name))
    experiment = scenarios.SCENARIOS[case.scenario](case.size, **dict(case.motion))
    sensing = synthetic.sensing(experiment)._replace(noise=NOISE, outliers=case.outliers)
    if not case.outliers:  # the sheet differs from the table by its colour
        sensing = sensing._replace(margin=-math.inf)
    fabric, scenario = case.fabric, experiment.scenario(case.shape, elements=case.elements)
    if case.simulator == "stiffening":
        fabric = dataclasses.replace(
            fabric,
            membrane=StiffeningMembrane.make(fabric.membrane, 2.0, 1.1),
            bending=SofteningPlate(fabric.bending, jnp.asarray(0.35), jnp.asarray(20.0)),
        )
    if case.scenario == "stretching":
        recording = synthetic.record(
            experiment, fabric, name, seen=sensing, shape=case.shape, max_step=STEP, key=key
        )
    else:
        x = _moved(scenario, fabric, case)
        recording = synthetic.seen_of(x, experiment, scenario, name, 1, sensing, key=key)
    return dataclasses.replace(recording, info=dataclasses.replace(recording.info, name=name))


def _moved(scenario: Scenario, fabric: Fabric, case: Case) -> jax.Array:
    if case.material is not None:
        return jnp.asarray(moved(scenario, case.material), float)
    if case.simulator == "stiffening":
        motion = rollout(scenario, fabric, solver=scenarios.explicit_cloth(scenario, fabric))
    else:
        is_same = max(case.shape) <= 17 and case.elements == "wrinkling"
        motion = rollout(scenario, fabric, max_step=None if is_same else STEP)
    if not np.asarray(motion.ok).all():
        raise RuntimeError(f"the simulation {motion.explain()}")
    return motion.x


def arrived(folder: Path, case: str, seed: str) -> Line:
    """The line of a table: what an estimate comes to, beside the true numbers and the prior mean.

    `seed`: of the places where the search begins.
    """
    recording, truth = recorded(case, folder), CASES[case].fabric
    density = float(truth.density)
    space = prior.informed(with_law(on_cloth(density), identified_law([recording])), density)
    began = time.process_time()
    estimate = DiffCloud().estimate([recording], space, key=jr.key(int(seed)))
    seconds = time.process_time() - began
    assert estimate.shape is not None
    problem = problem_of(recording, space, estimate.shape)
    ends = {
        "end": end_of(problem, estimate),
        "true": place_of(problem, space.to_unit(truth)),
        "prior": place_of(problem, space.prior()[0]),
    }
    line: Line = {"mesh": "{} x {}".format(*estimate.shape)}
    for name, theta in ends.items():
        predictions = predictions_at((problem,), theta)
        beyond = fits((problem,), predictions, STRICT)[0].outliers
        line[f"loss of {name}"] = f"{1e6 * loss_from((problem,), predictions):.3f}"
        line[f"mm of {name}"] = f"{1e3 * away(problem, predictions[0]):.2f}"
        line[f"% beyond 3 mm of {name}"] = f"{100 * beyond:.1f}"
    return (
        line
        | in_errors(space, truth, estimate)
        | {
            "outliers": f"{100 * max((fit.outliers for fit in estimate.fits), default=0.0):.1f} %",
            "converged": "yes" if estimate.converged else "no",
            "CPU s": f"{seconds:.0f}",
        }
    )


def problem_of(recording: Recording, space: ParameterSpace, shape: tuple[int, int]) -> Problem:
    """The problem of a recording on a mesh, in the steps of an estimate."""
    problem = Problem.make(recording, space, shape=shape)
    scenario = in_mesh_steps(problem.scenario, recording.info.scenario, shape)
    return dataclasses.replace(problem, scenario=scenario)


def place_of(problem: Problem, unit: jax.Array) -> jax.Array:
    """A theta without nuisances."""
    inside = jnp.clip(unit, 1e-3, 1 - 1e-3)
    return jnp.zeros(theta_length((problem,)), float).at[: problem.space.dim].set(inside)


def end_of(problem: Problem, estimate: Estimate) -> jax.Array:
    """The theta of an estimate, with its nuisances."""
    units = [
        bound.to_unit(jnp.asarray(value, float))
        for bound, value in zip(estimate.ranges, estimate.values, strict=True)
    ]
    theta = place_of(problem, jnp.stack(units))
    for free, nuisance in zip(free_nuisances((problem,)), estimate.nuisances, strict=True):
        value = np.log(nuisance.value) if nuisance.name.endswith(" ratio") else nuisance.value
        theta = theta.at[free.place].set(value / free.scale)
    return theta


def away(problem: Problem, prediction: Prediction) -> float:
    """Mean distance [m] of points or markers from the sheet."""
    distance, mask = marker_distances(problem, prediction) or point_distances(problem, prediction)
    return float(np.asarray(distance)[np.asarray(mask)].mean())


def in_errors(space: ParameterSpace, truth: Fabric, estimate: Estimate) -> Line:
    """How far each number is from the truth, in standard errors, with these in brackets."""
    true = np.asarray(space.values(space.to_unit(truth)))
    rows = zip(estimate.ranges, estimate.values, true, estimate.standard_errors, strict=True)
    line, inside = {}, []
    for bound, value, true_value, error in rows:
        off = np.log(value / true_value) if bound.log else value - true_value
        line[bound.name] = f"{off / error:+.2f} ({error:.3g})"
        inside.append(abs(off / error) < norm.ppf(0.95))
    return line | {"held": f"{sum(inside)} of {len(inside)}"}
