"""Identifiability: what recordings reveal of a fabric, and how the loss rises along a parameter."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s.estimation import compiled, gauss_newton
from r2s.estimation.descent import DEFAULT
from r2s.estimation.estimate import Estimate
from r2s.estimation.gauss_newton import Descent, Problems
from r2s.estimation.judgement import collect, descend
from r2s.estimation.method import Budget
from r2s.estimation.prediction import explain
from r2s.estimation.problem import Problem
from r2s.estimation.standard_errors import covariance_at
from r2s.materials.fabric import Fabric
from r2s.materials.parameters import ParameterSpace, Prior, Range

NOISE = 3e-3  # [m]: beyond which a distance counts as an outlier's


def sensitivity(problems: Problem | Problems, fabric: Fabric) -> Estimate:
    """Standard errors and combinations that recordings would give, were a fabric the true one.

    Nothing is fitted: it takes nine simulations with their derivatives. Make the recordings with
    `r2s.scenarios.synthetic.record` from the motion in question and the cameras that there are.
    Raises `RuntimeError` when the simulation diverges.
    """
    problems = (problems,) if isinstance(problems, Problem) else problems
    space = problems[0].space
    place = jnp.clip(space.to_unit(fabric), gauss_newton.MARGIN, 1 - gauss_newton.MARGIN)
    nuisances = jnp.zeros(gauss_newton.theta_length(problems) - space.dim, float)
    theta = jnp.concatenate([place, nuisances])
    scale = jnp.asarray(NOISE, float)
    predicted = compiled.derivatives_at(problems, theta)
    normal = compiled.normal_from(problems, theta, predicted, scale)
    if not np.isfinite(float(normal.loss)):
        which = gauss_newton.theta_indices(problems, 0)
        why = explain(problems[0], theta[which]) or "has a loss that is not finite"
        raise RuntimeError(f"the simulation of the motion {why}")
    zero = jnp.zeros((), float)
    end = Descent(theta, normal, zero, zero, scale, jnp.zeros((), int))
    key = jax.random.key(0)
    covariance = covariance_at(problems, DEFAULT, end, key, is_truth=True)
    loss = compiled.loss_from(problems, [seen for seen, _ in predicted])
    return collect(problems, end, [[end]], covariance, "sensitivity", 0.0, None, loss)


class FixedParameter(ParameterSpace):
    """A space with one parameter fixed.

    - `space`: the whole space.
    - `place`: where the parameter is fixed, in 0..1.
    - `which`: the index of the parameter.
    """

    space: ParameterSpace
    place: Float[Array, ""]
    which: int = eqx.field(static=True)
    ranges: tuple[Range, ...] = eqx.field(static=True)

    @classmethod
    def make(cls, space: ParameterSpace, which: int, place: Any) -> "FixedParameter":
        """The space with its parameter number `which` at a `place` in 0..1."""
        ranges = tuple(r for i, r in enumerate(space.ranges) if i != which)
        return cls(space=space, place=jnp.asarray(place, float), which=which, ranges=ranges)

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the smaller unit cube."""
        return self.space(jnp.insert(u, self.which, self.place))

    def to_unit(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point where a fabric lies, without the fixed parameter."""
        return jnp.delete(self.space.to_unit(fabric), self.which, assume_unique_indices=True)

    def prior(self) -> Prior:
        """What is known of the others, given the one that is fixed."""
        mean, precision = self.space.prior()
        others = [i for i in range(self.space.dim) if i != self.which]
        inner = precision[jnp.ix_(jnp.array(others), jnp.array(others))]
        pull = precision[jnp.array(others), self.which] * (self.place - mean[self.which])
        return mean[jnp.array(others)] - jnp.linalg.solve(inner, pull), inner


def profile(
    problems: Problem | Problems,
    estimate: Estimate,
    name: str,
    values: Float[np.ndarray, " value"],
    iterations: int = 8,
) -> Float[np.ndarray, " value"]:
    """Profile of the loss [m^2]: its least value at each of some values of a parameter.

    All other parameters are estimated again, from the estimate outwards. Where the profile hardly
    rises the recording does not determine the parameter.

    - `name`, `values`: the parameter, and its values in increasing order.
    - `iterations`: of each descent.

    Raises `ValueError` for a name that no parameter has.
    """
    problems = (problems,) if isinstance(problems, Problem) else problems
    space = problems[0].space
    names = [bound.name for bound in space.ranges]
    if name not in names:
        raise ValueError(f"no parameter {name!r}: the estimate has {', '.join(names)}")
    which = names.index(name)
    places = [float(space.ranges[which].to_unit(jnp.asarray(v, float))) for v in values]
    centre = float(space.to_unit(estimate.fabric)[which])
    order = sorted(range(len(values)), key=lambda i: abs(places[i] - centre))
    losses = np.full(len(values), np.nan)
    starts = {-1: estimate.fabric, 1: estimate.fabric}
    budget = Budget(coarse=0, starts=1, iterations=iterations, around=0)
    for i in order:
        side = 1 if places[i] >= centre else -1
        held = FixedParameter.make(space, which, places[i])
        fixed = tuple(dataclasses.replace(problem, space=held) for problem in problems)
        found = descend(
            fixed,
            budget,
            approach="profile",
            start=jnp.clip(held.to_unit(starts[side]), 0.001, 0.999),
            key=jax.random.key(0),
        )
        losses[i] = found.loss
        starts[side] = found.fabric
    return losses
