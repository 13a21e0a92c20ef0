"""The length at which fabrics fold: that of a strip whose sag is an eighth of it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from elastica import elastica

from r2s._util.units import GRAVITY
from r2s.materials import presets
from r2s.materials.fabric import Fabric, bending_length


def test_a_strip_of_this_length_sags_by_an_eighth_of_it():
    fabric = presets.pink_solid()
    length = float(bending_length(fabric))
    number = float(fabric.density) * GRAVITY * length**3 / float(fabric.bending.stiffness)
    assert number == pytest.approx(1, rel=1e-5)
    assert elastica(number)[1] == pytest.approx(1 / 8, rel=0.05)  # it bends more than slightly


@pytest.mark.slow(group="cloth")
def test_it_has_a_gradient_and_a_batch():
    stiffnesses = jnp.array([1e-6, 8e-6])

    def length(bending):
        fabric = Fabric.make(0.2, (30.0, 0.0, 30.0, 10.0), 1e-5)
        return bending_length(eqx.tree_at(lambda f: f.bending.stiffness, fabric, bending))

    found = jax.vmap(length)(stiffnesses)
    assert found[1] / found[0] == pytest.approx(2, rel=1e-5)
    slope = jax.grad(length)(stiffnesses[0])
    assert slope == pytest.approx(float(found[0] / (3 * stiffnesses[0])), rel=1e-4)
