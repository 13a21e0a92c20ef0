"""Short lifts of known fabrics, the problems of their estimates, and a quadratic loss."""

import functools
from typing import Any

import jax.numpy as jnp
import jax.random as jr
import numpy as np

from r2s import scenarios
from r2s.estimation.gauss_newton import Descent, Normal
from r2s.estimation.method import Budget
from r2s.estimation.problem import NuisancePrior, Problem
from r2s.materials import presets
from r2s.materials.parameters import IsotropicSpace, OrthotropicSpace
from r2s.recordings.recording import Recording
from r2s.scenarios import synthetic

FABRIC = presets.grey_interlock()
FAMILY = OrthotropicSpace.make(float(FABRIC.density))
EXACT = NuisancePrior(0.0, 0.0)
SMALL = Budget(num_samples=2, num_starts=1, max_iterations=4, num_probes=0)
SPACE = IsotropicSpace.make(float(presets.grey_interlock().density))
PLACE = jnp.array([0.5, 0.5])


@functools.cache
def short_lift(num_frames: int = 4) -> Recording:
    """Of a sheet of few vertices, seen by cameras; the second half of the frames counts."""
    experiment = scenarios.lifting(num_frames=num_frames, interval=1 / 10, height=0.2, moving=0.3)
    return synthetic.record(experiment, FABRIC, "grey", shape=(4, 4), key=jr.key(1))


def short_problem(num_frames: int = 4) -> Problem:
    """That of `short_lift`, with the usual nuisances."""
    return Problem.make(short_lift(num_frames), FAMILY, num_points=60, shape=(4, 4))


def lift_of(stiffer: float = 1.0):
    """A recorded lift of a fabric that is stiffer than that at `PLACE`, without noise."""
    motion: dict[str, Any] = {"height": 0.2, "inward": 0.1, "moving": 0.4}
    experiment = scenarios.lifting(num_frames=6, interval=1 / 10, **motion)
    fabric = SPACE(PLACE.at[0].add(np.log(stiffer) / SPACE.ranges[0].width))
    seen = synthetic.WHOLE._replace(points=300)
    return synthetic.record(experiment, fabric, "knit", seen=seen, shape=(5, 5), key=jr.key(0))


def problem(stiffer: float, shape=(5, 5)) -> Problem:
    """That of `lift_of`, without nuisances."""
    return Problem.make(lift_of(stiffer), SPACE, shape=shape, nuisance_prior=EXACT)


def end_at(theta, loss: Any = 0.0, gradient: Any = 0.0, matrix: Any = 0.0, scale=0.0) -> Descent:
    """The end of a descent, in the first stage."""
    zero, theta = jnp.zeros(()), jnp.asarray(theta, float)
    square = jnp.zeros((len(theta), len(theta)))
    gradient, matrix = jnp.zeros(len(theta)) + gradient, square + matrix
    normal = Normal(jnp.asarray(loss, float), zero, zero, gradient, matrix, square)
    return Descent(theta, normal, zero, zero, jnp.asarray(scale, float), jnp.zeros((), int))


def valley(lifted, size):
    """The end of a descent in a quadratic loss, and what the loss is at any place."""
    random = np.random.default_rng(0)
    root = random.normal(size=(size, 2 * size))
    matrix = jnp.asarray(root @ root.T)
    end = jnp.full(size, 0.5).at[lifted.space.dim :].set(0.0)

    def at(place, gradient: Any = 0.0, loss: Any = 0.0):
        found = matrix @ (place - end) + gradient
        one = jnp.ones(())
        return Normal(loss * one, one, one, found, matrix, 1e-4 * matrix)

    one = jnp.ones(())
    return Descent(end, at(end), one, one, one, jnp.zeros((), int)), at
