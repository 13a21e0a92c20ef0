"""The network's derivatives, and the stress in a sheet, against others' derivations."""

import dataclasses

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s.estimation.pinn.network import Network, T, X, Y
from r2s.estimation.pinn.weak_form import green_strain, nominal_stress, small_strain
from r2s.materials.fabric import Fabric
from r2s.materials.membrane import OrthotropicMembrane, TurnedMembrane, turned
from r2s.mesh.mesh import rectangle

FABRIC = Fabric.make(0.3, (200.0, 40.0, 120.0, 30.0), 1e-5, damping=0.02)
ANGLE = jnp.asarray(0.4)


def some_network() -> Network:
    high = jnp.array([0.45, 0.3, 1.2])
    return Network.make(high, jnp.asarray(0.02), width=9, layers=4, key=jr.key(0))


@pytest.mark.slow(group="pinn")
@pytest.mark.parametrize("pairs", [((X, X), (X, Y), (Y, Y), (T, T)), ((X, T), (Y, T), (T, T))])
def test_jets_are_the_derivatives(pairs):
    network = some_network()
    points = jr.uniform(jr.key(1), (5, 3)) * jnp.array([[0.45, 0.3, 1.2]])
    jet = network.jet(points, pairs)

    def one(point):
        return network(point[None])[0]

    first = jax.vmap(jax.jacrev(one))(points)
    second = jax.vmap(jax.hessian(one))(points)
    np.testing.assert_allclose(jet.value, network(points), rtol=1e-12)
    np.testing.assert_allclose(jet.first, jnp.moveaxis(first, 2, 0), rtol=1e-9, atol=1e-14)
    for found, (i, j) in zip(jet.second, pairs, strict=True):
        np.testing.assert_allclose(found, second[:, :, i, j], rtol=1e-9, atol=1e-13)


def gradient(key: int, size: float):
    return size * jr.normal(jr.key(key), (2, 2))


def test_green_strain_does_not_see_a_rotation():
    c, s = jnp.cos(0.7), jnp.sin(0.7)
    rotation = jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
    np.testing.assert_allclose(green_strain(rotation - jnp.eye(2)), 0, atol=1e-15)


def test_strains_agree_when_small():
    change = gradient(2, 1e-7)
    np.testing.assert_allclose(green_strain(change), small_strain(change), atol=1e-12)


def test_stress_is_the_derivative_of_the_energy():
    at, law = gradient(3, 0.05), TurnedMembrane(FABRIC.membrane, ANGLE)
    expected = jax.grad(lambda g: law.energy_density(green_strain(g)))(at)
    np.testing.assert_allclose(nominal_stress(FABRIC, ANGLE, at), expected, rtol=1e-10)


def test_damping_adds_the_stress_of_the_rate():
    """Kelvin-Voigt: as if the strain were that of `damping` later, to first order."""
    at, rate = gradient(3, 0.05), gradient(4, 1e-4)
    found = nominal_stress(FABRIC, ANGLE, at, rate) - nominal_stress(FABRIC, ANGLE, at)
    fast = jax.jvp(green_strain, (at,), (rate,))[1]
    law = TurnedMembrane(FABRIC.membrane, ANGLE)
    viscous = 0.02 * jax.grad(law.energy_density)(fast)  # the law is linear
    expected = jax.vjp(green_strain, at)[1](viscous)[0]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_turning_a_strain_turns_its_tensor():
    strain = jnp.array([0.02, -0.01, 0.03])
    e11, e22, shear = strain
    tensor = jnp.array([[e11, shear / 2], [shear / 2, e22]])
    c, s = jnp.cos(ANGLE), jnp.sin(ANGLE)
    axes = jnp.array([[c, s], [-s, c]])  # warp and weft
    there = axes @ tensor @ axes.T
    found = turned(strain, ANGLE)
    np.testing.assert_allclose(found, jnp.array([there[0, 0], there[1, 1], 2 * there[0, 1]]))


def test_a_turned_isotropic_law_is_the_same():
    law = OrthotropicMembrane.isotropic(1e5, 0.3, 1e-3)
    strain = jnp.array([0.02, -0.01, 0.03])
    found = TurnedMembrane(law, ANGLE).energy_density(strain)
    np.testing.assert_allclose(found, law.energy_density(strain), rtol=1e-12)


@pytest.mark.slow(group="pinn")
def test_a_turned_law_stretches_a_sheet_of_the_cloth():
    """The stored energy of a stretched mesh is that of the law at its strain."""
    from r2s.scenarios.energy import stored_energy

    mesh = rectangle((0.2, 0.2), (3, 3))
    fabric = dataclasses.replace(FABRIC, membrane=TurnedMembrane(FABRIC.membrane, ANGLE))
    x = jnp.pad(mesh.rest * jnp.array([[1.05, 1.0]]), ((0, 0), (0, 1)))
    strain = jnp.array([(1.05**2 - 1) / 2, 0.0, 0.0])
    expected = 0.04 * fabric.membrane.energy_density(strain)
    np.testing.assert_allclose(stored_energy(mesh, fabric, x), expected, rtol=1e-10)
