"""What DIFFCLOUD's parts cost: a motion, its loss, gradients, an estimate, and 64 starts.

python benchmarks/estimator_times.py            # a few minutes on one core

A lift of 60 frames, 9 x 9 vertices, clouds of 3,500 points a frame (and of 300, the estimator's own
number). Prints medians and ranges of seconds after compilation, and what that took.
"""

import argparse
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import measure

from r2s import scenarios
from r2s.estimation import gauss_newton
from r2s.estimation.descent import DEFAULT
from r2s.estimation.judgement import descend
from r2s.estimation.method import Budget
from r2s.estimation.prediction import predict
from r2s.estimation.problem import Problem
from r2s.fabrics import presets
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.scenarios import synthetic

_motion = eqx.filter_jit(predict)
_loss = eqx.filter_jit(lambda problem, unknown: gauss_newton.loss_at((problem,), unknown))
_gradient = eqx.filter_jit(jax.value_and_grad(_loss.__wrapped__, argnums=1))
_normal = eqx.filter_jit(lambda problem, unknown: gauss_newton.normal_at((problem,), unknown))
PARTS = {
    "motion": _motion,
    "loss": _loss,
    "loss and gradient, reverse": _gradient,
    "loss, gradient and Gauss-Newton matrix, forward": _normal,
}
EFFORTS = {
    "estimate, 24 places, 3 descents": DEFAULT,
    "estimate, 64 places, 3 descents": DEFAULT._replace(coarse=64),
    "estimate, 1 descent": Budget(coarse=0, starts=1),
    "estimate, 64 descents": DEFAULT._replace(coarse=64, starts=64),
}


def parts(problem: Problem, points: int, repeats: int) -> list[measure.Row]:
    """Times of one evaluation of each part."""
    unknown = jnp.full(gauss_newton.theta_length((problem,)), 0.45).at[problem.space.dim :].set(0)
    rows = []
    for name, part in PARTS.items():
        call = partial(lambda part: jax.block_until_ready(part(problem, unknown)), part)
        _, first = measure.built(call)
        row, _ = measure.timed(call, repeats, 60)
        rows.append({"part": name, "points": points, "compile": first - row["wall_s"], **row})
    return rows


def estimates(problem: Problem, points: int, all_starts: bool) -> list[measure.Row]:
    """Times of whole estimates."""
    rows = []
    for name, budget in EFFORTS.items():
        if budget.starts > 3 and not all_starts:
            continue
        call = partial(descend, problem, budget, key=jax.random.key(0))
        first = (
            float("nan") if rows else measure.built(call)[1]
        )  # the others share what it compiled
        row, _ = measure.timed(call, 1, 1)
        rows.append({"part": name, "points": points, "compile": first - row["wall_s"], **row})
    return rows


def main(repeats: int, all_starts: bool) -> None:
    fabric = presets.camel_ponte_roma()
    space = OrthotropicSpace.make(float(fabric.density))
    sensing = synthetic.sensing(scenarios.lifting())._replace(points=3500)
    recording = synthetic.record(
        scenarios.lifting(), fabric, "camel", seen=sensing, key=jax.random.key(0)
    )
    problem = Problem.make(recording, space)
    dense = Problem.make(recording, space, num_points=3500)
    rows = parts(dense, 3500, repeats) + parts(problem, 300, repeats)
    rows += estimates(problem, 300, all_starts)
    columns = {
        "part": lambda row: row["part"],
        "points": lambda row: str(row["points"]),
        "CPU s": lambda row: measure.span(row, "cpu_s"),
        "wall s": lambda row: measure.span(row, "wall_s"),
        "compilation, s": lambda row: f"{row['compile']:.0f}",
    }
    measure.show(f"a lift of 60 frames, 81 vertices: {measure.machine()}", rows, columns)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Times of an estimator's parts.")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--cores", type=int, default=2, help="how many to use")
    parser.add_argument("--all-starts", action="store_true", help="64 descents, too: half an hour")
    a = parser.parse_args()
    measure.keep_to(a.cores)
    main(a.repeats, a.all_starts)
