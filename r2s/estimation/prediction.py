"""Predictions of recordings from a fabric, and their derivatives.

`theta` is a flat vector: the fabric's place in its space; then the density of the sheet, that of
the air and the sheet's size, which all recordings of a fabric share; then the cameras' shift, turn
and clock of each recording. All but the place are nuisance parameters, in units of the standard
deviations of `r2s.estimation.problem.NuisancePrior`.

The motion is compiled apart from the loss: it is most of the work, and one program serves
recordings of any number of points and all stages of a descent.
"""

import dataclasses
import threading
from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r2s._util.threads import thread_map
from r2s.compilation import compile_once
from r2s.estimation.estimate import Nuisance
from r2s.estimation.problem import OWN, SHARED, UNITS, Problem, Problems, motion_alone
from r2s.materials.fabric import Fabric
from r2s.scenarios.energy import clamp_force, energy_balance
from r2s.scenarios.scenario import Scenario, at_frames, in_denser_air, resized, rollout

REMEMBERED = 128_000_000  # bytes of derivatives: a lift on 33 x 33 vertices takes 9 MB

Theta = Float[Array, " theta"]


def theta_length(problems: Problems) -> int:
    """Length of theta: fabric, nuisances shared by all recordings, nuisances of each."""
    return problems[0].space.dim + len(SHARED) + len(OWN) * len(problems)


def theta_indices(problems: Problems, which: int) -> np.ndarray:
    """Indices in theta of the parameters of one recording."""
    shared = problems[0].space.dim + len(SHARED)
    first = shared + len(OWN) * which
    return np.concatenate([np.arange(shared), np.arange(first, first + len(OWN))])


class FreeNuisance(NamedTuple):
    """A nuisance parameter with a prior standard deviation, `scale`, in its unit.

    - `recording`: its index, that of the first for what recordings share.
    - `name`: one of `SHARED` or `OWN`. `place`: its index in theta.
    """

    recording: int
    name: str
    scale: float
    place: int


def free_nuisances(problems: Problems) -> Iterator[FreeNuisance]:
    """All nuisance parameters that vary, shared ones once."""
    known = set()
    for which, problem in enumerate(problems):
        places = theta_indices(problems, which)[problem.space.dim :].tolist()
        rows = zip((*SHARED, *OWN), problem.nuisance_prior.scales, places, strict=True)
        for name, scale, place in rows:
            if scale and place not in known:
                known.add(place)
                yield FreeNuisance(which, name, float(scale), place)


def nuisances(problems: Problems, theta: np.ndarray, deviation: np.ndarray) -> tuple[Nuisance, ...]:
    """The nuisance parameters that vary, from theta and its standard errors."""
    rows = []
    for which, name, scale, place in free_nuisances(problems):
        number = f" {which + 1}" if len(problems) > 1 else ""
        value, error = scale * float(theta[place]), scale * float(deviation[place])
        if name in SHARED:  # the logarithm of a ratio
            ratio = float(np.exp(value))
            rows.append(Nuisance(f"{name} ratio", "-", ratio, ratio * error))
        else:
            rows.append(Nuisance(name + number, UNITS[name], value, error))
    return tuple(rows)


