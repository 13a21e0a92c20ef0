"""Parameter spaces: the unit cube and its fabrics. The length at which a fabric bends."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import few
from elastica import elastica
from hypothesis import given
from hypothesis import strategies as st

from r2s._util.units import GRAVITY
from r2s.materials.fabric import Fabric, bending_length
from r2s.materials.parameters import LOSSES, IsotropicSpace, OrthotropicSpace, Range
from r2s.materials.presets import FIVE, pink_solid

FAMILY = OrthotropicSpace.make(0.2)
places = st.tuples(*[st.floats(0, 1)] * FAMILY.dim).map(np.array)
there_and_back = jax.jit(lambda u: FAMILY.to_unit(FAMILY(u)))


@given(places)
@few
def test_a_fabric_is_located_where_it_came_from_and_stable(place):
    assert np.asarray(there_and_back(jnp.asarray(place))) == pytest.approx(place, abs=1e-9)
    law = FAMILY(jnp.asarray(place)).membrane
    assert min(law.c11, law.c22, law.c33, law.c11 * law.c22 - law.c12**2) > 0


@pytest.mark.parametrize("name", FIVE)
def test_locating_a_fabric_and_going_there_gives_it_back(name):
    fabric = FIVE[name]()
    space = OrthotropicSpace.make(float(fabric.density), float(fabric.thickness))
    again = space(space.to_unit(fabric))
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(fabric), strict=True):
        assert a == pytest.approx(float(b), rel=1e-9)


def test_the_bounds_are_reached_at_the_ends():
    low, high = (FAMILY.values(jnp.full(FAMILY.dim, end)) for end in (0.0, 1.0))
    assert np.asarray(low) == pytest.approx([bound.low for bound in FAMILY.ranges], rel=1e-12)
    assert np.asarray(high) == pytest.approx([bound.high for bound in FAMILY.ranges], rel=1e-12)


@pytest.mark.parametrize(
    "low, high, is_log", [(2.0, 1.0, True), (1.0, 1.0, False), (0.0, 1.0, True), (-1.0, 1.0, True)]
)
def test_bounds_that_do_not_increase_are_refused(low, high, is_log):
    with pytest.raises(ValueError, match="C11: bounds must increase"):
        Range("C11", "N/m", low, high, is_log)


@pytest.mark.parametrize("density, thickness", [(0.0, 1e-3), (-0.1, 1e-3), (0.1, 0.0)])
def test_density_and_thickness_must_be_positive(density, thickness):
    with pytest.raises(ValueError, match="must be positive"):
        OrthotropicSpace.make(density, thickness)


@pytest.mark.parametrize(
    ("density", "membrane", "bending", "reason"),
    [
        (0.0, (1.0, 0.0, 1.0, 1.0), 1e-5, "density must be positive"),
        (0.1, (1.0, 0.0, -1.0, 1.0), 1e-5, "membrane.c22 must be positive"),
        (0.1, (1.0, -1.0, 1.0, 1.0), 1e-5, "C12.2 must be less than C11 C22"),
        (0.1, (1.0, 0.0, 1.0, 1.0), -1e-5, "bending.stiffness must be not negative"),
        (float("nan"), (1.0, 0.0, 1.0, 1.0), 1e-5, "density must be positive"),
        (300.0, (1.0, 0.0, 1.0, 1.0), 1e-5, "0.3 if that is in g/m"),
    ],
)
def test_a_fabric_out_of_its_physical_range_is_refused(density, membrane, bending, reason):
    with pytest.raises(ValueError, match=reason):
        Fabric.make(density, membrane, bending)


def test_an_isotropic_sheet_has_damping_and_friction_where_asked():
    given, free = (IsotropicSpace.make(0.17, losses=losses) for losses in ((), LOSSES))
    assert [each.name for each in free.ranges] == ["E h", "nu", "damping", "friction"]
    place = jnp.array([0.3, 0.6, 0.2, 0.9])
    found = free(place)
    assert found.damping == pytest.approx(float(LOSSES[0].from_unit(place[2])))
    assert found.friction == pytest.approx(float(LOSSES[1].from_unit(place[3])))
    np.testing.assert_allclose(free.to_unit(found), place, rtol=1e-5)
    same = given(place[:2])
    assert (float(same.damping), float(same.friction)) == pytest.approx((0.01, 0.5))
    np.testing.assert_allclose(found.membrane.c11, same.membrane.c11)


def test_a_strip_of_the_bending_length_sags_by_an_eighth_of_it():
    fabric = pink_solid()
    length = float(bending_length(fabric))
    number = float(fabric.density) * GRAVITY * length**3 / float(fabric.bending.stiffness)
    assert number == pytest.approx(1, rel=1e-5)
    assert elastica(number)[1] == pytest.approx(1 / 8, rel=0.05)  # it bends more than slightly


@pytest.mark.slow(group="cloth")
def test_the_bending_length_has_a_gradient_and_a_batch():
    stiffnesses = jnp.array([1e-6, 8e-6])

    def length(bending):
        fabric = Fabric.make(0.2, (30.0, 0.0, 30.0, 10.0), 1e-5)
        return bending_length(eqx.tree_at(lambda f: f.bending.stiffness, fabric, bending))

    lengths = jax.vmap(length)(stiffnesses)
    assert lengths[1] / lengths[0] == pytest.approx(2, rel=1e-5)
    slope = jax.grad(length)(stiffnesses[0])
    assert slope == pytest.approx(float(lengths[0] / (3 * stiffnesses[0])), rel=1e-4)
