"""Estimate a fabric from what MuJoCo shows of it, and predict what MuJoCo shows of another motion.

python experiments/another_simulator.py      # a few minutes on one core; needs r2s[bench]

A fabric is exported to MuJoCo, where a sheet of 0.3 m falls in vacuum: one corner is carried up and
inward ("lift"), or the four corners are brought together ("drape"). From point clouds of the lift a
fabric is estimated, which predicts the drape. Printed for the exported fabric in r2s, the estimate
and the default: rms distances from MuJoCo, over all frames and vertices, over the side.
"""

import jax
import jax.numpy as jnp
import numpy as np
from _mujoco import HEIGHT, in_mujoco
from _tables import command_line, keep

import r2s
from r2s.cloth.linear.elimination import Elimination
from r2s.estimation import diffcloud
from r2s.estimation.problem import Clouds, NuisancePrior, Problem
from r2s.fabrics.parameters import MASS_DAMPING, OrthotropicSpace
from r2s.geometry.surface import sample
from r2s.world.air import Air
from r2s.world.contact import Table

SIDE, SIZE, FRAMES, INTERVAL = 0.3, 9, 45, 1 / 30  # [m], vertices, -, [s]
FABRIC = r2s.Fabric.make(0.2, (100.0, 30.0, 100.0, 35.0), 1e-5, damping=2e-4, mass_damping=3.0)
MOTIONS = {"lift": [0], "drape": [0, SIZE - 1, SIZE**2 - SIZE, SIZE**2 - 1]}  # held vertices


def scenario_of(motion: str) -> r2s.Scenario:
    """The sheet, its held vertices, and their path [m], which eases in and out within a second."""
    mesh, held = r2s.rectangle((SIDE, SIDE), (SIZE, SIZE)), MOTIONS[motion]
    start = np.pad(np.asarray(mesh.rest), ((0, 0), (0, 1)), constant_values=HEIGHT)
    way = (start[held].mean(axis=0) - start[held]) / 20 if motion == "drape" else (0.07, 0.07, 0.2)
    times = INTERVAL * np.arange(FRAMES + 1)
    eased = np.clip(times, 0, 1) ** 2 * (3 - 2 * np.clip(times, 0, 1))
    path = start[held] + eased[:, None, None] * np.asarray(way)
    scene = r2s.Scene(mesh, jnp.array(held), Table.make(-jnp.inf), Air.make(density=0.0))
    start, path, times, first = (jnp.asarray(a, float) for a in (start, path, times, INTERVAL))
    return r2s.Scenario(
        scene, Elimination.make(mesh), start, path, times, first, INTERVAL, FRAMES, 1, 4
    )


if __name__ == "__main__":
    a = command_line(__doc__, "results/another_simulator.csv").parse_args()
    scenarios = {motion: scenario_of(motion) for motion in MOTIONS}
    shown = {motion: in_mujoco(scenario, FABRIC) for motion, scenario in scenarios.items()}
    faces, x = scenarios["lift"].scene.mesh.faces, jnp.asarray(shown["lift"], float)
    points = jax.vmap(lambda x: sample(x, faces, 2))(x)
    points += 1e-3 * jax.random.normal(jax.random.key(0), points.shape, float)
    clouds = Clouds(points, jnp.ones(points.shape[:2], bool))
    space = OrthotropicSpace.make(0.2, mass_damping=MASS_DAMPING)
    prior = NuisancePrior(0.0, 0.0)  # the camera's pose is known
    problem = Problem(scenarios["lift"], space, tuple(range(FRAMES)), clouds, nuisance_prior=prior)
    found = diffcloud.estimate(problem, key=jax.random.key(1))
    fabrics = {"exported": FABRIC, "estimate": found.fabric, "default": space.middle()}
    lines = []
    for name, fabric in fabrics.items():
        lines.append({"fabric": name})
        for motion, scenario in scenarios.items():
            away = np.asarray(r2s.rollout(scenario, fabric).x) - shown[motion]
            lines[-1] |= {motion: f"{np.sqrt((away**2).sum(axis=-1).mean()) / SIDE:.2%}"}
    keep(a.out, lines, "rms distance from MuJoCo over the side; estimated from the lift")
