"""Least squares with rows of residuals, and the network alone on exact fields."""

import dataclasses

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from test_pinn_losses import DENSITY, FABRIC, SIZE, waves
from test_pinn_losses import exact as in_closed_form

from r2s.estimation.pinn import exact
from r2s.estimation.pinn.data import Clamp, Pull
from r2s.estimation.pinn.laws import PlaneStrainFamily, small
from r2s.estimation.pinn.levenberg import (
    Term,
    least_squares,
    marginal,
    normal_equations,
)
from r2s.estimation.pinn.losses import edge_force, marker_residual
from r2s.estimation.pinn.network import Network
from r2s.fabrics.parameters import IsotropicSpace, OrthotropicSpace


def of_line(unknown, about, row):
    """A line through points, each twice as exact along one axis."""
    x, y = row
    off = unknown[0] + unknown[1] * x - y
    return jnp.stack([off, about * off])


def of_curve(unknown, about, row):
    x, y = row
    return (jnp.exp(unknown[0] * x) + about * unknown[1] - y)[None]


def lines(number: int = 30):
    x = np.linspace(0, 1, number)
    y = 2 - 3 * x + 0.1 * np.random.default_rng(0).normal(size=number)
    return Term(of_line, jnp.asarray(0.5), (jnp.asarray(x), jnp.asarray(y)), 7), x, y


def test_a_line_is_found_in_a_step():
    term, x, y = lines()
    found = least_squares([term], np.zeros(2), 20, damping=1e-12)
    np.testing.assert_allclose(found.unknown, np.polyfit(x, y, 1)[::-1], rtol=1e-6)
    assert found.converged and len(found.squares) <= 4
    design = np.stack([np.ones_like(x), x], 1)
    np.testing.assert_allclose(found.information, 1.25 * design.T @ design, rtol=1e-9)


def test_what_is_left_over_of_the_information():
    """Of the last unknowns when the others are unknown: the inverse of their covariance."""
    random = np.random.default_rng(1).normal(size=(9, 6))
    information = random.T @ random
    covariance = np.linalg.inv(information)[-2:, -2:]
    np.testing.assert_allclose(marginal(information, 2), np.linalg.inv(covariance), rtol=1e-5)


def test_steps_go_down_and_keep_to_bounds():
    x = jnp.linspace(0.0, 2.0, 12)
    term = Term(of_curve, jnp.asarray(1.0), (x, jnp.exp(1.3 * x) + 0.7))
    inside = lambda unknown: np.clip(unknown, -1, 1)
    found = least_squares([term], np.array([-0.5, 0.0]), 60, inside=inside)
    assert (np.diff(found.squares) <= 0).all()
    assert found.unknown[0] == 1  # the bound
    free = least_squares([term], np.array([-0.5, 0.0]), 60)
    np.testing.assert_allclose(free.unknown, [1.3, 0.7], rtol=1e-4)


def test_what_is_not_finite_is_said():
    x = jnp.array([0.0, jnp.inf])
    with pytest.raises(RuntimeError, match="not finite"):
        normal_equations([Term(of_curve, jnp.asarray(1.0), (x, x))], np.ones(2))


def test_weights_of_a_network_go_there_and_back():
    low, high = jnp.zeros(3), jnp.ones(3)
    make = {"width": 4, "layers": 3}
    one, other = (Network.make(low, high, jnp.ones(()), **make, key=jr.key(i)) for i in range(2))
    moved = exact.with_weights(other, jnp.append(jnp.asarray(exact.weights_of(one)), 5.0))
    points = jr.uniform(jr.key(3), (5, 3))
    np.testing.assert_allclose(moved(points), one(points), rtol=1e-12)


def wave_pull(fabric) -> Pull:
    """Exact markers in 39 frames, and the traction on the pulled edge."""
    first, second = (waves(fabric.membrane, wave) for wave in ((4.0, 5.0), (5.0, -3.0)))
    function = lambda point: first(point) + second(point)
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
    "plane strain": PlaneStrainFamily.make(DENSITY),
}


@pytest.mark.slow(group="pinn")
@pytest.mark.parametrize("name", FAMILIES)
def test_the_network_alone_finds_the_fabric_of_an_exact_field(name):
    """All stiffnesses to 1 %, from the middle of their ranges; where descents are 10 % off."""
    space = FAMILIES[name]
    dim = min(space.dim, 4)
    place = jnp.array([0.45, 0.6])
    fabric = FABRIC if name == "orthotropic" else space(place)
    truth = space.values(space.locate(fabric) if name == "orthotropic" else place)
    with jax.numpy_dtype_promotion("standard"):
        found, _ = exact.fit(space, wave_pull(fabric), strain=small, key=jr.key(0))
    values = space.values(jnp.asarray(found))
    np.testing.assert_allclose(values[:dim], truth[:dim], rtol=0.01)
