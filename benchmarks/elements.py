"""What a Newton step costs with each kind of elements, beside falling triangles, in one run.

python benchmarks/elements.py                            # 5 minutes
python benchmarks/elements.py --sizes 9 --repeats 50

The state is two seconds into a lift of grey interlock, with the wrinkles that it has then. A Newton
step is a Hessian, its factors, a solution and one evaluation of potential and force; the kinds take
turns. Then the whole lift: CPU seconds of a run, and of its compilation.
"""

import argparse
import time
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import measure
import numpy as np

import r2s
from r2s import scenarios
from r2s.cloth.linear.system import apply_inverse, prepare
from r2s.cloth.potential import hessian, potential
from r2s.fabrics import presets
from r2s.geometry.mesh import ELEMENTS
from r2s.scenarios.scenario import rollout
from r2s.world.scene import Control

FRAMES, LATE, STEP = 46, 30, 1 / 60  # of 1/15 s; which the state is of; [s]
INTERVAL = 1 / 15  # [s]
TRIANGLES = "falling"
COLUMNS = ("evaluation", "newton step", "lift", "compile")


def evaluation(step, x):
    """Potential [J] and force [N]."""
    return jax.value_and_grad(potential, argnums=1)(step, x)


def newton_step(step, x):
    """The change [m] of one step of the convex stand-in, and the potential after it."""
    free = jnp.ones(len(x), bool)
    _, force = evaluation(step, x)
    system = prepare(step.elimination, hessian(step, x, 0.0), None, free)
    change = -apply_inverse(step.elimination, system, force)
    return change


def prepared(elements: str, size: int):
    """The calls that are timed, and a row with what a run and its compilation take."""
    scenario = scenarios.lifting(num_frames=FRAMES).scenario((size, size), elements=elements)
    fabric = presets.grey_interlock()
    began = time.process_time()
    run = eqx.filter_jit(rollout).lower(scenario, fabric, STEP).compile()
    row: measure.Row = {"elements": elements, "size": size}
    row["compile"] = time.process_time() - began
    began = time.process_time()
    x = jnp.asarray(np.asarray(run(scenario, fabric, STEP).x))
    row["lift"] = time.process_time() - began
    cloth = r2s.Cloth.make(scenario.scene, STEP)
    state = cloth.init(x[LATE], (x[LATE] - x[LATE - 1]) / INTERVAL)
    control = Control(x[LATE][scenario.scene.held], jnp.zeros(3))
    step = cloth.potential(fabric, state, control)
    calls = {
        name: eqx.filter_jit(function).lower(step, x[LATE]).compile()
        for name, function in (("evaluation", evaluation), ("newton step", newton_step))
    }
    timed = {name: (lambda call=call: call(step, x[LATE])) for name, call in calls.items()}
    return row, timed


def _beside(name: str, least: measure.Row, row: measure.Row) -> str:
    return f"{row[name]:.3g} ({row[name] / least[name]:.2f} x)"


def main(options: argparse.Namespace) -> None:
    print(", ".join(f"{name}: {value}" for name, value in measure.machine().items()))
    for size in options.sizes:
        kinds = {elements: prepared(elements, size) for elements in options.elements}
        for name in ("evaluation", "newton step"):
            times = measure.in_turn([calls[name] for _, calls in kinds.values()], options.repeats)
            for (row, _), seconds in zip(kinds.values(), times, strict=True):
                row[name] = seconds
        rows = [row for row, _ in kinds.values()]
        least = kinds[TRIANGLES][0] if TRIANGLES in kinds else rows[0]
        columns = {"elements": lambda row: row["elements"]}
        columns |= {f"{name} s": partial(_beside, name, least) for name in COLUMNS}
        measure.show(f"{size} vertices a side", rows, columns)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Time Newton steps by their elements.")
    parser.add_argument("--elements", nargs="+", choices=ELEMENTS, default=list(ELEMENTS))
    parser.add_argument("--sizes", nargs="+", type=int, default=[9, 17, 33])
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--cores", type=int, default=1, help="to run on; 0: all")
    chosen = parser.parse_args()
    measure.keep_to(chosen.cores)
    main(chosen)
