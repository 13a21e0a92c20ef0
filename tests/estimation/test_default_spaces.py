"""The ranges of estimates are centred on the prior, and hold the study's fabrics."""

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s.estimation.default_spaces import law_of, on_cloth, with_law
from r2s.estimation.method import default_space
from r2s.materials import presets, prior
from r2s.materials.parameters import EXTENDED
from r2s.study.recordings import small_strain

SPACE = default_space("cloth", float(presets.grey_interlock().density))


def test_ranges_are_centred_on_the_prior_and_not_on_the_five_fabrics():
    assumed = prior.middle(0.2)
    middle = SPACE.values(jnp.full(SPACE.dim, 0.5))
    names = [bound.name for bound in SPACE.ranges]
    for name, value in (
        ("warp", assumed.membrane.c11),
        ("weft", assumed.membrane.c22),
        ("shear", assumed.membrane.c33),
        ("bending", assumed.bending.stiffness),
        ("damping", assumed.damping),
    ):
        assert float(middle[names.index(name)]) == pytest.approx(float(value), rel=0.02), name
    truths = np.log(
        [
            np.asarray(SPACE.values(SPACE.to_unit(small_strain(f))))[[0, 1, 2, 4, 5]]
            for f in presets.FIVE
        ]
    )
    away = np.asarray(middle)[jnp.array([0, 1, 2, 4, 5])] / np.exp(truths.mean(axis=0))
    assert np.all(np.abs(np.log(away)) > np.log(1.25))


@pytest.mark.parametrize("name", list(presets.FIVE))
def test_every_truth_is_inside_and_none_has_the_fixed_values(name):
    truth = small_strain(name)
    place = np.asarray(default_space("cloth", float(truth.density)).to_unit(truth))
    assert np.all((place > 0.006) & (place < 0.994))
    space = default_space("mpm", float(truth.density))
    told = space.middle()
    assert not np.isclose(float(told.damping), float(truth.damping), rtol=0.02)
    assert not np.isclose(float(told.friction), float(truth.friction), rtol=0.02)
    assumed = prior.middle(float(truth.density))
    assert float(told.bending.stiffness) == pytest.approx(float(assumed.bending.stiffness))


def test_the_middle_of_the_prior_is_the_median_of_its_draws():
    drawn, middle = prior.draws(0.2, 4000, jr.key(0)), prior.middle(0.2)
    for part in (lambda f: f.bending.stiffness, lambda f: f.damping, lambda f: f.membrane.c33):
        median = float(jnp.median(part(drawn)))
        assert float(part(middle)) == pytest.approx(median, rel=0.08)
    assert float(middle.friction) == pytest.approx(float(jnp.median(drawn.friction)), abs=0.02)
    with pytest.raises(ValueError, match="density must be positive"):
        prior.middle(0.0)


def test_a_law_of_the_list_adds_its_numbers_and_another_is_refused():
    space = on_cloth(0.2)
    for law in ("linear", *EXTENDED, "+".join(EXTENDED)):
        assert law_of(with_law(space, law).ranges) == law
    with pytest.raises(ValueError, match="no law 'presoftening'; there are linear, stiffening"):
        with_law(space, "presoftening")
