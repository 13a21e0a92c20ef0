"""What the study's approaches are given and told: pulls, data, ranges and fixed values."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s import scenarios
from r2s.estimation import default_spaces
from r2s.estimation.baselines import last_frame
from r2s.estimation.method import default_space
from r2s.estimation.pinn.pulls import pull_from, pulled
from r2s.estimation.prediction import Prediction
from r2s.estimation.problem import POINTS, Problem
from r2s.materials import presets, prior
from r2s.materials.softening_space import SOFTENING
from r2s.materials.stiffening_space import STIFFENING
from r2s.scenarios import synthetic
from r2s.scenarios.standard import LIMITS
from r2s.study import matrix
from r2s.study.cells import with_dependencies
from r2s.study.drawn import pull_of
from r2s.study.estimates import EstimateCell
from r2s.study.report import disclosures
from r2s.study.report.disclosures import range_table
from r2s.study.sources import SyntheticRecording, TruthSettings, small_strain

FABRIC = presets.grey_interlock()
SPACE = default_space("cloth", float(FABRIC.density))


@pytest.fixture(scope="module")
def lift():
    motion: dict[str, Any] = {"height": 0.2, "inward": 0.1, "moving": 1.0}
    experiment = scenarios.lifting(num_frames=24, interval=1 / 15, **motion)
    return synthetic.record(experiment, FABRIC, "grey", shape=(4, 4), key=jr.key(1))


@pytest.fixture(scope="module")
def pull():
    return pulled(FABRIC, "grey", shape=(5, 5), frames=6, moving=0.1, steps=3, key=jr.key(0))


def test_pulls_differ_in_stretch_and_rate_from_angle_to_angle_and_number_to_number():
    drawn = [pull_of(number, angle, 0) for number in range(4) for angle in matrix.PULLS]
    for name, (low, high) in LIMITS["stretching"].items():
        values = [each[name] for each in drawn]
        assert len(set(values)) == len(values) and low <= min(values) and max(values) <= high
    assert drawn != [pull_of(number, angle, 1) for number in range(4) for angle in matrix.PULLS]


def test_a_pull_is_made_in_the_steps_of_truths_and_ends_within_its_frames(monkeypatch, tmp_path):
    from r2s.study import sources

    asked: list[dict[str, Any]] = []
    made = pulled(FABRIC, "grey", shape=(3, 3), frames=6, moving=0.1, key=jr.key(0))

    def instead(fabric, name, angle, **others):
        asked.append(others)
        return made

    monkeypatch.setattr(sources, "pulled", instead)
    for angle in matrix.PULLS:
        SyntheticRecording("grey_interlock", "stretching", 2, angle=angle).make(tmp_path, tmp_path)
    assert len({each["strain"] for each in asked}) == len(matrix.PULLS)
    assert all(1 / 30 / each["steps"] <= TruthSettings().max_step + 1e-9 for each in asked)
    assert all(each["shape"] == TruthSettings().shape for each in asked)
    assert (sources.PULL_FRAMES - 1) / 30 >= LIMITS["stretching"]["moving"][1]


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


def poisoned(recording, frames):
    """With other points in these frames, as many as before."""
    points = np.asarray(recording.points).copy()
    points[list(frames)] += 0.02
    return dataclasses.replace(recording, points=jnp.asarray(points))


def alike(one, other) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def others(recording, frames):
    return sorted(set(range(len(recording.times))) - set(frames))


@pytest.mark.parametrize("name", ["diffcloud", "diffcp", "cma-es"])
def test_descents_read_some_points_of_the_frames_that_count(lift, name):
    reads = METHODS[name]().reads(lift)
    assert (reads.points, reads.markers, reads.force) == (POINTS, False, False)
    problem = Problem.make(lift, SPACE, shape=(4, 4))
    assert alike(
        problem, Problem.make(poisoned(lift, others(lift, reads.frames)), SPACE, shape=(4, 4))
    )
    assert problem.clouds is not None and problem.clouds.points.shape[1] == reads.points
    for frame in (reads.frames[0], reads.frames[-1]):
        changed = Problem.make(poisoned(lift, [frame]), SPACE, shape=(4, 4))
        assert not alike(problem, changed)


def test_descents_read_markers_instead_of_clouds_and_the_force_where_it_was_measured(pull):
    reads = METHODS["diffcloud"]().reads(pull)
    assert (reads.points, reads.markers, reads.force) == (0, True, True)
    problem = Problem.make(pull, SPACE, shape=(5, 5))
    assert alike(problem, Problem.make(poisoned(pull, reads.frames), SPACE, shape=(5, 5)))
    without = dataclasses.replace(pull, force=None, force_times=None)
    assert not METHODS["diffcloud"]().reads(without).force
    assert Problem.make(without, SPACE, shape=(5, 5)).force is None


def test_the_network_reads_markers_and_force_and_no_clouds(pull):
    reads = METHODS["pinn"]().reads(pull)
    assert (reads.points, reads.markers, reads.force) == (0, True, True)
    assert alike(pull_from(pull), pull_from(poisoned(pull, reads.frames)))
    without = dataclasses.replace(pull, force=None, force_times=None)
    with pytest.raises(ValueError, match="no force"):
        pull_from(without)
    with pytest.raises(ValueError, match="no markers"):
        pull_from(dataclasses.replace(pull, markers=None, markers_seen=None))
    published = METHODS["pinn-published"]().reads(pull)
    assert published.markers and not published.force
    given = [pull_from(each, without_force=True) for each in (pull, without)]
    assert alike(*given)


def test_images_are_made_of_some_frames(lift):
    from r2s.estimation.physnet.images import of_clouds, view_around

    reads = METHODS["physnet"]().reads(lift)
    assert reads.points is None and len(reads.frames) == 8
    x = np.asarray(lift.points)[np.asarray(lift.mask)]
    view = view_around((0.2, -0.6, 0.6), x, 32, 0.0)
    seen = of_clouds(view, lift, reads.frames)
    hidden = poisoned(lift, others(lift, reads.frames))
    assert np.array_equal(seen, of_clouds(view, hidden, reads.frames))
    changed = of_clouds(view, poisoned(lift, reads.frames[-1:]), reads.frames)
    assert not np.array_equal(seen, changed)


def test_the_published_recipe_reads_the_last_frame_alone(lift):
    reads = METHODS["diffcloud-published"](shape=(4, 4)).reads(lift)
    assert reads.frames == (lift.info.frames_used[1],)
    problem = Problem.make(lift, SPACE, shape=(4, 4))
    x = jnp.zeros((len(problem.frames), 16, 3))

    def loss(recording):
        seen = Prediction(x, None, jnp.asarray(True))
        return float(last_frame(Problem.make(recording, SPACE, shape=(4, 4)), seen))

    assert loss(lift) == loss(poisoned(lift, others(lift, reads.frames)))
    assert loss(lift) != loss(poisoned(lift, reads.frames))


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
    table = range_table(matrix.synthetic(matrix.SMALL))
    told = set(zip(table.solver, table.parameter, strict=True))
    for solver in ("cloth", "points"):
        space = default_space(solver, 0.2)
        names = [bound.name for bound in space.ranges]
        names += [each.name for each in default_spaces.fixed(space)]
        assert {(solver, name) for name in names} <= told
    laws = {each.name for each in (*STIFFENING, *SOFTENING)}  # of a lift and pulls together
    assert {("cloth", name) for name in laws} <= told
    alone = matrix.with_changes(matrix.SMALL, ["physnet-cloth-lifting"])
    assert not laws & set(range_table(matrix.synthetic(alone)).parameter)
    assert table["from"].notna().all() and (table["from"] != "").all()
    # as many densities as fabrics
    densities = table[(table.solver == "points") & (table.parameter == "density")]
    assert len(densities) == len(matrix.SMALL.fabrics)


def test_the_data_of_every_approach_stand_in_the_table(monkeypatch, lift, pull):
    monkeypatch.setattr(SyntheticRecording, "is_made", lambda self, folder: True)
    monkeypatch.setattr(
        disclosures, "read", lambda source, folder: pull if source.angle is not None else lift
    )
    plan = dataclasses.replace(matrix.SMALL, fabrics=("grey_interlock",))
    cells = with_dependencies(matrix.synthetic(plan))
    made = [cell for cell in cells if isinstance(cell, EstimateCell)]
    table = disclosures.data_table(made, Path()).set_index(["approach", "motion"])
    assert {(f"{c.approach} on {c.solver}", c.scenario) for c in made} == set(table.index)
    assert list(table.loc[("pinn on cloth", "stretching")]) == [
        3, "6", False, True, True, "flat", "linear"
    ]  # fmt: skip
    assert list(table.loc[("physnet on cloth", "lifting")])[:4] == [1, "8", True, False]
    together = table.loc[("diffcloud on cloth", "lifting+stretching")]
    assert (together.prior, together.laws) == ("fabrics", "stiffening+softening")
    assert table.loc[("diffcloud on cloth", "lifting")].laws == "linear"
