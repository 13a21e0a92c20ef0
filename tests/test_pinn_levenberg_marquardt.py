"""Least squares with rows of residuals, and the network alone on exact fields."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from test_pinn_losses import DENSITY, FABRIC, SIZE, waves
from test_pinn_losses import exact as in_closed_form
from test_pinn_network import PlaneStrainSpace

from r2s.estimation.pinn.balance import FLAT_PRIOR, INSIDE
from r2s.estimation.pinn.levenberg_marquardt import (
    Term,
    least_squares,
    normal_equations,
)
from r2s.estimation.pinn.losses import (
    EDGE_NODES,
    displacement,
    draw_points,
    edge_force,
    field,
    gauss,
    gradients,
    marker_residual,
    motion_residual,
)
from r2s.estimation.pinn.network import Network
from r2s.estimation.pinn.pulls import Clamp, Pull
from r2s.estimation.pinn.stress import nominal_stress, small
from r2s.estimation.pinn.training import Recipe, init
from r2s.fabrics.parameters import IsotropicSpace, OrthotropicSpace, ParameterSpace


def of_line(theta, weight, row):
    """A line through points, each twice as exact along one axis."""
    x, y = row
    off = theta[0] + theta[1] * x - y
    return jnp.stack([off, weight * off])


def of_curve(theta, weight, row):
    x, y = row
    return (jnp.exp(theta[0] * x) + weight * theta[1] - y)[None]


def lines(number: int = 30):
    x = np.linspace(0, 1, number)
    y = 2 - 3 * x + 0.1 * np.random.default_rng(0).normal(size=number)
    return Term(of_line, jnp.asarray(0.5), (jnp.asarray(x), jnp.asarray(y)), 7), x, y


def test_a_line_is_found_in_a_step():
    term, x, y = lines()
    found = least_squares([term], np.zeros(2), 20, damping=1e-12)
    np.testing.assert_allclose(found.parameters, np.polyfit(x, y, 1)[::-1], rtol=1e-6)
    assert found.converged and len(found.squares) <= 4
    design = np.stack([np.ones_like(x), x], 1)
    np.testing.assert_allclose(found.information, 1.25 * design.T @ design, rtol=1e-9)


def test_steps_go_down_and_keep_to_bounds():
    x = jnp.linspace(0.0, 2.0, 12)
    term = Term(of_curve, jnp.asarray(1.0), (x, jnp.exp(1.3 * x) + 0.7))
    found = least_squares(
        [term], np.array([-0.5, 0.0]), 60, inside=lambda theta: np.clip(theta, -1, 1)
    )
    assert (np.diff(found.squares) <= 0).all()
    assert found.parameters[0] == 1  # the bound
    free = least_squares([term], np.array([-0.5, 0.0]), 60)
    np.testing.assert_allclose(free.parameters, [1.3, 0.7], rtol=1e-4)


def test_what_is_not_finite_is_said():
    x = jnp.array([0.0, jnp.inf])
    with pytest.raises(RuntimeError, match="not finite"):
        normal_equations([Term(of_curve, jnp.asarray(1.0), (x, x))], np.ones(2))


def wave_pull(fabric) -> Pull:
    """Exact markers in 39 frames, and the traction on the pulled edge."""
    first, second = (waves(fabric.membrane, wave) for wave in ((4.0, 5.0), (5.0, -3.0)))

    def function(point):
        return first(point) + second(point)

    along = (jnp.arange(9.0) + 0.5) / 9
    places = jnp.stack(jnp.meshgrid(along, along, indexing="ij"), -1).reshape(-1, 2)
    zero = jnp.zeros((39, 2))
    clamp = Clamp(zero, zero, zero)
    given = Pull(
        size=jnp.array(SIZE),
        angle=jnp.zeros(()),
        places=places * jnp.array(SIZE)[None],
        displacement=jnp.zeros((39, 81, 2)),
        seen=jnp.ones((39, 81), bool),
        times=jnp.linspace(0.0, 0.03, 39),
        near=clamp,
        far=clamp,
        force=None,
        gravity=jnp.zeros(2),
        normal=jnp.zeros(()),
    )
    field = in_closed_form(function)
    given = dataclasses.replace(given, displacement=marker_residual(field, given))
    return dataclasses.replace(given, force=edge_force(field, given, fabric, small)[:, 0])


FAMILIES = {
    "orthotropic": OrthotropicSpace.make(DENSITY),
    "plane stress": IsotropicSpace.make(DENSITY),
    "plane strain": PlaneStrainSpace.make(DENSITY),
}


class Problem(NamedTuple):
    """A network, the place of a fabric in a space, and a pull that they are to explain.

    - `marker` [m], `motion` [N/m^2], `force` [N]: what residuals are divided by.
    """

    likeness: Network
    space: ParameterSpace
    pull: Pull
    marker: Any
    motion: Any
    force: Any


def network_of(theta, problem) -> Network:
    """The network whose parameters are the first numbers of theta."""
    own, unravel = ravel_pytree(problem.likeness.params)
    return eqx.tree_at(lambda n: n.params, problem.likeness, unravel(theta[: len(own)]))


def of_prior(theta, problem, row):
    """The ranges as a flat prior: theta ends with a place in the space."""
    del problem
    return FLAT_PRIOR**0.5 * (theta[row] - 0.5)[None]


def of_marker(theta, problem, row):
    place, frame, measured = row
    network = network_of(theta, problem)
    moved = displacement(network, problem.pull, place[None], frame[None])[0]
    return (moved - measured) / problem.marker


def of_motion(theta, problem, row):
    place, frame = row
    network = network_of(theta, problem)
    fabric = problem.space(theta[-problem.space.dim :])
    off = motion_residual(network, problem.pull, fabric, place[None], frame[None], small)
    return off[0] / problem.motion


def of_force(theta, problem, row):
    """The traction on the far edge, integrated, against the measured force."""
    frame, measured = row
    pull, fabric = problem.pull, problem.space(theta[-problem.space.dim :])
    nodes, weights = gauss(EDGE_NODES)
    places = jnp.stack([jnp.broadcast_to(pull.size[0], nodes.shape), nodes * pull.size[1]], axis=1)
    network = network_of(theta, problem)
    slopes = gradients(field(network, pull, places, jnp.broadcast_to(frame, nodes.shape)))
    stress = jax.vmap(partial(nominal_stress, fabric, pull.angle, strain=small))(slopes)
    return (pull.size[1] * weights @ stress[:, 0, :1] - measured) / problem.force


def fabric_of(space, pull, tolerance=1e-3, steps=60):
    """The place of a fabric by the network alone: markers, motion and force at once."""
    key_network, key_points = jr.split(jr.key(0))
    one = jax.tree.map(lambda leaf: leaf[None], pull)
    begin = init(space, one, Recipe(width=20, layers=4), key=key_network)
    likeness = jax.tree.map(lambda leaf: leaf[0], begin.networks)
    stress = space.middle().membrane.c11 * jnp.max(jnp.abs(pull.displacement)) / min(SIZE)
    motion, force = tolerance * stress / min(SIZE), tolerance * jnp.max(jnp.abs(pull.force))
    problem = Problem(likeness, space, pull, jnp.asarray(1e-6, float), motion, force)
    frames, markers = (jnp.asarray(grid.ravel()) for grid in np.indices(pull.seen.shape))
    seen = pull.places[markers], frames, pull.displacement.reshape(len(frames), -1)
    drawn, dim = draw_points(pull, 600, key=key_points), space.dim
    data, flat = Term(of_marker, problem, seen), Term(of_prior, problem, jnp.arange(-dim, 0))
    physics = [
        Term(of_motion, problem, (drawn.inner, drawn.inner_frame)),
        Term(of_force, problem, (jnp.arange(len(pull.times)), pull.force)),
    ]
    theta = np.append(ravel_pytree(likeness.params)[0], np.full(dim, 0.5))

    def inside(theta):
        return np.append(theta[:-dim], np.clip(theta[-dim:], INSIDE, 1 - INSIDE))

    # the motion first, or the fabric runs to an end of its ranges meanwhile
    theta = least_squares([data, flat], theta, steps // 3, inside=inside).parameters
    found = least_squares([data, flat, *physics], theta, steps, inside=inside)
    return found.parameters[-dim:]


@pytest.mark.slow(group="pinn")
@pytest.mark.parametrize("name", FAMILIES)
def test_the_network_alone_finds_the_fabric_of_an_exact_field(name):
    """All stiffnesses to 1 %, from the middle of their ranges; where descents are 10 % off."""
    space = FAMILIES[name]
    dim = min(space.dim, 4)
    place = jnp.array([0.45, 0.6])
    fabric = FABRIC if name == "orthotropic" else space(place)
    truth = space.values(space.to_unit(fabric) if name == "orthotropic" else place)
    with jax.numpy_dtype_promotion("standard"):
        found = fabric_of(space, wave_pull(fabric))
    values = space.values(jnp.asarray(found))
    np.testing.assert_allclose(values[:dim], truth[:dim], rtol=0.01)
