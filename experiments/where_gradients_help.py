"""Where do gradients of the cloth's loss help? Its roughness along a line, and its exact slope.

python experiments/where_gradients_help.py --fabric grey_interlock      # 5 minutes on one core

The loss of a lift is sampled along the warp stiffness, over widths [share of the range]. Printed:
its rise; the errors that its third differences look like; the exact slope at the truth less that of
a polynomial through the line. Damped by nothing: in a vacuum, in short steps.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _tables import Line, command_line, keep

import r2s
from r2s.estimation import gauss_newton

COLUMNS = "damped by", "width", "rise [mm^2]", "rough / rise", "(exact - fit) / mean slope"
loss_at = eqx.filter_jit(gauss_newton.loss_at)
normal_at = eqx.filter_jit(gauss_newton.normal_at)


def in_vacuum(scenario: r2s.Scenario, fabric: object = None) -> r2s.ImplicitCloth:
    """The cloth without air, in steps a quarter as long as the scenario's."""
    vacuum = eqx.tree_at(lambda s: s.air.density, scenario.scene, jnp.zeros((), float))
    return r2s.ImplicitCloth(vacuum, scenario.interval / (4 * scenario.substeps))


def line(problem: r2s.Problem, truth: np.ndarray, width: float, damped: str) -> Line:
    """Sample the loss [m^2] along the first parameter, and compare its slopes at the truth."""
    offsets, axis = width * np.linspace(-0.5, 0.5, 41), np.eye(len(truth))[0]
    losses = [float(loss_at((problem,), jnp.asarray(truth + o * axis, float))) for o in offsets]
    rise, rough = np.ptp(losses), np.sqrt(np.mean(np.diff(losses, 3) ** 2) / 20)
    fit = np.polynomial.Polynomial.fit(offsets, losses, 4).deriv()(0.0)
    exact = float(normal_at((problem,), jnp.asarray(truth, float)).gradient[0])
    numbers = width, 1e6 * rise, rough / rise, (exact - fit) * width / rise
    return dict(zip(COLUMNS, (damped, *map("{:.2g}".format, numbers)), strict=True))


if __name__ == "__main__":
    parser = command_line(__doc__, "results/where_gradients_help.csv")
    parser.add_argument("--fabric", default="grey_interlock", choices=r2s.presets.FIVE)
    a = parser.parse_args()
    lines, fabric = [], r2s.presets.FIVE[a.fabric]()
    lift, space = r2s.lifting(), r2s.OrthotropicSpace.make(float(fabric.density))
    for damped, factory in (("fabric and air", None), ("nothing", in_vacuum)):
        if factory is not None:
            fabric = dataclasses.replace(fabric, damping=jnp.asarray(1e-9, float))
        recording = r2s.record(lift, fabric, a.fabric, solver=factory, key=jax.random.key(0))
        problem = r2s.Problem.make(recording, space, num_points=100)
        problem = dataclasses.replace(problem, solver=factory and factory(problem.scenario))
        truth = np.pad(space.to_unit(fabric), (0, len(problem.nuisance_prior.scales)))
        lines += [line(problem, truth, width, damped) for width in (0.5, 0.05, 0.005, 5e-4)]
        keep(a.out, lines, f"The loss of a lift of {a.fabric} along the warp stiffness.")
