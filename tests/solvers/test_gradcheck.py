"""The check of derivatives tells right ones from wrong ones, and both from rough functions."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from r2s.materials import presets
from r2s.solvers.gradient_check import compare, judge


def verdict(function, i: int, slope: float) -> str:
    return judge("it", function, jnp.array([2.0, 0.0]), i, slope).verdict


def test_derivatives_are_told_from_wrong_and_from_rough_ones() -> None:
    def smooth(v):
        return v[0] ** 3 + jnp.sin(v[1])

    assert verdict(smooth, 0, 12.0) == "agrees" and verdict(smooth, 1, 1.0) == "agrees"
    assert verdict(smooth, 0, 12.1) == "differs" and verdict(smooth, 1, 0.0) == "differs"
    assert verdict(smooth, 0, float("nan")) == "not finite"

    def jump(v):
        return smooth(v) + jnp.where(v[0] > 2.0001, 1e-2, 0.0)

    assert verdict(jump, 0, 12.0) == "rough"
    assert verdict(lambda v: jnp.asarray(7.0) + 0 * v[0], 0, 0.0) == "agrees"  # no influence


@jax.custom_jvp
def wrong(x):
    return x**2


wrong.defjvp(lambda primals, tangents: (wrong(*primals), 3.0 * primals[0] * tangents[0]))


@pytest.mark.parametrize("forward", [False, True])
def test_every_number_of_a_fabric_is_checked(forward: bool) -> None:
    fabric = presets.black_denim()

    def function(fabric):
        return fabric.density * fabric.membrane.c11 + wrong(fabric.friction)

    rows = {row.parameter: row for row in compare(function, fabric, forward=forward)}
    assert rows.keys() >= {"density", "membrane.c11", "bending.stiffness", "mass_damping"}
    assert rows["density"].derivative == pytest.approx(210) and len(rows) == 11
    assert rows.pop("friction").verdict == "differs"
    assert {row.verdict for row in rows.values()} == {"agrees"}


def test_numbers_of_arrays_have_indices() -> None:
    from r2s.materials.tables import TableMembrane

    table = TableMembrane(jnp.ones((6, 4)))
    fabric = dataclasses.replace(presets.black_denim(), membrane=table)
    rows = compare(lambda fabric: jnp.sum(fabric.membrane.stiffness**2), fabric)
    assert [row.parameter for row in rows][1:3] == [
        "membrane.stiffness[0]",
        "membrane.stiffness[1]",
    ]
    assert len(rows) == 31 and {row.verdict for row in rows} == {"agrees"}
