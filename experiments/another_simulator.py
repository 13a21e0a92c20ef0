"""Estimate a fabric from what MuJoCo shows of it, and predict what MuJoCo shows of another motion.

python experiments/another_simulator.py      # a few minutes on one core; needs r2s[bench]

A fabric is exported to MuJoCo, where a sheet of 0.3 m falls in vacuum: one corner is carried up and
inward ("lift"), or the four corners are brought together ("drape"). From point clouds of the lift a
fabric is estimated, which predicts the drape. Printed for the exported fabric in r2s, the estimate
and the default: rms distances from MuJoCo, over all frames and vertices, over the side.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _mujoco import FRAMES, MOTIONS, SIDE, in_mujoco, scenario_of
from _tables import Line, command_line, keep

import r2s
from r2s.estimation.judgement import descend
from r2s.estimation.problem import Clouds, NuisancePrior, Problem
from r2s.fabrics.parameters import MASS_DAMPING, OrthotropicSpace
from r2s.geometry.surface import sample

FABRIC = r2s.Fabric.make(0.2, (100.0, 30.0, 100.0, 35.0), 1e-5, damping=2e-4, mass_damping=3.0)
NOISE = 1e-3  # [m], of the clouds
rollout = eqx.filter_jit(r2s.rollout)


def clouds_of(x: np.ndarray, scenario: r2s.Scenario) -> Clouds:
    """Noisy points of the sheet in every frame."""
    faces = scenario.scene.mesh.faces
    points = jax.vmap(lambda frame: sample(frame, faces, 2))(jnp.asarray(x, float))
    points = points + NOISE * jax.random.normal(jax.random.key(0), points.shape, float)
    return Clouds(points, jnp.ones(points.shape[:2], bool))


if __name__ == "__main__":
    a = command_line(__doc__, "results/another_simulator.csv").parse_args()
    scenarios = {motion: scenario_of(motion) for motion in MOTIONS}
    shown = {motion: in_mujoco(scenario, FABRIC) for motion, scenario in scenarios.items()}
    lift = scenarios["lift"]
    space = OrthotropicSpace.make(0.2, mass_damping=MASS_DAMPING)
    seen, exact = clouds_of(shown["lift"], lift), NuisancePrior(0.0, 0.0)
    problem = Problem(lift, space, tuple(range(FRAMES)), seen, nuisance_prior=exact)
    found = descend(problem, key=jax.random.key(1))
    fabrics = {"exported": FABRIC, "estimate": found.fabric, "default": space.middle()}
    lines: list[Line] = []
    for name, fabric in fabrics.items():
        lines.append({"fabric": name})
        for motion, scenario in scenarios.items():
            away = np.asarray(rollout(scenario, fabric).x) - shown[motion]
            lines[-1][motion] = f"{np.sqrt((away**2).sum(axis=-1).mean()) / SIDE:.2%}"
    keep(a.out, lines, "Rms distance from MuJoCo over the side; estimated from the lift.")
