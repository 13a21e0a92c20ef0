"""What a recording would show if the sheet were of a given fabric, and how that changes with it.

An unknown is a flat vector: the fabric's place in its space; then the density of the sheet and of
the air, which all recordings of a fabric share; then of every recording the cameras' shift, turn
and clock. All but the place are in units of their standard deviation, as `Doubt` has them.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r2s.estimation.problem import OWN, SHARED, Problem
from r2s.fabrics.fabric import Fabric
from r2s.scenarios.energy import clamp_force, energy_balance
from r2s.scenarios.scenario import rollout

Theta = Float[Array, " unknown"]


class Prediction(eqx.Module):
    """- `x`: vertices in the frame and on the clock of the cameras, at the frames that count, [m].
    - `force`: on the pulled clamp then, [N]; None: it was not measured.
    - `ok`: whether the whole run is finite.
    """

    x: Float[Array, "frame vertex 3"]
    force: Float[Array, "frame direction"] | None
    ok: Bool[Array, ""]


class Sensitivity(eqx.Module):
    """The derivative of what is seen in the unknown."""

    x: Float[Array, "frame vertex 3 unknown"]
    force: Float[Array, "frame direction unknown"] | None


def size(problem: Problem) -> int:
    """Of the unknown of one recording."""
    return problem.space.dim + len(SHARED) + len(OWN)


def fabric_at(problem: Problem, unknown: Theta) -> Fabric:
    """The fabric that an unknown says, with its density."""
    fabric = problem.space(unknown[: problem.space.dim])
    ratio = jnp.exp(problem.nuisance_prior.density * unknown[problem.space.dim])
    return dataclasses.replace(fabric, density=fabric.density * ratio)


def predict(problem: Problem, unknown: Theta) -> Prediction:
    """What the recording would show."""
    (x, force), ok = _move(problem, unknown)
    return Prediction(_seen_from(problem, x, unknown), force, ok)


def sensitivities(
    problem: Problem, unknown: Theta, width: float | None = None
) -> tuple[Prediction, Sensitivity]:
    """What the recording would show, and its derivative in the unknown.

    Exact, by forward mode; or, with a `width`, the slope of the secant over that much of every
    parameter's range, which does not see what is rougher.
    """
    physical = problem.space.dim + len(SHARED)
    doubts = problem.nuisance_prior.density, problem.nuisance_prior.air
    moved = [*range(problem.space.dim), *(problem.space.dim + i for i in (0, 1) if doubts[i])]
    index = jnp.array(moved)
    shift = lambda change: _move(problem, unknown.at[index].add(change))
    if width is None:
        slope, ((x, force), ok) = jax.jacfwd(
            lambda change: (lambda out: (out[0], out))(shift(change)), has_aux=True
        )(jnp.zeros(len(moved), unknown.dtype))
    else:
        slope, ((x, force), ok) = _secants(shift, unknown[index], width, problem.space.dim)
    spread = lambda part: (
        jnp.zeros((*part.shape[:-1], size(problem)), part.dtype).at[..., index].set(part)
    )
    slope_x, slope_force = jax.tree.map(spread, slope)
    seen_from = lambda x: _seen_from(problem, x, unknown)
    turned = jax.vmap(
        lambda tangent: jax.jvp(seen_from, (x,), (tangent,))[1], in_axes=-1, out_axes=-1
    )(slope_x[..., :physical])
    own = jax.jacfwd(lambda unknown: _seen_from(problem, x, unknown))(unknown)[..., physical:]
    return (
        Prediction(seen_from(x), force, ok),
        Sensitivity(jnp.concatenate([turned, own], axis=-1), slope_force),
    )


def _secants(shift, place, width: float, dim: int):
    """Slopes between half a `width` to either side, one-sided at the ends of the unit cube."""
    ends = jnp.array([-width / 2, width / 2], place.dtype)
    inside = lambda at, i: jnp.where(i < dim, jnp.clip(at, 0, 1), at)
    changes = jnp.stack(
        [
            jnp.zeros_like(place).at[i].set(inside(place[i] + end, i) - place[i])
            for i in range(len(place))
            for end in ends
        ]
    )
    changes = jnp.concatenate([jnp.zeros_like(place)[None], changes])
    moved, ok = jax.lax.map(shift, changes)
    apart = jnp.sum(changes[2::2] - changes[1::2], axis=1)
    along = lambda part: jnp.moveaxis(
        (part[2::2] - part[1::2]) / apart.reshape(-1, *([1] * (part.ndim - 1))), 0, -1
    )
    first = jax.tree.map(lambda part: part[0], moved)
    return jax.tree.map(along, moved), (first, jnp.all(ok))


def _move(problem: Problem, unknown: Theta):
    """Vertices at all frames [m] and the clamp's force at those that count [N]; whether finite."""
    fabric = fabric_at(problem, unknown)
    ratio = jnp.exp(problem.nuisance_prior.air * unknown[problem.space.dim + 1])
    thicken = lambda part: eqx.tree_at(
        lambda part: part.scene.air.density, part, replace_fn=lambda density: density * ratio
    )
    scenario = thicken(problem.scenario)
    solver = None if problem.solver is None else thicken(problem.solver)
    if problem.force is None:
        moved = rollout(scenario, fabric, solver=solver)
        return (moved.x, None), jnp.all(moved.ok)
    found = energy_balance(scenario, fabric, solver=solver)
    force = clamp_force(scenario, found)[jnp.array(problem.frames)]
    return (found.x, force @ problem.force.directions.T), jnp.all(jnp.isfinite(found.x))


def _seen_from(problem: Problem, x: Float[Array, "all 3"] | Array, unknown: Theta):
    """Vertices of all frames in the cameras' frame, at the frames that count of their clock."""
    nuisance_prior, own = problem.nuisance_prior, unknown[problem.space.dim + len(SHARED) :]
    x = _delayed(x, nuisance_prior.time * own[4] / problem.scenario.interval)[
        jnp.array(problem.frames)
    ]
    pivot = x[:, problem.scenario.scene.held[:1]]
    cosine, sine = jnp.cos(nuisance_prior.turn * own[3]), jnp.sin(nuisance_prior.turn * own[3])
    turn = jnp.stack([jnp.stack([cosine, -sine]), jnp.stack([sine, cosine])])
    offset = x - pivot
    turned = jnp.concatenate([offset[..., :2] @ turn.T, offset[..., 2:]], axis=-1)
    return pivot + turned + nuisance_prior.shift * own[None, None, :3]


def _delayed(x: Float[Array, "all vertex 3"], delay: Float[Array, ""]) -> Array:
    """The motion `delay` frames earlier, by cubic interpolation (Catmull and Rom 1974).

    A camera whose clock is late shows at a time on it what was earlier. At rest beyond the ends.
    """
    places = jnp.arange(x.shape[0]).astype(x.dtype) - delay
    whole = jax.lax.stop_gradient(jnp.floor(places))
    part = (places - whole)[:, None, None]
    at = lambda step: x[jnp.clip(whole.astype(int) + step, 0, x.shape[0] - 1)]
    before, here, there, after = at(-1), at(0), at(1), at(2)
    slope, curve = (there - before) / 2, before - 2.5 * here + 2 * there - after / 2
    twist = (after - before) / 2 + 1.5 * (here - there)
    return here + part * (slope + part * (curve + part * twist))
