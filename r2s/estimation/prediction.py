"""What a recording would show if the sheet were of a given fabric, and how that changes with it.

`theta` is a flat vector: the fabric's place in its space; then the density of the sheet and of the
air and the sheet's size, which all recordings of a fabric share; then of every recording the
cameras' shift, turn and clock. All but the place are nuisances, in units of the standard deviation
that `r2s.estimation.problem.NuisancePrior` gives them.
"""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r2s.estimation.problem import OWN, SHARED, Problem
from r2s.materials.fabric import Fabric
from r2s.scenarios.energy import clamp_force, energy_balance
from r2s.scenarios.scenario import in_denser_air, resized, rollout

Theta = Float[Array, " theta"]


class Prediction(eqx.Module):
    """- `x`: vertices in the frame and on the clock of the cameras, at the frames that count, [m].
    - `force`: on the pulled clamp then, [N]; None: it was not measured.
    - `ok`: whether the whole run is finite.
    """

    x: Float[Array, "frame vertex 3"]
    force: Float[Array, "frame direction"] | None
    ok: Bool[Array, ""]


class Sensitivity(eqx.Module):
    """The derivative of a prediction in theta; fields as in `Prediction`."""

    x: Float[Array, "frame vertex 3 theta"]
    force: Float[Array, "frame direction theta"] | None


def theta_length(problem: Problem) -> int:
    """Length of theta of one recording."""
    return problem.space.dim + len(SHARED) + len(OWN)


def fabric_at(problem: Problem, theta: Theta) -> Fabric:
    """The fabric at a theta, with its density."""
    fabric = problem.space(theta[: problem.space.dim])
    ratio = jnp.exp(problem.nuisance_prior.density * theta[problem.space.dim])
    return dataclasses.replace(fabric, density=fabric.density * ratio)


def predict(problem: Problem, theta: Theta) -> Prediction:
    """What the recording would show at a theta."""
    (x, force), ok = _move(problem, theta)
    return Prediction(_seen_from(problem, x, theta), force, ok)


def sensitivities(
    problem: Problem, theta: Theta, width: float | None = None
) -> tuple[Prediction, Sensitivity]:
    """What the recording would show at a theta, and its derivative.

    The derivative is exact, by forward mode; or, with a `width`, the slope of the secant over that
    much of every parameter's range, which does not see what is rougher.
    """
    shared = problem.space.dim + len(SHARED)
    index = jnp.array(_moving(problem))

    def moved(change):
        return _move(problem, theta.at[index].add(change))

    def moved_twice(change):
        out = moved(change)
        return out[0], out

    def seen_from(x):
        return _seen_from(problem, x, theta)

    def turned(tangent):
        return jax.jvp(seen_from, (x,), (tangent,))[1]

    if width is None:
        none = jnp.zeros(len(index), theta.dtype)
        slope, ((x, force), ok) = jax.jacfwd(moved_twice, has_aux=True)(none)
    else:
        slope, ((x, force), ok) = _secants(moved, theta[index], width, problem.space.dim)
    slope_x, slope_force = jax.tree.map(partial(_scattered, theta_length(problem), index), slope)
    slope_x = jax.vmap(turned, in_axes=-1, out_axes=-1)(slope_x[..., :shared])
    own = jax.jacfwd(lambda theta: _seen_from(problem, x, theta))(theta)[..., shared:]
    return (
        Prediction(seen_from(x), force, ok),
        Sensitivity(jnp.concatenate([slope_x, own], axis=-1), slope_force),
    )


def _moving(problem: Problem) -> list[int]:
    """Indices in theta of what changes the motion: the fabric, and the density of sheet and air
    and the sheet's size where the prior lets them vary."""
    dim, prior = problem.space.dim, problem.nuisance_prior
    scales = (prior.density, prior.air, prior.size)
    shared = [dim + i for i, scale in enumerate(scales) if scale]
    return [*range(dim), *shared]


def _scattered(length: int, index: Array, part: Array) -> Array:
    """Derivatives in some parameters, with zeros for the others along the last axis."""
    return jnp.zeros((*part.shape[:-1], length), part.dtype).at[..., index].set(part)


