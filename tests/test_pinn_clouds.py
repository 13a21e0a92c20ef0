"""Points matched to the network's own map, the balance of a hanging sheet, and what comes of it."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s.estimation.pinn import from_clouds, hanging_sheet, matching
from r2s.estimation.pinn.hanging_sheet import Hanging, curvature, loose, splines, work_scale
from r2s.estimation.pinn.matching import Sight, above, fixed, sight_of
from r2s.estimation.pinn.network import Jet, Network
from r2s.fabrics import presets
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import OrthotropicSpace
from r2s.geometry.mesh import rectangle
from r2s.scenarios import lifting, synthetic, wind
from r2s.world.air import Air

SIZE, TIMES = (0.3, 0.2), (0.0, 0.5, 1.0)  # [m], [s]
DENSITY = 0.2  # [kg/m^2]
FAMILY = OrthotropicSpace.make(DENSITY)


def network(scale: float = 0.0) -> Network:
    """A map that leaves the sheet flat, or one with gentle waves of some scale [m]."""
    low, high = jnp.zeros(3), jnp.array([*SIZE, 1.0])
    scale_array = jnp.asarray(scale, float)
    return Network.make(low, high, scale_array, axes=3, width=6, layers=3, key=jr.key(0))


def sight(points, cloud=None) -> Sight:
    """The same points in every frame; a table far below."""
    cloud = points if cloud is None else cloud
    points, cloud = (jnp.tile(jnp.asarray(p, float), (len(TIMES), 1, 1)) for p in (points, cloud))
    return Sight(
        size=jnp.array(SIZE),
        times=jnp.array(TIMES),
        points=points,
        mask=jnp.ones(points.shape[:2], bool),
        cloud=cloud,
        there=jnp.ones(cloud.shape[:2], bool),
        corners=jnp.zeros((1, 2)),
        grips=jnp.zeros((len(TIMES), 1, 3)),
        up=jnp.array([0.0, 0.0, 1.0]),
        table=jnp.asarray(-1.0),
    )


MESH = rectangle(SIZE, (9, 7))


def scattered(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.02, 0.98, (count, 2)) * np.array(SIZE)


def test_a_point_is_matched_to_the_place_under_it():
    places = scattered(40)
    points = np.column_stack([places, np.full(40, 0.004)])
    rows, spread = matching.matched(network(), sight(points), MESH)
    np.testing.assert_allclose(rows.place[:40, :2], places, atol=1e-9)
    np.testing.assert_allclose(rows.place[40:80, 2], TIMES[1])
    np.testing.assert_allclose(np.abs(rows.direction[:, 2]), 1, rtol=1e-9)
    np.testing.assert_allclose(spread, 1.4826 * 0.004, rtol=1e-6)
    # all residuals are the height, over the spread
    at = np.asarray(matching.placed(network(), rows.place))
    off = np.einsum("ri,ri->r", at - rows.target, rows.direction)
    np.testing.assert_allclose(np.abs(off), 0.004, rtol=1e-6)


def test_an_outlier_hardly_counts_and_padding_not_at_all():
    points = np.column_stack([scattered(40), np.full(40, 1e-3)])
    points[7, 2] = 0.05
    given = sight(points)
    given = eqx.tree_at(lambda s: s.mask, given, given.mask.at[:, 9].set(False))
    rows, _ = matching.matched(network(), given, MESH)
    weight = np.asarray(rows.weight).reshape(3, 40)
    assert (weight[:, 7] < 0.02 * weight[:, 8]).all()
    assert (weight[:, 9] == 0).all()


@pytest.mark.parametrize("stretch", [-0.02, 0.0, 0.02])
def test_the_border_of_the_cloud_says_how_long_the_sheet_is(stretch):
    """Of 4,000 points the outermost tell it to a tenth of the distance between points."""
    places = np.random.default_rng(0).uniform(0, 1, (4000, 2)) * np.array(SIZE)
    places[:, 0] *= 1 + stretch
    noise = 1e-4 * np.random.default_rng(2).normal(size=(4000, 3))
    cloud = np.column_stack([places, np.zeros(4000)]) + noise
    rows = matching.bordered(network(), sight(cloud[:5], cloud))
    at = np.asarray(matching.placed(network(), rows.place))
    ends = np.asarray(rows.place)[:, 0] > 0.99 * SIZE[0]
    moved = np.einsum("ri,ri->r", rows.target - at, rows.direction)
    assert (np.asarray(rows.weight) > 0).all()
    # where points are at random, spacing and noise leave about a millimetre
    np.testing.assert_allclose(moved[ends].mean(), stretch * SIZE[0], atol=6e-4)
    sides = (np.asarray(rows.place)[:, 1] < 1e-9) & ~ends
    np.testing.assert_allclose(moved[sides].mean(), 0, atol=6e-4)


def test_a_hidden_border_does_not_count():
    places = scattered(2000)
    kept = places[places[:, 0] < 0.5 * SIZE[0]]
    cloud = np.column_stack([kept, np.zeros(len(kept))])
    rows = matching.bordered(network(), sight(cloud[:5], cloud))
    ends = np.asarray(rows.place)[:, 0] > 0.99 * SIZE[0]
    assert (np.asarray(rows.weight)[ends] == 0).all()


def test_what_is_below_the_table_is_lifted():
    given = eqx.tree_at(lambda s: s.table, sight(np.zeros((3, 3))), jnp.asarray(0.002))
    rows = above(network(), given, MESH)
    np.testing.assert_allclose(rows.target[:, 2], 0.002)
    assert (np.asarray(rows.weight) > 0).all()
    assert (np.asarray(above(network(), sight(np.zeros((3, 3))), MESH).weight) == 0).all()


def test_grips_hold_in_all_directions():
    targets = jnp.arange(18.0).reshape(3, 2, 3)
    rows = fixed(jnp.array([[0.0, 0.0], [0.3, 0.0]]), jnp.array(TIMES), targets, 1e-3)
    np.testing.assert_allclose(rows.target[::3], targets.reshape(-1, 3))
    np.testing.assert_allclose(rows.place[3], [0.3, 0.0, 0.0])
    np.testing.assert_allclose(jnp.sum(rows.direction[:3], axis=0), 1.0)


PARTS = splines()


def test_virtual_displacements_add_up_to_a_rigid_one():
    """B-splines are a partition of one; their slopes and curvatures cancel."""
    np.testing.assert_allclose(jnp.sum(PARTS.value, axis=0), 1, rtol=1e-9)
    np.testing.assert_allclose(jnp.sum(PARTS.slope, axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(jnp.sum(PARTS.curve, axis=0), 0, atol=1e-8)
    np.testing.assert_allclose(jnp.sum(PARTS.weights), 1, rtol=1e-9)


def test_what_is_held_or_low_is_left_out():
    held = jnp.array([True, False, False, False])
    none = jnp.zeros(len(PARTS.nodes), bool)
    free = np.asarray(loose(PARTS, held, none))
    assert free.sum() == 100 - 9  # those of the corner's span
    low = PARTS.nodes[:, 1] > 0.8
    free = np.asarray(loose(PARTS, held, low))
    np.testing.assert_allclose(np.asarray(PARTS.value)[free][:, np.asarray(low)], 0)


def test_curvature_of_a_cylinder():
    radius, at = 0.1, 0.7
    slope = jnp.array([[jnp.cos(at), 0], [0, 1], [-jnp.sin(at), 0]])
    second = jnp.array([[-jnp.sin(at), 0, 0], [0, 0, 0], [-jnp.cos(at), 0, 0]]) / radius
    np.testing.assert_allclose(jnp.abs(curvature(slope, second)), [1 / radius, 0, 0], atol=1e-12)


def hanging(down=(0.0, 1.0, 0.0), air: float = 0.0) -> Hanging:
    return Hanging(jnp.array(SIZE), jnp.array(down), Air.make(density=air), None, jnp.zeros(3))


@eqx.filter_jit
def work(field: Any, acting: Hanging, fabric: Fabric, time=0.3):
    return hanging_sheet.virtual_work(field, acting, fabric, PARTS, jnp.asarray(time))


def jet_of(values, slopes, curves) -> Jet:
    """At rest: without rates."""
    zero = jnp.zeros_like(values)
    second = jnp.stack([*jnp.moveaxis(curves, -1, 0), zero])
    return Jet(values, jnp.stack([*jnp.moveaxis(slopes, -1, 0), zero]), second)


class Given(eqx.Module):
    """A motion whose jets at the nodes are given."""

    found: Jet

    def __call__(self, points):
        del points
        return self.found.value

    def jet(self, points, pairs):
        del points, pairs
        return self.found


def test_a_sheet_that_hangs_by_an_edge_is_in_balance():
    """Its stress is the weight below, and its strain that over the stiffness: a small one."""
    stiffness = 2e6
    fabric = Fabric.make(DENSITY, (stiffness, 0.0, stiffness, stiffness / 2), 0.0)
    y, zero = PARTS.nodes[:, 1] * SIZE[1], jnp.zeros(len(PARTS.nodes))
    load = DENSITY * 9.81 / stiffness
    sinks = jnp.stack([zero, load * (SIZE[1] * y - y**2 / 2), zero], axis=1)
    slopes = jnp.zeros((len(y), 3, 2)).at[:, 1, 1].set(load * (SIZE[1] - y))
    curves = jnp.zeros((len(y), 3, 3)).at[:, 1, 2].set(-load)
    found = work(Given(jet_of(sinks, slopes, curves)), hanging(), fabric)
    free = np.arange(100) % 10 > 0  # all but those of the held edge
    scale = np.asarray(work_scale(hanging(), jnp.asarray(DENSITY), PARTS))
    assert np.abs(np.asarray(found) / scale[:, None])[free].max() < 1e-5
    heavier = dataclasses.replace(fabric, density=jnp.asarray(2 * DENSITY))
    off = work(Given(jet_of(sinks, slopes, curves)), hanging(), heavier)
    assert np.abs(np.asarray(off) / scale[:, None])[free].max() > 0.01


def test_work_is_the_derivative_of_the_energy():
    """Of membrane and bending, on a wavy sheet, along a virtual displacement."""
    fabric = Fabric.make(DENSITY, (90.0, 20.0, 60.0, 25.0), 1e-3)
    wavy, acting = network(0.05), hanging((0.0, 0.0, 0.0))
    which, direction = 27, jnp.array([0.3, -0.5, 0.8])
    slope = PARTS.slope[which] / jnp.array(SIZE)[None]
    x, y = SIZE
    curve = PARTS.curve[which] / jnp.array([x * x, x * y, y * y])[None]
    along = jet_of(
        PARTS.value[which][:, None] * direction[None],
        direction[None, :, None] * slope[:, None],
        direction[None, :, None] * curve[:, None],
    )
    points = jnp.pad(PARTS.nodes * jnp.array(SIZE)[None], ((0, 0), (0, 1)), constant_values=0.3)

    def energy(share):
        jet = jax.tree.map(
            lambda a, b: a + share * b, wavy.jet(points, hanging_sheet.STRONG), along
        )
        flat, moved = jnp.eye(3, 2), jnp.moveaxis(jet.first[:2], 0, -1)
        second = jnp.moveaxis(jet.second[:3], 0, -1)

        def node(gradient, second):
            bent = fabric.bending.energy_density(curvature(gradient + flat, second))
            return fabric.membrane.energy_density(hanging_sheet.green(gradient)) + bent

        return PARTS.weights @ jax.vmap(node)(moved, second) * x * y

    still = dataclasses.replace(fabric, density=jnp.zeros(()))
    found = work(wavy, acting, still)[which] @ direction
    np.testing.assert_allclose(found, jax.grad(energy)(0.0), rtol=1e-8)


def test_air_resists_the_motion():
    """A flat sheet that rises through still air: drag on its area, downwards."""
    rate = jnp.zeros((3, len(PARTS.nodes), 3)).at[2, :, 2].set(2.0)
    zero = jnp.zeros((len(PARTS.nodes), 3))
    rising = Given(Jet(zero, rate, jnp.zeros((4, *zero.shape))))
    fabric = Fabric.make(DENSITY, (90.0, 20.0, 60.0, 25.0), 1e-5)
    found = jnp.sum(work(rising, hanging((0.0, 0.0, 0.0), 1.2), fabric)[:, 2])
    np.testing.assert_allclose(found, 1.2 * 2.0 / 2 * 2.0**2 * SIZE[0] * SIZE[1], rtol=1e-6)


def recorded(experiment, frames: int = 8):
    """A cloud of the sheet as it lies, in every frame."""
    count = 200
    places = np.random.default_rng(0).uniform(0, 0.45, (count, 2))
    sheet = experiment.sheet
    axes = np.array([sheet.warp, sheet.weft])
    world = np.asarray(sheet.origin) + places @ axes
    info = synthetic.RecordingInfo(
        "test", experiment.name, "none", "1", "test", (0, frames - 1), sheet, 0.0, None
    )
    times = np.asarray(experiment.times)[:frames]
    path = experiment.route.path
    return synthetic.make_recording([world] * frames, times, path, experiment.route.times, info)


@pytest.mark.parametrize("experiment", [lifting(), wind()], ids=["lifting", "wind"])
def test_a_recording_is_seen_in_the_axes_of_its_sheet(experiment):
    found = sight_of(recorded(experiment), np.array([0, 3, 7]), 50)
    np.testing.assert_allclose(found.points[..., 2], 0, atol=1e-6)
    assert found.points.shape == (3, 50, 3) and bool(found.mask.all())
    assert bool((found.cloud[..., :2] >= 0).all()) and bool((found.cloud[..., :2] <= 0.45).all())
    first = np.asarray(found.grips[0]) - np.pad(np.asarray(found.corners), ((0, 0), (0, 1)))
    assert np.abs(first).max() < 0.05  # wind: the grippers are a little closer than the corners


def test_motions_have_networks_of_their_own_and_one_fabric():
    seen, few = [recorded(lifting()), recorded(wind())], from_clouds.Settings(width=4, layers=2)
    keys = jr.split(jr.key(0))
    first, second = (
        from_clouds._motion(
            each, FAMILY, sight_of(each, np.array([0, 3, 7]), 20), few, i, 2, keys[i]
        )
        for i, each in enumerate(seen)
    )
    networks = [from_clouds.parameters_of(each.shared.likeness) for each in (first, second)]
    theta = np.concatenate([*networks, np.full(FAMILY.dim, 0.5)])
    shared = set(first.own.tolist()) & set(second.own.tolist())
    assert shared == set(range(len(theta) - FAMILY.dim, len(theta)))
    assert {*first.own.tolist(), *second.own.tolist()} == set(range(len(theta)))
    for motion, network in zip((first, second), networks, strict=True):
        found = from_clouds.parameters_of(motion.of(theta))
        np.testing.assert_allclose(found, network, rtol=1e-6)


@pytest.mark.slow(group="pinn")
def test_two_motions_lead_to_one_fabric_to_which_both_count():
    few = from_clouds.Settings(
        frames=3, points=40, begin=1, held=0, rounds=1, steps=2, width=4, layers=2
    )
    fabric = presets.grey_interlock()
    space = OrthotropicSpace.make(float(fabric.density))
    with jax.numpy_dtype_promotion("standard"):
        lift, gust = (
            synthetic.record(motion, fabric, "grey_interlock", shape=(9, 9), key=jr.key(i))
            for i, motion in enumerate((lifting(), wind()))
        )
        alone = from_clouds.estimate([lift], space, few, key=jr.key(0))
        both = from_clouds.estimate([lift, gust], space, few, key=jr.key(0))
    assert np.isfinite(both.values).all() and "lifting, wind" in both.approach
    assert not np.allclose(both.values, alone.values, rtol=1e-4)


def test_no_recording_is_refused():
    with pytest.raises(ValueError, match="a recording is needed"):
        from_clouds.estimate([], FAMILY, key=jr.key(0))


def test_frames_that_are_not_there_are_refused():
    with pytest.raises(ValueError, match=r"three frames or more of 0\.\.7"):
        sight_of(recorded(lifting()), np.array([0, 3, 8]), 50)


@pytest.mark.slow(group="pinn")
def test_the_map_comes_to_lie_where_the_points_are():
    """In a steady wind, from the motion of a far stiffer fabric; what is not known is said."""
    fabric = presets.grey_interlock()
    space = OrthotropicSpace.make(float(fabric.density))
    with jax.numpy_dtype_promotion("standard"):
        seen = synthetic.record(wind(), fabric, "grey_interlock", shape=(17, 17), key=jr.key(11))
        few = from_clouds.Settings(rounds=10)
        found = from_clouds.estimate([seen], space, few, key=jr.key(0))
    spreads = np.sqrt(found.losses[:, 0])  # [m]
    assert spreads[-1] < 0.5 * spreads[0]
    assert found.values[0] < 0.5 * space.values(jnp.full(space.dim, 0.5))[0]  # softer
    assert not found.converged and np.isnan(found.standard_errors).all()


def test_a_wind_that_is_still_rising_does_not_count():
    seen = recorded(wind())
    windy = dataclasses.replace(seen.info, wind=(0.0, 2.0, 0.0))
    with pytest.raises(ValueError, match="after the wind rises"):
        from_clouds.estimate([dataclasses.replace(seen, info=windy)], FAMILY, key=jr.key(0))
