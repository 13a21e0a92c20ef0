"""What do explicit steps of the cloth differ by from implicit ones? By scenario and fabric.

python experiments/explicit_difference.py                 # 9 x 9: half an hour on one core
python experiments/explicit_difference.py --sizes 17      # some hours

Distances [mm], rms over the vertices and mean over the frames that count, and in the last of them:

- "explicit": between explicit steps and implicit ones of 1/960 s.
- "no relaxation": the same with plain Kelvin-Voigt damping (9 x 9 alone: many substeps).
- "lightly damped": the same with a membrane that is damped for 0.1 ms.
- "half a substep": of explicit steps from those of half the length.
- "1/480 s", "scenario's step": of implicit steps from those of 1/960 s.
- "0.1 % stiffer": of implicit steps of 1/960 s, with a membrane 1.001 times as stiff. Where that is
  large a motion is chaotic, and no two solvers agree.

"substeps" are those of explicit steps in a second.
"""

import dataclasses
import itertools

import equinox as eqx
import jax
import numpy as np
from _tables import Line, command_line, resumed

from r2s import scenarios
from r2s.cloth.explicit import ExplicitCloth
from r2s.fabrics import presets
from r2s.fabrics.fabric import Fabric
from r2s.scenarios.scenario import rollout

FINE, COARSE = 1 / 960, 1 / 480  # [s], of implicit steps
STIFFER = 1.001
LIGHT = 1e-4  # [s]
run = eqx.filter_jit(rollout)


def distance(x: np.ndarray, y: np.ndarray) -> str:
    """The distance [mm] of two motions (frame, vertex, 3): its mean, and in the last frame."""
    each = 1e3 * np.sqrt(((x - y) ** 2).sum(axis=2).mean(axis=1))
    return f"{each.mean():.2f} / {each[-1]:.2f}"


def compared(scenario: str, fabric: str, vertices: str) -> Line:
    """One line of the table."""
    experiment, of, side = scenarios.SIX[scenario](), presets.FIVE[fabric](), int(vertices)
    setting = experiment.scenario((side, side))
    solver = scenarios.explicit_cloth(setting, of)
    first, last = experiment.frames_used

    def motion(fabric: Fabric, max_step: float | None = None, solver: ExplicitCloth | None = None):
        found = run(setting, fabric, max_step, solver)
        return np.asarray(found.x)[first : last + 1]

    fine, explicit = motion(of, FINE), motion(of, solver=solver)
    stiffer = dataclasses.replace(of, membrane=jax.tree.map(lambda c: STIFFER * c, of.membrane))
    lightly = scenarios.explicit_cloth(setting, of, membrane_damping=LIGHT)
    halved = dataclasses.replace(solver, substeps=2 * solver.substeps)
    line = {
        "substeps": f"{solver.substeps / solver.dt:.0f}",
        "explicit": distance(explicit, fine),
        "no relaxation": "",
        "lightly damped": distance(motion(of, solver=lightly), fine),
        "half a substep": distance(explicit, motion(of, solver=halved)),
        "1/480 s": distance(motion(of, COARSE), fine),
        "scenario's step": distance(motion(of), fine),
        "0.1 % stiffer": distance(motion(stiffer, FINE), fine),
    }
    if side <= 9:
        plain = scenarios.explicit_cloth(setting, of, relaxation=0.0)
        line["no relaxation"] = distance(motion(of, solver=plain), fine)
    return line


if __name__ == "__main__":
    parser = command_line(__doc__, "results/explicit_difference.csv")
    parser.add_argument("--sizes", nargs="*", type=int, default=[9])
    parser.add_argument("--only", nargs="*", default=list(scenarios.SIX), choices=scenarios.SIX)
    a = parser.parse_args()
    chosen = itertools.product(a.sizes, a.only, presets.FIVE)
    jobs = [{"scenario": name, "fabric": of, "vertices": f"{n}"} for n, name, of in chosen]
    resumed(
        a.out, "Distance [mm] of explicit from implicit steps: mean / at the end.", jobs, compared
    )
