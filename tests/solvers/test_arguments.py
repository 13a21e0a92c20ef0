"""Wrong input is named before anything is computed: shapes, order, units, negative numbers."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r2s
from r2s.solvers.mpm import Grid

SHEET = r2s.rectangle((0.2, 0.2), (3, 3))
FABRIC = r2s.presets.grey_interlock()
SCENE = r2s.Scene(SHEET, pinned=[0, 2])
GRID = Grid.covering((-0.3, -0.3, -0.3), (0.5, 0.5, 0.3), 0.1)
SOLVERS = {  # of a scene, and a grid around it
    "implicit": lambda scene, grid: r2s.ImplicitCloth(scene, 0.01),
    "explicit": lambda scene, grid: r2s.ExplicitCloth(scene, 1e-3, FABRIC),
    "mpm": lambda scene, grid: r2s.MPMCloth(scene, 1e-4, FABRIC, grid),
}
FREE = r2s.ImplicitCloth(r2s.Scene(SHEET, air=None), 0.01)
START = SHEET.lay_flat()
CONTROL = r2s.Control(START[jnp.array([0, 2])])


@pytest.fixture(params=SOLVERS)
def solver(request, unchecked):
    return SOLVERS[request.param](SCENE, GRID)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"x": START[:, :2]}, r"state.x must be \(9, 3\).* got \(9, 2\)"),
        ({"v": START[:4]}, r"state.v must be \(9, 3\).* got \(4, 3\)"),
        ({"control": (START[:1],)}, r"control.pinned must be \(2, 3\).* got \(1, 3\)"),
        ({"control": (CONTROL.pinned, jnp.zeros(2))}, r"control.wind must be \(3,\) or"),
    ],
)
def test_shapes_that_do_not_fit_are_named(solver, change, words):
    of_state = {name: value for name, value in change.items() if name != "control"}
    state = dataclasses.replace(solver.init(START), **of_state)
    control = r2s.Control(*change["control"]) if "control" in change else CONTROL
    for step in (solver.step, jax.jit(lambda *arguments: solver.step(*arguments))):
        with pytest.raises(ValueError, match=words):
            step(FABRIC, state, control)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: r2s.Scene([0], SCENE.mesh), "mesh must be a Mesh, got list"),  # pyright: ignore
        (lambda: r2s.ImplicitCloth(0.02, SCENE), "scene must be a Scene, got float"),  # pyright: ignore
        (lambda: r2s.ImplicitCloth(SCENE.mesh, 0.02), "scene must be a Scene, got Mesh"),  # pyright: ignore
        (lambda: r2s.ExplicitCloth(SCENE, 0.02, SCENE), "fabric must be a Fabric, got Scene"),  # pyright: ignore
        (lambda: r2s.MPMCloth(FABRIC, 0.02, SCENE), "scene must be a Scene, got Fabric"),  # pyright: ignore
        (
            lambda: r2s.simulate(FABRIC, FABRIC, START, CONTROL),  # pyright: ignore
            "solver must be a solver, got Fabric",
        ),
        (
            lambda: r2s.simulate(r2s.ImplicitCloth(SCENE, 0.02), FABRIC, START, START),  # pyright: ignore
            "control must be a Control, got Array",
        ),
    ],
)
def test_an_argument_of_another_type_is_named(call, words, unchecked):
    with pytest.raises(TypeError, match=words):
        call()


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (
            lambda: r2s.Scene(SCENE.mesh, np.array([0.5])),
            ValueError,
            "pinned must be whole numbers",
        ),
        (lambda: r2s.Scene(SCENE.mesh, gravity=-9.81), ValueError, "gravity acts downwards"),
        (lambda: CONTROL.at(9), IndexError, "step 9 of a control that has 2"),
        (
            lambda: r2s.along_path(jnp.zeros(1), jnp.array([1.0, 0.0]), jnp.zeros((2, 1, 3))),
            ValueError,
            "knot_times must rise",
        ),
        (
            lambda: r2s.along_path(jnp.zeros(1), jnp.zeros(2), jnp.zeros((2, 3))),
            ValueError,
            r"path must be \(knot, gripper, 3\) with 2 knots",
        ),
        (
            lambda: r2s.OrthotropicSpace.make(0.2)(jnp.zeros(3)),
            ValueError,
            r"expected 7 numbers from 0 to 1 \(warp, .*got \(3,\)",
        ),
    ],
)
def test_a_value_that_makes_no_sense_is_named(call, error, words, unchecked):
    with pytest.raises(error, match=words):
        call()


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64, list])
@pytest.mark.parametrize("name", SOLVERS)
def test_a_start_takes_the_precision_of_the_solver(name, dtype, unchecked):
    with jax.enable_x64(True):
        sheet = r2s.rectangle((2.0, 2.0), (3, 3))
        grid = Grid.covering((-3, -3, -3), (5, 5, 3), 1.0)
        solver = SOLVERS[name](r2s.Scene(sheet, pinned=[0]), grid)
        flat = np.asarray(sheet.lay_flat())
        start = flat.tolist() if dtype is list else flat.astype(dtype)
        state = solver.init(start, start, None)
        expected = jax.eval_shape(solver.init, jnp.asarray(flat), jnp.asarray(flat))
        found, kinds = (jax.tree.map(lambda leaf: leaf.dtype, each) for each in (state, expected))
        assert found == kinds
        np.testing.assert_array_equal(state.x, flat)


def test_a_start_of_other_vertices_is_named(solver):
    with pytest.raises(ValueError, match=r"x must be \(9, 3\).* got \(4, 3\)"):
        solver.init(START[:4])


def test_arguments_in_another_order_and_steps_are_named(solver):
    with pytest.raises(ValueError, match="in seconds, at most 10.0, got 20"):
        r2s.ImplicitCloth(SCENE, 20.0)
    for wrong in (0.0, float("nan")):
        with pytest.raises(ValueError, match="dt must be positive"):
            r2s.ImplicitCloth(SCENE, wrong)
    state = solver.init(START)
    with pytest.raises(ValueError, match="save_every must divide"):
        r2s.simulate(solver, FABRIC, state, r2s.Control(CONTROL.pinned[None]), save_every=0)
    with pytest.raises(TypeError, match="fabric must be a Fabric, got .*State"):
        solver.step(state, FABRIC, CONTROL)
    with pytest.raises(TypeError, match="control must be a Control, got .*Array"):
        solver.step(FABRIC, state, CONTROL.pinned)


@pytest.mark.parametrize(
    ("where", "value", "words"),
    [
        (lambda f: f.membrane.c33, -1.0, r"membrane.c33 must be positive \[N/m\], found -1"),
        (lambda f: f.bending.stiffness, -1e-5, r"bending.stiffness must be not negative \[N m\]"),
        (lambda f: f.density, 0.0, r"density must be positive \[kg/m\^2\], found 0"),
        (lambda f: f.friction, float("nan"), r"friction must be not negative \[-\], found nan"),
    ],
)
def test_numbers_that_no_fabric_has_are_named(solver, where, value, words):
    bad = eqx.tree_at(where, FABRIC, jnp.asarray(value, float))
    control = r2s.Control(CONTROL.pinned[None])
    with pytest.raises(ValueError, match=words):
        r2s.simulate(solver, bad, solver.init(START), control)


@pytest.mark.parametrize(
    ("pinned", "words"),
    [([100], "pinned has vertex 100, the mesh has 9"), ([0, 0], "pinned twice"), ([-1], "-1")],
)
def test_vertices_that_cannot_be_pinned_are_named(pinned, words):
    with pytest.raises(ValueError, match=words):
        r2s.Scene(SHEET, pinned)


def test_a_steady_wind_stays_and_one_of_every_step_is_that_of_the_step():
    path, wind = jnp.zeros((4, 2, 3)), jnp.array([0.0, 1.0, 0.0])
    assert r2s.Control(path, wind).at(3).wind == pytest.approx(wind)
    gusts = jnp.arange(12.0).reshape(4, 3)
    assert r2s.Control(path, gusts).at(3).wind == pytest.approx(gusts[3])
    assert r2s.Control(path).at(3).wind is None


def test_gravity_and_step_are_leaves_of_one_program():
    """A free sheet in vacuum falls by g dt^2 in its first implicit step, from rest."""

    traced = []

    @jax.jit
    def fallen(gravity, dt):
        traced.append(gravity)
        scene = r2s.Scene(SHEET, air=None, gravity=gravity)
        solver = dataclasses.replace(FREE, scene=scene, dt=dt)
        after = solver.step(FABRIC, solver.init(START), r2s.Control(jnp.zeros((0, 3))))
        return -after.x[:, 2].mean()

    slope_of = jax.jit(jax.grad(fallen))
    for g, dt in ((9.81, 0.01), (1.62, 0.02)):
        g, dt = jnp.asarray(g), jnp.asarray(dt)
        slope = slope_of(g, dt)
        assert slope == pytest.approx(float(fallen(g, dt) / g), rel=1e-6)
        assert slope == pytest.approx(float(4 / 9 * dt**2), rel=1e-6)  # BDF2's first step
    assert len(traced) <= 2  # for the value and its derivative, not for each step
