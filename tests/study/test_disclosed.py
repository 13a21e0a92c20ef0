"""What the study's approaches are given and told: pulls, data, ranges and fixed values."""

from typing import Any

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s.estimation import default_spaces
from r2s.estimation.method import default_space
from r2s.estimation.pinn.pulls import pulled
from r2s.materials import presets, prior
from r2s.scenarios.paths import LIMITS
from r2s.study import plan as plans
from r2s.study.recordings import pull_of, small_strain
from r2s.study.report.tables import range_table

FABRIC = presets.grey_interlock()
SPACE = default_space("cloth", float(FABRIC.density))


def test_pulls_differ_in_stretch_and_rate_from_angle_to_angle_and_number_to_number():
    drawn = [pull_of(number, angle, 0) for number in range(4) for angle in plans.PULLS]
    for name, (low, high) in LIMITS["stretching"].items():
        values = [each[name] for each in drawn]
        assert len(set(values)) == len(values) and low <= min(values) and max(values) <= high
    assert drawn != [pull_of(number, angle, 1) for number in range(4) for angle in plans.PULLS]


@pytest.mark.slow(group="study")
def test_shorter_steps_of_a_pull_change_the_force_that_holds_it_and_the_markers_little():
    """On the way, in a pull faster than those of the study, the force of a soft knit by 8 %."""
    settings: dict[str, Any] = {"frames": 9, "moving": 0.25, "shape": (5, 5), "key": jr.key(0)}
    exact: dict[str, Any] = {"marker_noise": 0.0, "force_noise": 0.0}
    fine, finer = (pulled(FABRIC, "grey", steps=steps, **settings, **exact) for steps in (3, 6))
    assert fine.markers is not None and finer.markers is not None
    force, other = (np.asarray(each.force)[:, 0] for each in (fine, finer))
    assert abs(force[-1] - other[-1]) < 0.01 * force.max()
    assert np.abs(force - other).max() < 0.1 * force.max()
    assert np.asarray(fine.times) == pytest.approx(np.arange(9) / 30)
    assert np.abs(np.asarray(fine.markers - finer.markers)).max() < 1e-4


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
    space = default_space("points", float(truth.density))
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
    with pytest.raises(ValueError, match="areal density"):
        prior.middle(0.0)


def test_every_range_and_fixed_value_stands_in_the_table():
    table = range_table(plans.synthetic(plans.SMALL))
    shown = set(zip(table.solver, table.parameter, strict=True))
    for solver in ("cloth", "points"):
        space = default_space(solver, 0.2)
        names = [each.name for each in (*space.ranges, *default_spaces.fixed(space))]
        assert {(solver, name) for name in names} <= shown
    assert table["from"].notna().all() and (table["from"] != "").all()
    # as many densities as fabrics
    densities = table[(table.solver == "points") & (table.parameter == "density")]
    assert len(densities) == len(plans.SMALL.fabrics)
