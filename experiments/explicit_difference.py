"""What do explicit steps of the cloth differ by from implicit ones? By scenario and fabric.

python experiments/explicit_difference.py      # half an hour on one core

Distances [mm], rms over the vertices: mean over the frames that count / in the last of them, from
implicit steps of 1/960 s; `docs/solvers.md` says which. "substeps" are those of a second.
"""

import dataclasses
import itertools

import equinox as eqx
import jax
import numpy as np
from _tables import Line, command_line, resumed

from r2s import presets, rollout, scenarios

run = eqx.filter_jit(rollout)


def distance(x: np.ndarray, y: np.ndarray) -> str:
    """The distance [mm] of two motions (frame, vertex, 3): its mean, and in the last frame."""
    each = 1e3 * np.sqrt(((x - y) ** 2).sum(axis=2).mean(axis=1))
    return f"{each.mean():.2f} / {each[-1]:.2f}"


def compared(scenario: str, fabric: str, vertices: str) -> Line:
    """One line of the table."""
    experiment, of, side = scenarios.SIX[scenario](), presets.FIVE[fabric](), int(vertices)
    setting, (first, last) = experiment.scenario((side, side)), experiment.frames_used
    solver = scenarios.explicit_cloth(setting, of)
    plain = scenarios.explicit_cloth(setting, of, relaxation=0.0)
    light = scenarios.explicit_cloth(setting, of, membrane_damping=1e-4)
    stiffer = dataclasses.replace(of, membrane=jax.tree.map(lambda c: 1.001 * c, of.membrane))
    halved = dataclasses.replace(solver, substeps=2 * solver.substeps)

    def motion(fabric=of, max_step=None, solver=None) -> np.ndarray:
        return np.asarray(run(setting, fabric, max_step, solver).x)[first : last + 1]

    fine, explicit = motion(max_step=1 / 960), motion(solver=solver)
    return {
        "substeps": f"{solver.substeps / solver.dt:.0f}",
        "explicit": distance(explicit, fine),
        "no relaxation": distance(motion(solver=plain), fine),
        "lightly damped": distance(motion(solver=light), fine),
        "half a substep": distance(explicit, motion(solver=halved)),
        "1/480 s": distance(motion(max_step=1 / 480), fine),
        "scenario's step": distance(motion(), fine),
        "0.1 % stiffer": distance(motion(stiffer, 1 / 960), fine),
    }


if __name__ == "__main__":
    parser = command_line(__doc__, "results/explicit_difference.csv")
    parser.add_argument("--sizes", nargs="*", type=int, default=[9])
    a = parser.parse_args()
    every = itertools.product(scenarios.SIX, presets.FIVE, map(str, a.sizes))
    jobs = [{"scenario": name, "fabric": of, "vertices": n} for name, of, n in every]
    resumed(a.out, "Distance [mm] of explicit from implicit steps: mean / end.", jobs, compared)
