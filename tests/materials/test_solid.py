"""Laws of a solid: stress from energy, invariance, derivatives where principal stretches meet."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s.materials.solid import (
    FixedCorotated,
    LinearSolid,
    NeoHookean,
    Solid,
    rotation_of,
)

LAWS = [FixedCorotated, NeoHookean, LinearSolid]
LARGE = [FixedCorotated, NeoHookean]  # for large rotations
YOUNG, POISSON = 3e3, 0.3


def random(dimension, size=0.2, seed=0):
    noise = np.random.default_rng(seed).normal(size=(dimension, dimension))
    return jnp.eye(dimension) + size * jnp.asarray(noise)


def turned(dimension, seed=1):
    """A random rotation."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(dimension, dimension)))
    q[:, 0] *= np.linalg.det(q)
    return jnp.asarray(q)


@pytest.fixture(scope="module", params=[2, 3])
def dimension(request):
    return request.param


@pytest.mark.parametrize("law", LAWS)
def test_the_stress_is_the_derivative_of_the_energy(law, dimension):
    law = law.make(YOUNG, POISSON)
    for deformation in (jnp.eye(dimension), 1.2 * jnp.eye(dimension), random(dimension)):
        expected = jax.jit(jax.grad(law.energy_density))(deformation) @ deformation.T
        assert law.kirchhoff(deformation) == pytest.approx(np.asarray(expected), abs=1e-9)


@pytest.mark.parametrize("law", LAWS)
def test_all_laws_agree_for_small_strains(law, dimension):
    law, mu = law.make(YOUNG, POISSON), YOUNG / (2 * (1 + POISSON))
    lam = 2 * mu * POISSON / (1 - 2 * POISSON)
    strain = random(dimension) - jnp.eye(dimension)
    strain = (strain + strain.T) / 2
    expected = 2 * mu * strain + lam * jnp.trace(strain) * jnp.eye(dimension)
    _, found = jax.jvp(law.kirchhoff, (jnp.eye(dimension),), (strain,))
    assert found == pytest.approx(np.asarray(expected), rel=1e-12, abs=1e-9)
    assert law.viscous(strain) == pytest.approx(np.asarray(expected), rel=1e-12, abs=1e-9)


def test_the_modulus_is_the_largest_eigenvalue_of_the_elasticity(dimension):
    law, identity = LinearSolid.make(YOUNG, POISSON), jnp.eye(dimension)
    tensor = jax.jacobian(law.kirchhoff)(identity).reshape(dimension**2, dimension**2)
    assert law.modulus(dimension) == pytest.approx(np.linalg.eigvals(tensor).real.max(), rel=1e-9)


@pytest.mark.parametrize("law", LARGE)
def test_energy_and_stress_turn_with_the_material(law, dimension):
    law, deformation, turn = law.make(YOUNG, POISSON), random(dimension), turned(dimension)
    energy = float(law.energy_density(deformation))
    assert law.energy_density(turn @ deformation) == pytest.approx(energy, rel=1e-12)
    assert law.energy_density(deformation @ turn) == pytest.approx(energy, rel=1e-12)  # isotropic
    expected = turn @ law.kirchhoff(deformation) @ turn.T
    assert law.kirchhoff(turn @ deformation) == pytest.approx(np.asarray(expected), abs=1e-9)
    assert law.kirchhoff(turn) == pytest.approx(0, abs=1e-10)


@pytest.mark.parametrize("law", LAWS)
def test_the_stress_has_the_right_derivative_also_where_stretches_are_equal(law, dimension):
    law, direction = law.make(YOUNG, POISSON), random(dimension, seed=3)
    turn, jacobian = turned(dimension), jax.jit(jax.jacrev(law.kirchhoff))
    pushed = jax.jit(lambda at, along: jax.jvp(law.kirchhoff, (at,), (along,)))
    for deformation in (jnp.eye(dimension), 1.3 * turn, random(dimension)):
        if not isinstance(law, LinearSolid):
            deformation = turn @ deformation
        size = 1e-6
        ahead, behind = (pushed(deformation + s * size * direction, direction)[0] for s in (1, -1))
        expected = np.asarray(ahead - behind) / (2 * size)
        _, forward = pushed(deformation, direction)
        assert forward == pytest.approx(expected, rel=1e-7, abs=1e-5)
        reverse = jnp.tensordot(jacobian(deformation), direction, 2)
        assert reverse == pytest.approx(np.asarray(forward), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("stretches", [(1, 1, 1), (10, 0.1, 1), (100, 1, 0.01), (2, 2, 0.5)])
def test_the_rotation_of_a_stretched_rotation(stretches, dimension):
    turn, basis = turned(dimension), turned(dimension, 5)
    stretch = basis @ jnp.diag(jnp.asarray(stretches[:dimension], float)) @ basis.T
    assert rotation_of(turn @ stretch) == pytest.approx(np.asarray(turn), abs=1e-11)


@pytest.mark.parametrize("young, poisson", [(0.0, 0.3), (1e3, 0.5), (1e3, -1.0)])
def test_an_impossible_solid_is_refused(young, poisson):
    with pytest.raises(ValueError, match="Poisson"):
        FixedCorotated.make(young, poisson)


@pytest.mark.parametrize("values", [(0.0, 0.0, 0.0, 0.0), (1.0, -1.0, 0.0, 0.0)])
def test_an_impossible_density_or_damping_is_refused(values):
    with pytest.raises(ValueError, match="density"):
        Solid.make(FixedCorotated.make(1e3, 0.3), *values)
