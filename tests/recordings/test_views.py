"""What known cameras must have seen of a sheet, and what that says of a simulated one."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s import scenarios
from r2s.estimation import normal_equations
from r2s.estimation.default_spaces import on_mpm
from r2s.estimation.gauss_newton import normals_at
from r2s.estimation.prediction import predict
from r2s.estimation.problem import NuisancePrior, Problem, check_shared, problems_on_mpm
from r2s.materials import presets
from r2s.materials.parameters import OrthotropicSpace
from r2s.mesh.mesh import rectangle
from r2s.mesh.surface import sample
from r2s.metrics.losses import to_surface
from r2s.recordings.cameras import DepthCamera, look_at
from r2s.recordings.clouds import Cleaning
from r2s.recordings.recording import MeasurementUncertainty, Recording, load, save
from r2s.recordings.views import Views, in_view, observed, shifted
from r2s.scenarios import synthetic

BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
WHOLE = Cleaning(BOX, voxel=0.0, neighbours=0)
FABRIC = presets.grey_interlock()
FAMILY = OrthotropicSpace.make(float(FABRIC.density))
NOBODY = jnp.full((1, 3), 9.0)  # a gripper that is far away


def camera(position, target=(0.0, 0.0, 0.0)) -> DepthCamera:
    return DepthCamera((320, 240), (300.0, 300.0), (159.5, 119.5), look_at(position, target), 1e-3)


ABOVE = camera((0.05, -0.1, 1.0))
FACES = np.asarray(rectangle((0.3, 0.3), (31, 31)).faces)


def sheet(height: float, side: float = 0.3) -> np.ndarray:
    flat = np.asarray(rectangle((side, side), (31, 31)).rest) - side / 2
    return np.pad(flat, ((0, 0), (0, 1)), constant_values=height)


def test_a_sheet_below_another_is_hidden_where_the_other_is():
    upper, lower = sheet(0.1, 0.15), sheet(0.0)
    both = jnp.asarray(np.concatenate([upper, lower]))
    seen = np.asarray(in_view(Views((ABOVE,), WHOLE), both, NOBODY))
    assert seen[: len(upper)].all()
    beyond = np.abs(lower[:, :2]).max(axis=1) > 0.11  # perspective and cells widen the shadow
    below = np.abs(lower[:, :2]).max(axis=1) < 0.05
    assert seen[len(upper) :][beyond].mean() > 0.98 and not seen[len(upper) :][below].any()


def test_two_cameras_see_what_either_sees_and_a_gripper_hides_what_is_near_it():
    both = jnp.asarray(np.concatenate([sheet(0.1), sheet(0.0)]))
    below = camera((0.0, 0.1, -1.0))
    of = [np.asarray(in_view(Views(c, WHOLE), both, NOBODY)) for c in ((ABOVE,), (below,))]
    whole = np.asarray(in_view(Views((ABOVE, below), WHOLE), both, NOBODY))
    np.testing.assert_array_equal(whole, of[0] | of[1])
    near = np.asarray(in_view(Views((ABOVE, below), WHOLE, hidden=0.1), both, jnp.zeros((1, 3))))
    np.testing.assert_array_equal(near, whole & (np.linalg.norm(both, axis=1) > 0.1))


def test_a_frame_shows_what_the_cameras_that_took_it_see():
    """Out of phase: one after the other."""
    both = jnp.asarray(np.concatenate([sheet(0.1), sheet(0.0)]))
    cameras = ABOVE, camera((0.0, 0.1, -1.0))
    views = Views(cameras, WHOLE, taken=((0,), (1,), (0, 1)))
    for frame, taken in enumerate(([True, False], [False, True], [True, True])):
        alone = Views(tuple(c for c, t in zip(cameras, taken, strict=True) if t), WHOLE)
        np.testing.assert_array_equal(
            in_view(views, both, NOBODY, jnp.array(taken)), in_view(alone, both, NOBODY)
        )
        seen = [observed(each, sheet(0.0), FACES, n) for each, n in ((views, frame), (alone, 0))]
        np.testing.assert_array_equal(seen[0], seen[1])


def test_the_workspace_less_its_border_is_what_counts():
    x = jnp.asarray(sheet(0.0))
    narrow = dataclasses.replace(WHOLE, workspace=((-0.1, -1.0, -1.0), (0.1, 1.0, 1.0)))
    seen = np.asarray(in_view(Views((ABOVE,), narrow, border=0.02), x, NOBODY))
    np.testing.assert_array_equal(seen, np.abs(np.asarray(x)[:, 0]) < 0.08)


@pytest.mark.slow(group="motions")
def test_samples_in_view_are_those_near_which_the_exact_images_have_points():
    mesh = rectangle((0.3, 0.3), (31, 31))
    rest = np.asarray(mesh.rest)
    angle = np.clip((rest[:, 0] - 0.12) / 0.06, 0, 1) * np.pi  # folded over, 4 cm thick
    along = np.where(rest[:, 0] < 0.15, rest[:, 0], 0.3 - rest[:, 0])
    x = np.stack([along, rest[:, 1] - 0.15, 0.04 * (1 - np.cos(angle)) / 2], axis=1)
    views = Views((camera((0.5, -0.3, 0.8), (0.1, 0.0, 0.0)),), WHOLE)
    faces = np.asarray(mesh.faces)
    points = observed(views, x, faces)
    assert to_surface([points], x[None], mesh.faces)[0] < 1e-6
    samples = np.asarray(sample(jnp.asarray(x), mesh.faces, 1))
    seen = np.asarray(in_view(views, jnp.asarray(samples), NOBODY))
    apart = np.linalg.norm(samples[:, None] - points[None, ::5], axis=-1).min(axis=1)
    assert np.mean(seen == (apart < 0.006)) > 0.93
    assert 0.3 < seen.mean() < 0.8


def test_the_outlier_filter_takes_the_borders_of_a_sheet():
    filtered = dataclasses.replace(WHOLE, neighbours=60, deviations=0.5)
    whole, eroded = (observed(Views((ABOVE,), c), sheet(0.0), FACES) for c in (WHOLE, filtered))
    assert len(eroded) < len(whole)
    assert np.abs(whole[:, :2]).max() - np.abs(eroded[:, :2]).max() > 2e-3


def test_views_move_with_the_clouds():
    x, faces = sheet(0.0), FACES
    shift = (0.02, -0.03, 0.04)
    views = Views((ABOVE,), dataclasses.replace(WHOLE, workspace=((-0.1, -1.0, -1.0), BOX[1])))
    moved = observed(shifted(views, shift), x + np.array(shift), faces)
    np.testing.assert_allclose(moved, observed(views, x, faces) + np.array(shift), atol=1e-9)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"cameras": ()}, "need a camera"),
        ({"border": 1.5, "hidden": 0.1}, "no room"),
        ({"hidden": -0.1}, "must not be negative"),
    ],
)
def test_views_that_cannot_be_are_refused(changed, words):
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(Views((ABOVE,), WHOLE), **changed)


@pytest.fixture(scope="module")
def lifted() -> Recording:
    """A soft sheet, lifted, whose whole surface two cameras see."""
    experiment = scenarios.lifting(num_frames=6, interval=1 / 10, height=0.25, moving=0.5)
    everywhere = synthetic.Sensing((), BOX, outliers=0.0, margin=-np.inf)
    made = synthetic.record(
        experiment, FABRIC, "grey", shape=(5, 5), seen=everywhere, key=jr.key(1)
    )
    eyes = (camera((0.9, 0.2, 0.7), (0.2, 0.2, 0.1)), camera((-0.6, 0.3, 0.5), (0.2, 0.2, 0.1)))
    lowest = float(jnp.min(jnp.where(made.mask, made.points[..., 2], jnp.inf)))  # cropped there
    box = ((-1.0, -1.0, lowest), BOX[1])
    views = Views(eyes, dataclasses.replace(WHOLE, workspace=box), border=0.01, hidden=0.02)
    doubt = MeasurementUncertainty((0.01, 0.02, 0.03), 0.1, 0.05, 0.02)
    return dataclasses.replace(made, info=dataclasses.replace(made.info, views=views, doubt=doubt))


@pytest.mark.slow(group="motions")
def test_a_recording_keeps_its_cameras_and_doubt(lifted: Recording, tmp_path: Path):
    save(lifted, tmp_path / "lift.npz")
    assert load(tmp_path / "lift.npz").info == lifted.info
    problem = Problem.make(lifted, FAMILY, shape=(5, 5))
    assert problem.nuisance_prior.scales == (0, 0, 0.02, 0.01, 0.02, 0.03, 0.1, 0.05)
    with pytest.raises(ValueError, match="must not be negative"):
        MeasurementUncertainty((0.01, -0.02, 0.03), 0.1)


@pytest.fixture(scope="module")
def problem(lifted: Recording) -> Problem:
    return Problem.make(lifted, FAMILY, shape=(5, 5), num_points=60)


def theta_of(problem: Problem, place) -> jax.Array:
    return jnp.concatenate([place, jnp.zeros(len(problem.nuisance_prior.scales))])


@pytest.mark.slow(group="motions")
def test_a_sheet_that_is_larger_than_its_clouds_is_found_by_what_should_have_been_seen(problem):
    """Clouds of one half of the sheet lie on the whole of it; the other half lies near no cloud."""
    theta = theta_of(problem, FAMILY.to_unit(FABRIC))
    seen = jax.jit(predict)(problem, theta)
    counted = np.asarray(normal_equations._to_clouds(problem.expected, seen.x)[1])
    assert counted.mean() > 0.15

    def half(part):
        left = part.targets if hasattr(part, "targets") else part.points
        return part.mask & (left[..., 0] < jnp.median(left[..., 0]))

    cut = dataclasses.replace(
        problem,
        clouds=dataclasses.replace(problem.clouds, mask=half(problem.clouds)),
        expected=dataclasses.replace(problem.expected, mask=half(problem.expected)),
    )
    blind = dataclasses.replace(cut, expected=None)
    one_way = [
        float(normal_equations.loss_of(part, seen))
        for part in (dataclasses.replace(problem, expected=None), blind)
    ]
    both = [float(normal_equations.loss_of(part, seen)) for part in (problem, cut)]
    assert one_way[1] == pytest.approx(one_way[0], rel=0.5)  # what is left lies on the sheet
    assert both[0] < 3 * one_way[0] and both[1] > 20 * both[0]


@pytest.mark.slow(group="motions")
def test_what_should_have_been_seen_has_the_gradient_that_differences_have(problem):
    place = FAMILY.to_unit(FABRIC) + 0.1
    alone = dataclasses.replace(problem, clouds=None)  # the nearest points of both may change
    theta = theta_of(alone, place).at[7:].set(jnp.array([0, 0, 0.5, 1.2, -1.1, 0.9, 0.4, -0.3]))
    (normal,), loss = normals_at((alone,), [theta], [jnp.zeros(())]), []
    for index in (0, 2, 9, 10, 13, 14):  # fabric, size, shift, turn, clock
        width = 1e-5
        steps = [theta.at[index].add(s * width) for s in (1, -1)]
        loss = [n.loss for n in normals_at((alone,), steps, [jnp.zeros(())] * 2)]
        difference = float(loss[0] - loss[1]) / (2 * width)
        most = float(jnp.max(jnp.abs(normal.gradient)))
        assert float(normal.gradient[index]) == pytest.approx(difference, rel=1e-2, abs=1e-3 * most)


@pytest.mark.slow(group="motions")
def test_on_material_points_the_size_is_taken_as_written_down(lifted):
    """Else a recording that doubts its size could not be simulated on them at all."""
    (made,) = problems_on_mpm([lifted], on_mpm(0.2), (5, 5))
    assert made.nuisance_prior == NuisancePrior((0.01, 0.02, 0.03), 0.1, 0.05)
    theta = theta_of(made, jnp.full(made.space.dim, 0.5))
    assert jax.eval_shape(predict, made, theta).x.shape[1:] == (25, 3)


def test_recordings_that_doubt_one_size_unlike_are_not_estimated_from_together(problem):
    exact = dataclasses.replace(problem, nuisance_prior=problem.nuisance_prior._replace(size=0.0))
    check_shared((problem, exact, problem))
    wider = dataclasses.replace(problem, nuisance_prior=problem.nuisance_prior._replace(size=0.1))
    with pytest.raises(ValueError, match=r"the size of a fabric is in doubt by \[0.02, 0.1\]"):
        check_shared((problem, wider))