class Prediction(eqx.Module):
    """The prediction of a recording.

    - `x`: vertices in the frame and on the clock of the cameras, at the frames that count, [m].
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


def in_proportion(
    predicted: tuple[Prediction, Sensitivity], change: Theta
) -> tuple[Prediction, Sensitivity]:
    """What a prediction would be after a change of theta, were its derivative the same."""
    there, slope = predicted
    parts = (there.x, there.force), (slope.x, slope.force)
    x, force = jax.tree.map(lambda at, by: at + by @ change, *parts)
    return Prediction(x, force, there.ok), slope


Predicted = list[tuple[Prediction, Sensitivity]]  # of each recording
Derive = Callable[[Problems, Theta, float | None], Predicted]  # as `derivatives_at`


def fabric_at(problem: Problem, theta: Theta) -> Fabric:
    """The fabric at a theta, with its density."""
    fabric = problem.space(theta[: problem.space.dim])
    ratio = jnp.exp(problem.nuisance_prior.density * theta[problem.space.dim])
    return dataclasses.replace(fabric, density=fabric.density * ratio)


def predict(problem: Problem, theta: Theta) -> Prediction:
    """The prediction of a recording at a theta."""
    (x, force), ok = _move(problem, theta)
    return Prediction(_seen_from(problem, x, theta), force, ok)


def sensitivities(
    problem: Problem, theta: Theta, width: float | None = None
) -> tuple[Prediction, Sensitivity]:
    """The prediction of a recording at a theta, and its derivative.

    The derivative is exact, by forward mode; or, with a `width`, the slope of the secant over that
    much of every parameter's range, which averages over anything rougher.
    """
    dim, prior = problem.space.dim, problem.nuisance_prior
    shared = dim + len(SHARED)
    scales = (prior.density, prior.air, prior.size)
    # of the parameters that change the motion
    index = jnp.array([*range(dim), *(dim + i for i, scale in enumerate(scales) if scale)])

    def moved(change):
        return _move(problem, theta.at[index].add(change))

    def moved_twice(change):
        out = moved(change)
        return out[0], out

    def scattered(part):
        return jnp.zeros((*part.shape[:-1], len(theta)), part.dtype).at[..., index].set(part)

    def seen_from(x):
        return _seen_from(problem, x, theta)

    def turned(tangent):
        return jax.jvp(seen_from, (x,), (tangent,))[1]

    if width is None:
        none = jnp.zeros(len(index), theta.dtype)
        slope, ((x, force), ok) = jax.jacfwd(moved_twice, has_aux=True)(none)
    else:
        slope, ((x, force), ok) = _secants(moved, theta[index], width, dim)
    slope_x, slope_force = jax.tree.map(scattered, slope)
    slope_x = jax.vmap(turned, in_axes=-1, out_axes=-1)(slope_x[..., :shared])
    own = jax.jacfwd(lambda theta: _seen_from(problem, x, theta))(theta)[..., shared:]
    return (
        Prediction(seen_from(x), force, ok),
        Sensitivity(jnp.concatenate([slope_x, own], axis=-1), slope_force),
    )


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


predict_compiled = compile_once(predict)
_sensitivities = compile_once(sensitivities)


def predictions_at(problems: Problems, theta: Theta) -> list[Prediction]:
    """`predict` of each recording."""
    return thread_map(lambda pair: predict_compiled(*pair), _motions(problems, theta))


def derivatives_at(problems: Problems, theta: Theta, width: float | None = None) -> Predicted:
    """`sensitivities` of each recording."""
    return thread_map(lambda pair: _sensitivities(*pair, width), _motions(problems, theta))


def _motions(problems: Problems, theta: Theta) -> list[tuple[Problem, Array]]:
    """The motion of each recording, and its own part of theta."""
    indices = (jnp.asarray(theta_indices(problems, i)) for i in range(len(problems)))
    pairs = zip(problems, indices, strict=True)
    return [(motion_alone(problem), theta[index]) for problem, index in pairs]


def remembering() -> Derive:
    """`derivatives_at` with a cache of the latest places: a stage of a descent, a search and the
    standard errors begin where another ended. Derivatives of more frames serve fewer, too."""
    # by scenario, theta and width, the latest last: the scenario, the number of frames, derivatives
    cache: dict[tuple, tuple[Scenario, int, tuple[Prediction, Sensitivity]]] = {}
    lock = threading.Lock()

    def derive(problems: Problems, theta: Theta, width: float | None = None) -> Predicted:
        return thread_map(lambda pair: one(*pair, width), _motions(problems, theta))

    def one(problem: Problem, theta: Array, width: float | None):
        scenario = problem.scenario  # kept, so that no other has its id
        frames = scenario.num_frames if problem.wanted is None else int(problem.wanted)
        key = id(scenario), np.asarray(theta).tobytes(), width
        with lock:
            known = cache.get(key)
        if known is None or known[1] < frames:
            known = scenario, frames, _sensitivities(problem, theta, width)
        with lock:
            cache.pop(key, None)
            cache[key] = known
            while len(cache) > 1 and sum(map(_bytes, cache.values())) > REMEMBERED:
                del cache[next(iter(cache))]
        return known[2]

    return derive


def _bytes(known: tuple[Scenario, int, tuple[Prediction, Sensitivity]]) -> int:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(known[2]))


def explain(problem: Problem, theta: Theta) -> str:
    """Why the run at a theta, simulated once more, fails, in which frame and step; or ""."""
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
    """Vertices at all simulated frames [m], with their velocities [m/s] where frames lie between
    these, and the clamp's force at the frames that count [N]; whether all is finite."""
    scenario, fabric, solver = _conditions(problem, theta)
    simulated = dataclasses.replace(scenario, frame_times=None)
    force = None
    if problem.force is None:
        moved = rollout(simulated, fabric, solver=solver, frames=problem.wanted)
        ok = jnp.all(moved.ok)
    else:
        moved = energy_balance(simulated, fabric, solver=solver)
        on_clamp = clamp_force(scenario, moved)[jnp.array(problem.frames)]
        force, ok = on_clamp @ problem.force.directions.T, jnp.all(jnp.isfinite(moved.x))
    is_between = scenario.frame_times is not None
    x = jnp.stack([moved.x, moved.v], axis=1) if is_between else moved.x
    return (x, force), ok


def _seen_from(problem: Problem, x: Array, theta: Theta):
    """What `_move` gives, in the cameras' frame, at the frames that count of their clock: where
    that is late by some time, a frame is of an earlier one."""
    prior, own = problem.nuisance_prior, theta[problem.space.dim + len(SHARED) :]
    if problem.scenario.frame_times is None:
        if prior.time:
            raise ValueError("give the doubt of a clock to Problem.make: its frames lie in between")
    else:
        x, _ = at_frames(problem.scenario, x[:, 0], x[:, 1], prior.time * own[4])
    x = x[jnp.array(problem.frames)]
    pivot = x[:, problem.scenario.scene.pinned[:1]]
    cosine, sine = jnp.cos(prior.turn * own[3]), jnp.sin(prior.turn * own[3])
    turn = jnp.stack([jnp.stack([cosine, -sine]), jnp.stack([sine, cosine])])
    offset = x - pivot
    turned = jnp.concatenate([offset[..., :2] @ turn.T, offset[..., 2:]], axis=-1)
    return pivot + turned + (jnp.asarray(prior.shifts, x.dtype) * own[:3])[None, None]
