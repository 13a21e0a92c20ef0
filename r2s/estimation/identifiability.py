"""How far to trust an estimate: what a planned motion would reveal, and profiles afterwards."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r2s.estimation import descent, gauss_newton
from r2s.estimation.descent import Budget
from r2s.estimation.estimate import Estimate
from r2s.estimation.gauss_newton import Descent, Joint
from r2s.estimation.problem import Problem
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import ParameterSpace, Range

NOISE = 3e-3  # [m]: beyond which a distance counts as an outlier's


def sensitivity(problems: Problem | Joint, fabric: Fabric) -> Estimate:
    """What recordings would reveal of a fabric, were it the true one: deviations, combinations.

    Nothing is fitted: it takes nine simulations with their derivatives, up to 27 where the motion
    is rough. Make the recordings with `r2s.scenarios.synthetic.record` from the motion that is
    planned and the cameras that there are. Raises `RuntimeError` when the simulation diverges.
    """
    problems = (problems,) if isinstance(problems, Problem) else problems
    space = problems[0].space
    place = jnp.clip(space.locate(fabric), gauss_newton.MARGIN, 1 - gauss_newton.MARGIN)
    rest = jnp.zeros(gauss_newton.size(problems) - space.dim, float)
    unknown = jnp.concatenate([place, rest])
    scale = jnp.asarray(NOISE, float)
    normal = _normal(problems, unknown, scale)
    if not np.isfinite(float(normal.loss)):
        raise RuntimeError("the simulation of the planned motion diverged")
    zero = jnp.zeros((), float)
    end = Descent(unknown, normal, zero, zero, scale, jnp.zeros((), int))
    spread = descent.spread_of(problems, descent.DEFAULT, end, jax.random.key(0), true=True)
    return descent.collect(problems, [[end]], spread, "sensitivity", 0.0)


_normal = eqx.filter_jit(gauss_newton.normal_at)


class Fixed(ParameterSpace):
    """A space with one parameter fixed at a place.

    - `family`: the whole one; `which`: the parameter; `place`: where, in 0..1.
    """

    space: ParameterSpace
    place: Float[Array, ""]
    which: int = eqx.field(static=True)
    ranges: tuple[Range, ...] = eqx.field(static=True)

    @classmethod
    def make(cls, space: ParameterSpace, which: int, place: Any) -> "Fixed":
        """The space with its parameter number `which` at a `place` in 0..1."""
        ranges = tuple(r for i, r in enumerate(space.ranges) if i != which)
        return cls(space=space, place=jnp.asarray(place, float), which=which, ranges=ranges)

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the smaller unit cube."""
        return self.space(jnp.insert(u, self.which, self.place))

    def locate(self, fabric: Fabric) -> Float[Array, " dim"]:
        """The point where a fabric lies, but for what is fixed."""
        return jnp.delete(self.space.locate(fabric), self.which, assume_unique_indices=True)


def profile(
    problems: Problem | Joint,
    estimate: Estimate,
    name: str,
    values: Float[np.ndarray, " value"],
    iterations: int = 8,
) -> Float[np.ndarray, " value"]:
    """The least loss [m^2] for each of some `values` of a parameter, all others estimated again.

    From the estimate outwards, so give the values in order. Where it hardly rises the recording
    does not determine the parameter. Raises `ValueError` for an unknown name.
    """
    problems = (problems,) if isinstance(problems, Problem) else problems
    space = problems[0].space
    names = [bound.name for bound in space.ranges]
    if name not in names:
        raise ValueError(f"no parameter {name!r}: the estimate has {', '.join(names)}")
    which = names.index(name)
    places = [float(space.ranges[which].place(jnp.asarray(v, float))) for v in values]
    centre = float(space.locate(estimate.fabric)[which])
    order = sorted(range(len(values)), key=lambda i: abs(places[i] - centre))
    losses = np.full(len(values), np.nan)
    starts = {-1: estimate.fabric, 1: estimate.fabric}
    budget = Budget(coarse=0, starts=1, iterations=iterations, around=0)
    for i in order:
        side = 1 if places[i] >= centre else -1
        held = Fixed.make(space, which, places[i])
        fixed = tuple(dataclasses.replace(problem, space=held) for problem in problems)
        found = descent.descend(
            fixed,
            budget,
            approach="profile",
            start=jnp.clip(held.locate(starts[side]), 0.001, 0.999),
            key=jax.random.key(0),
        )
        losses[i] = found.loss
        starts[side] = found.fabric
    return losses
