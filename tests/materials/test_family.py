"""Families: the unit cube and the fabrics it stands for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.materials.fabric import Fabric
from r2s.materials.parameters import (
    LOSSES,
    IsotropicSpace,
    OrthotropicSpace,
    Range,
)
from r2s.materials.presets import FIVE

few = settings(max_examples=25, deadline=None)
FAMILY = OrthotropicSpace.make(0.2)
places = st.tuples(*[st.floats(0, 1)] * FAMILY.dim).map(np.array)
there_and_back = jax.jit(lambda u: FAMILY.to_unit(FAMILY(u)))


@given(places)
@few
def test_a_fabric_is_located_where_it_came_from(place):
    assert np.asarray(there_and_back(jnp.asarray(place))) == pytest.approx(place, abs=1e-9)


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


@given(places)
@few
def test_every_fabric_of_the_cube_is_stable(place):
    law = FAMILY(jnp.asarray(place)).membrane
    stiffness = np.array([[float(law.c11), float(law.c12)], [float(law.c12), float(law.c22)]])
    assert np.linalg.eigvalsh(stiffness)[0] > 0
    assert law.c33 > 0


def test_every_fabric_has_the_density_and_thickness_of_the_family():
    fabric = OrthotropicSpace.make(0.17, 2e-3)(jnp.linspace(0.0, 1.0, 7))
    assert (float(fabric.density), float(fabric.thickness)) == (0.17, 2e-3)


def test_the_middle_is_the_geometric_one():
    fabric = FAMILY.middle()
    assert fabric.membrane.c11 == pytest.approx((3.0 * 3000.0) ** 0.5)
    assert fabric.bending.stiffness == pytest.approx((1e-7 * 1e-3) ** 0.5)
    assert fabric.membrane.c12 == pytest.approx(0, abs=1e-12)  # the coupling's scale is linear


@given(st.floats(0.1, 10), st.floats(1.1, 100), st.floats(-1, 2), st.booleans())
@few
def test_value_and_place_of_a_range_are_inverse(low, ratio, place, is_log):
    bound = Range("any", "-", low, low * ratio, is_log)
    value = bound.from_unit(jnp.array(place))
    assert bound.to_unit(value) == pytest.approx(place, abs=1e-9)


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


BAD = {
    "density": ((0.0, (1.0, 0.0, 1.0, 1.0), 1e-5), "density .* must be positive"),
    "stiffness": ((0.1, (1.0, 0.0, -1.0, 1.0), 1e-5), "must be positive"),
    "coupling": ((0.1, (1.0, -1.0, 1.0, 1.0), 1e-5), "C12.2 must be less than C11 C22"),
    "bending": ((0.1, (1.0, 0.0, 1.0, 1.0), -1e-5), "must not be negative"),
    "not a number": ((float("nan"), (1.0, 0.0, 1.0, 1.0), 1e-5), "must be positive"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_fabric_out_of_its_physical_range_is_refused(name):
    arguments, reason = BAD[name]
    with pytest.raises(ValueError, match=reason):
        Fabric.make(*arguments)


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