def _secants(moved, place, width: float, dim: int):
    """Slopes between half a `width` to either side, one-sided at the ends of the unit cube."""
    changes = [jnp.zeros_like(place)]
    for i in range(len(place)):
        for end in (-width / 2, width / 2):
            at = place[i] + end
            at = jnp.clip(at, 0, 1) if i < dim else at
            changes.append(jnp.zeros_like(place).at[i].set(at - place[i]))
    changes = jnp.stack(changes)
    outs, ok = jax.lax.map(moved, changes)
    widths = jnp.sum(changes[2::2] - changes[1::2], axis=1)

    def slope(part):
        difference = part[2::2] - part[1::2]
        return jnp.moveaxis(difference / widths.reshape(-1, *([1] * (part.ndim - 1))), 0, -1)

    first = jax.tree.map(lambda part: part[0], outs)
    return jax.tree.map(slope, outs), (first, jnp.all(ok))


def explain(problem: Problem, theta: Theta) -> str:
    """Say why the run at a theta fails, in which frame and step; "" where it does not.

    It is simulated once more: for an error, not for a search.
    """
    scenario, fabric, solver = _conditions(problem, theta)
    return eqx.filter_jit(rollout)(scenario, fabric, solver=solver).explain()


def _conditions(problem: Problem, theta: Theta):
    """Scenario, fabric and solver (None: the cloth) at a theta."""
    ratio = jnp.exp(problem.nuisance_prior.air * theta[problem.space.dim + 1])
    size = problem.nuisance_prior.size
    if size and problem.solver is not None:
        raise ValueError("the size of the sheet is estimated on the cloth alone")
    scenario = in_denser_air(problem.scenario, ratio)
    if size:
        scenario = resized(scenario, jnp.exp(size * theta[problem.space.dim + 2]))
    solver = None if problem.solver is None else in_denser_air(problem.solver, ratio)
    return scenario, fabric_at(problem, theta), solver


def _move(problem: Problem, theta: Theta):
    """Vertices at all frames [m] and the clamp's force at those that count [N]; whether finite."""
    scenario, fabric, solver = _conditions(problem, theta)
    if problem.force is None:
        moved = rollout(scenario, fabric, solver=solver, frames=problem.wanted)
        return (moved.x, None), jnp.all(moved.ok)
    found = energy_balance(scenario, fabric, solver=solver)
    force = clamp_force(scenario, found)[jnp.array(problem.frames)]
    return (found.x, force @ problem.force.directions.T), jnp.all(jnp.isfinite(found.x))


def _seen_from(problem: Problem, x: Float[Array, "all 3"] | Array, theta: Theta):
    """Vertices of all frames in the cameras' frame, at the frames that count of their clock."""
    prior, own = problem.nuisance_prior, theta[problem.space.dim + len(SHARED) :]
    x = _delayed(x, prior.time * own[4] / problem.scenario.interval)[jnp.array(problem.frames)]
    pivot = x[:, problem.scenario.scene.held[:1]]
    cosine, sine = jnp.cos(prior.turn * own[3]), jnp.sin(prior.turn * own[3])
    turn = jnp.stack([jnp.stack([cosine, -sine]), jnp.stack([sine, cosine])])
    offset = x - pivot
    turned = jnp.concatenate([offset[..., :2] @ turn.T, offset[..., 2:]], axis=-1)
    return pivot + turned + (jnp.asarray(prior.shifts, x.dtype) * own[:3])[None, None]


def _delayed(x: Float[Array, "all vertex 3"], delay: Float[Array, ""]) -> Array:
    """The motion `delay` frames earlier, by cubic interpolation (Catmull and Rom 1974).

    A camera whose clock is late shows at a time on it what was earlier. At rest beyond the ends.
    """
    places = jnp.arange(x.shape[0]).astype(x.dtype) - delay
    whole = jax.lax.stop_gradient(jnp.floor(places))
    part = (places - whole)[:, None, None]
    steps = [jnp.clip(whole.astype(int) + step, 0, x.shape[0] - 1) for step in (-1, 0, 1, 2)]
    before, here, there, after = (x[step] for step in steps)
    slope, curve = (there - before) / 2, before - 2.5 * here + 2 * there - after / 2
    twist = (after - before) / 2 + 1.5 * (here - there)
    return here + part * (slope + part * (curve + part * twist))
