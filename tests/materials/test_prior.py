"""A prior that was not laid around the fabrics of the study; laws that stiffen and soften."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s.estimation.default_spaces import on_cloth, with_law
from r2s.materials import presets, prior
from r2s.materials.membrane import OrthotropicMembrane
from r2s.materials.parameters import SofteningSpace, StiffeningSpace
from r2s.materials.plate import PlateBending
from r2s.materials.stiffening import SofteningPlate, StiffeningMembrane
from r2s.scenarios.paths import draw


def test_draws_are_fabrics_with_the_stated_spread_and_the_weight_that_is_known():
    found = prior.draws(0.2, 4000, jr.key(0))
    law = found.membrane
    assert np.all(np.asarray(law.c12**2 < law.c11 * law.c22))
    assert np.allclose(found.density, 0.2)
    bending = np.log(np.asarray(found.bending.stiffness))
    assert bending.mean() == pytest.approx(-9.197 + 1.230 * np.log(0.2), abs=0.05)
    assert bending.std() == pytest.approx(0.80, rel=0.05)
    again = prior.draws(0.2, 4000, jr.key(0))
    assert np.array_equal(again.membrane.c11, law.c11)
    with pytest.raises(ValueError, match="density"):
        prior.draws(0.0, 1, jr.key(0))


@pytest.mark.slow(group="cloth")
def test_draws_of_a_key_are_the_same_in_either_precision():
    """Else a study judged in float64 is of other motions than one in float32."""
    double = prior.draws(0.2, 3, jr.key(0)), draw("fling", 2, key=jr.key(0))
    with jax.enable_x64(False):
        single = prior.draws(0.2, 3, jr.key(0)), draw("fling", 2, key=jr.key(0))
    assert jax.tree.leaves(single)[0].dtype == jnp.float32
    for one, other in zip(*map(jax.tree.leaves, (single, double)), strict=True):
        np.testing.assert_allclose(np.asarray(one), np.asarray(other), rtol=1e-5)


SMALL = OrthotropicMembrane(*(jnp.asarray(c) for c in (30.0, 5.0, 60.0, 10.0)))


def _tangent(law, strain):
    return np.asarray(jax.hessian(law.energy_density)(strain))


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("axis", [0, 1])
def test_a_yarn_stiffens_half_way_at_a_stretch_and_at_most_by_a_ratio(axis):
    law = StiffeningMembrane.make(SMALL, 2.0, 1.1)
    along = jnp.eye(3)[axis]
    at_rest = _tangent(SMALL, jnp.zeros(3))
    for strain, ratio in (((1.1**2 - 1) / 2, 1.5), (100.0, 2.0), (0.0, 1.0), (-0.2, 1.0)):
        found = _tangent(law, strain * along)
        assert found[axis, axis] == pytest.approx(ratio * at_rest[axis, axis], rel=1e-5)
        others = np.ones((3, 3), bool)
        others[axis, axis] = False
        assert found[others] == pytest.approx(at_rest[others])
    stiffest = _tangent(law.stiffest, jnp.zeros(3))
    for strain in jr.uniform(jr.key(0), (20, 3), minval=-1.0, maxval=1.0):
        assert np.linalg.eigvalsh(stiffest - _tangent(law, strain)).min() > -1e-9
    with pytest.raises(ValueError, match="ratio >= 1"):
        StiffeningMembrane.make(SMALL, 0.5, 1.1)


def test_a_plate_loses_half_of_what_it_can_at_its_knee():
    loss, knee = 0.35, 20.0
    law = SofteningPlate(PlateBending.make(2e-5, 0.2), jnp.asarray(loss), jnp.asarray(knee))
    for curvature, left in ((1e-3, 1.0), (knee, 1 - loss / 2), (1e4, 1 - loss)):
        moment = jax.grad(law.energy_density)(jnp.array([curvature, 0.0, 0.0]))[0]
        assert moment == pytest.approx(2e-5 * curvature * left, rel=1e-4)
    bent = jax.hessian(law.energy_density)(jnp.array([30.0, -10.0, 5.0]))
    assert np.all(np.linalg.eigvalsh(np.asarray(bent)) > 0)


def test_a_space_of_sheets_that_soften_and_stiffen_gives_a_fabric_back():
    space = with_law(on_cloth(0.2), "stiffening+softening")
    place = jr.uniform(jr.key(0), (space.dim,))
    np.testing.assert_allclose(space.to_unit(space(place)), place, rtol=1e-4)
    loss, knee = map(float, space.values(place)[7:9])
    law = space(place).bending
    moment = jax.grad(law.energy_density)(jnp.array([knee, 0.0, 0.0]))[0]
    left = float(law.small.stiffness) * (1 - loss / 2)
    assert float(moment) == pytest.approx(left * knee, rel=1e-4)
    of_none = space.to_unit(presets.black_denim())
    assert of_none[7] == 0 and jnp.allclose(space(of_none).bending.loss, 0)


@pytest.mark.parametrize("laws", [(), (StiffeningSpace,), (SofteningSpace, StiffeningSpace)])
def test_a_space_that_knows_of_the_prior_has_the_mean_and_the_spread_of_its_draws(laws):
    space = on_cloth(0.2)
    for law in laws:
        space = law.make(space)
    mean, precision = prior.informed(space, 0.2).prior()
    drawn = prior.draws(0.2, 4000, jr.key(3))
    places = np.asarray(jax.vmap(space.to_unit)(drawn))[:, :7]
    spread = np.sqrt(np.diag(np.linalg.inv(precision)))
    np.testing.assert_allclose(mean[:7], np.clip(places.mean(axis=0), 0, 1), atol=0.03)
    np.testing.assert_allclose(spread[:7], places.std(axis=0), rtol=0.1)
    if laws:  # of which no draw says anything
        np.testing.assert_allclose(spread[7:], 0.29, rtol=1e-5)
