"""Closest points of pairs, by the certificate of convex bodies; impacts against dense sampling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s.solvers.contact.proximity import closest_weights, separation, time_of_impact

COUNT = 600  # pairs in a batch, all of the same shape to share compilations
GAP = 1e-3  # [m]
TIMES = np.linspace(0, 1, 401)
SIGNS = {True: np.array([1, 1, -1, -1]), False: np.array([1, -1, -1, -1])}


def distance(corners, is_edges):
    between = separation(corners, closest_weights(corners, is_edges))
    return jnp.sqrt(jnp.sum(between**2))


weights_of = jax.jit(jax.vmap(closest_weights))
distances = jax.jit(jax.vmap(distance))
jacobians = jax.jit(jax.vmap(jax.jacrev(closest_weights)))
impacts = jax.jit(jax.vmap(time_of_impact, in_axes=(0, 0, 0, None)))
one_impact = jax.jit(time_of_impact)


def pairs(kind: str, seed: int = 0):
    """Corners of vertex-triangle and edge-edge pairs at random, in turns."""
    draw = np.random.default_rng(seed)
    anywhere, lattice = draw.normal(size=(COUNT, 4, 3)), draw.integers(-1, 2, (COUNT, 4, 3))
    corners = {"anywhere": anywhere, "lattice": lattice.astype(float), "thin": anywhere}[kind]
    if kind == "thin":  # edges that are nearly parallel, triangles with hardly an area
        corners[:, 3] = corners[:, 2] + corners[:, 1] - corners[:, 0]
        corners[1::2, 3] = 0.3 * corners[1::2, 1] + 0.7 * corners[1::2, 2]
        corners[:, 3] += 10 ** draw.uniform(-12, -1, (COUNT, 1)) * draw.normal(size=(COUNT, 3))
    return corners, np.arange(COUNT) % 2 == 0


def shortfall(corners, is_edges, weights):
    """How much [m] closer than the weights' points the two bodies may be, at most.

    They are convex: none are closer than the least distance, along the line between the points,
    from a corner of the one to a corner of the other.
    """
    between = weights @ corners
    length = np.linalg.norm(between)
    sign = SIGNS[is_edges]
    apart = (corners[sign > 0][:, None] - corners[sign < 0][None]) @ between
    return length - max(np.min(apart) / max(length, 1e-300), 0)


KINDS = pytest.mark.parametrize("kind", ["anywhere", "lattice", "thin"])
DTYPES = pytest.mark.parametrize("dtype", [np.float64, np.float32])


@KINDS
@DTYPES
def test_the_points_are_in_the_bodies(kind, dtype):
    corners, is_edges = pairs(kind)
    precision = np.finfo(dtype).eps
    weights = np.asarray(weights_of(corners.astype(dtype), is_edges))
    assert np.max(np.abs(weights.sum(axis=1))) <= 4 * precision
    signed = weights * np.where(is_edges[:, None], SIGNS[True], SIGNS[False])
    assert signed.min() >= 0 and signed.max() <= 1 + precision


@KINDS
def test_no_points_are_closer(kind):
    corners, is_edges = pairs(kind)
    weights = np.asarray(weights_of(corners, is_edges))
    every = zip(corners, is_edges.tolist(), weights, strict=True)
    assert max(shortfall(*pair) for pair in every) < 1e-13


@KINDS
@DTYPES
def test_the_weights_have_a_finite_derivative(kind, dtype):
    corners, is_edges = pairs(kind)
    corners = corners.astype(dtype)
    collapsed = np.zeros((4, 3)), np.ones((4, 3)), 1e-20 * corners[0], 1e-9 * corners[1]
    corners[: len(collapsed)] = np.stack(collapsed)
    assert np.all(np.isfinite(weights_of(corners, is_edges)))
    assert np.all(np.isfinite(jacobians(corners, is_edges)))


def test_the_weights_have_the_right_derivative():
    corners, is_edges = pairs("anywhere", 1)
    direction = np.random.default_rng(2).normal(size=corners.shape)
    ahead, behind = (weights_of(corners + h * direction, is_edges) for h in (1e-6, -1e-6))
    found = np.einsum("pwcx,pcx->pw", jacobians(corners, is_edges), direction)
    # but where the region changes in between
    same = np.all((np.asarray(ahead) == 0) == (np.asarray(behind) == 0), axis=1)
    assert same.mean() > 0.99
    expected = np.asarray(ahead - behind)[same] / 2e-6
    assert found[same] == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_a_small_separation_is_exact_far_from_the_origin():
    with jax.enable_x64(False):
        corners = jnp.array([[0.0, 0, 2**-10], [-1, -1, 0], [1, -1, 0], [0, 1, 0]]) / 64 + 1.5
        weights = jnp.array([1.0, -0.1, -0.2, -0.7])
        assert separation(corners, weights)[2] == pytest.approx(2**-16, rel=1e-6)


TRIANGLE = np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]])
BESIDE = np.hypot(0.6, 0.8) * 0.6 * GAP  # of a body: 0.6 of the gap


def vertex(*place):
    return np.concatenate([[place], TRIANGLE]), False


def edge(first, second, other=((0, 0, 0), (0.01, 0, 0))):
    return np.array([first, second, *other], float), True


def level(height, speed):
    return lambda gap: (height - gap) / speed


def rounded(height, speed, aside=BESIDE):
    """When something falls beside a body, and first meets it aslant."""
    return lambda gap: (height - np.sqrt(gap**2 - aside**2)) / speed


DOWN = (0, 0, -0.1)
HITS = {  # a pair; how its first body moves; the time at which it comes as close as a gap
    "vertex on face": (vertex(2e-3, 3e-3, 5e-3), (0, 0, -9e-3), level(5e-3, 9e-3)),
    "vertex from below": (vertex(2e-3, 3e-3, -5e-3), (0, 0, 9e-3), level(5e-3, 9e-3)),
    "vertex right through": (vertex(2e-3, 3e-3, 0.06), (0, 0, -0.125), level(0.06, 0.125)),
    "vertex beside an edge": (vertex(5e-3, -BESIDE, 3e-3), DOWN, rounded(3e-3, 0.1)),
    "vertex over an edge": (vertex(5e-3, -0.05, BESIDE), (0, 0.125, 0), rounded(0.05, 0.125)),
    "edges crossing": (edge((4e-3, -5e-3, 4e-3), (4e-3, 5e-3, 4e-3)), DOWN, level(4e-3, 0.1)),
    "edges parallel": (edge((2e-3, 0, 4e-3), (12e-3, 0, 4e-3)), DOWN, level(4e-3, 0.1)),
    "edges end on end": (
        edge((-0.01 - BESIDE, 0, 4e-3), (-BESIDE, 0, 4e-3)),
        DOWN,
        rounded(4e-3, 0.1),
    ),
    "edge shrunk to a point": (edge(*2 * [(4e-3, 0, 4e-3)]), DOWN, level(4e-3, 0.1)),
    "grazing": (
        edge((-0.06, -0.99 * GAP, -5e-3), (-0.06, -0.99 * GAP, 5e-3)),
        (0.12, 0, 0),
        rounded(0.06, 0.12, 0.99 * GAP),
    ),
}
MISSES = {
    "vertex beside an edge": (vertex(5e-3, -1.02 * GAP, 3e-3), DOWN),
    "vertex sliding over the face": (vertex(5e-3, -0.05, 1.02 * GAP), (0, 0.125, 0)),
    "vertex that stops in time": (vertex(2e-3, 3e-3, 4e-3), (0, 0, 1.02 * GAP - 4e-3)),
    "vertex that leaves": (vertex(2e-3, 3e-3, 1.02 * GAP), (0, 0, 0.1)),
    "vertex at rest": (vertex(2e-3, 3e-3, 1.02 * GAP), (0, 0, 0)),
    "edges passing": (edge((-0.06, -1.02 * GAP, -5e-3), (-0.06, -1.02 * GAP, 5e-3)), (0.12, 0, 0)),
}


def motion(case, velocity, common=(0.0, 0.0, 0.0)):
    """Start and end of a pair whose first body moves, beside a motion of all."""
    corners, is_edges = case
    first = (SIGNS[is_edges] > 0)[:, None]
    return corners, corners + first * np.array(velocity) + np.array(common), np.array(is_edges)


@pytest.mark.parametrize("common", [(0.0, 0.0, 0.0), (0.1, -0.08, 0.125)])
@DTYPES
@pytest.mark.parametrize("name", HITS)
def test_an_impact_is_in_time(name, dtype, common):
    case, velocity, expected = HITS[name]
    start, end, is_edges = motion(case, velocity, common)
    found = float(one_impact(start.astype(dtype), end.astype(dtype), is_edges, dtype(GAP)))
    rounding = 1e-15 if dtype == np.float64 else 1e-6  # [m]
    assert expected(1.01 * GAP + rounding) - rounding <= found <= expected(GAP) + rounding


@pytest.mark.parametrize("common", [(0.0, 0.0, 0.0), (0.1, -0.08, 0.125)])
@DTYPES
@pytest.mark.parametrize("name", MISSES)
def test_a_near_miss_is_no_impact(name, dtype, common):
    case, velocity = MISSES[name]
    start, end, is_edges = motion(case, velocity, common)
    assert one_impact(start.astype(dtype), end.astype(dtype), is_edges, dtype(GAP)) == np.inf


@pytest.mark.parametrize(
    ("height", "travel", "expected"),
    [
        (0.5, -0.1, 0),  # approaches
        (0.5, -0.1 / GAP, 0),  # goes right through
        (0.5, 0, 0),  # stays
        (0.5, 0.3, 0),  # leaves, but not far enough
        (0.5, 0.7, np.inf),  # leaves
        (0, 5, 0),  # touches: its sides are not known
    ],
)
def test_a_pair_within_the_gap(height, travel, expected):
    start, end, is_edges = motion(vertex(2e-3, 3e-3, height * GAP), (0, 0, travel * GAP))
    assert one_impact(start, end, is_edges, GAP) == expected


def test_a_pair_within_the_gap_that_leaves_but_comes_back_is_an_impact():
    corners, is_edges = vertex(2e-3, 3e-3, 0.5 * GAP)
    # up from where the face hardly rises, and across to where it rises through the vertex's path
    end = corners + np.array([[6e-3, -2e-3, 3e-3], [0, 0, 0], [0, 0, 0.01], [0, 0, 0]])
    history = histories(corners[None], end[None], np.array([is_edges]))[:, 0]
    assert history[0] < history[20] and history[-1] > GAP
    assert one_impact(corners, end, np.array(is_edges), GAP) == 0


def motions(kind: str, dtype, seed: int):
    """Pairs of some 10 mm that move by up to 125 mm, near one another, away from the origin."""
    draw = np.random.default_rng(seed)
    is_edges = np.arange(COUNT) % 2 == 0
    start = draw.uniform(-0.01, 0.01, (COUNT, 4, 3))
    own = {"slow": 2e-3, "fast": 0.06, "very fast": 0.125, "rigid": 0.06, "hovering": 0.05}[kind]
    moved = draw.uniform(-own, own, start.shape)
    if kind == "rigid":
        moved = np.repeat(moved[:, :2], 2, axis=1)
        moved[~is_edges, 1] = moved[~is_edges, 2]
    if kind == "hovering":
        start[:, :, 2], moved[:, :, 2] = 0, 0.01 * moved[:, :, 2]
        start[:, 0, 2] = GAP * draw.uniform(1, 1.2, COUNT)
        start[is_edges, 1, 2] = start[is_edges, 0, 2]
    start, moved = (
        start + np.array([0.3, -0.2, 1.0]),
        moved + draw.uniform(-own, own, (COUNT, 1, 3)),
    )
    return start.astype(dtype), (start + moved).astype(dtype), is_edges


@jax.jit
def histories(start, end, is_edges):
    """Distances (time, pair) of moving pairs, by dense sampling."""

    def at(time):
        return jax.vmap(distance)(start + time * (end - start), is_edges)

    return jax.lax.map(at, jnp.asarray(TIMES))


@DTYPES
@pytest.mark.parametrize("kind", ["slow", "fast", "very fast", "rigid", "hovering"])
def test_an_impact_is_never_late_and_hardly_early(kind, dtype):
    start, end, is_edges = motions(kind, dtype, 5)
    found = np.asarray(impacts(start, end, is_edges, dtype(GAP)), float)
    assert not np.any(np.isnan(found))
    start, end = start.astype(float), end.astype(float)
    history = np.asarray(histories(start, end, is_edges))
    rounding = 1e-13 if dtype == np.float64 else 5e-7  # [m]
    outside = history[0] > 1.01 * GAP + 2 * rounding
    met = history < GAP - rounding
    first = np.where(met.any(axis=0), TIMES[met.argmax(axis=0)], np.inf)
    assert np.all((found <= first)[outside])
    is_hit = np.isfinite(found) & outside
    assert is_hit.sum() > 10 and np.sum(~np.isfinite(found)) > 100
    time = np.where(is_hit, found, 0)[:, None, None]
    then = np.asarray(distances(start + time * (end - start), is_edges))
    assert np.all(then[is_hit] <= 1.01 * GAP + 2 * rounding)
    within = history[0] < GAP - rounding
    stays = (history.min(axis=0) < 0.97 * history[0]) | (history[-1] < GAP - rounding)
    assert np.all(found[within & stays] == 0)
