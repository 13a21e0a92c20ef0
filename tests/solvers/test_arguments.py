"""Wrong input is named before anything is computed: shapes, order, units, negative numbers."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import r2s
from r2s.solvers.mpm import Grid

SHEET = r2s.rectangle((0.2, 0.2), (3, 3))
FABRIC = r2s.presets.grey_interlock()
SCENE = r2s.Scene(SHEET, pinned=[0, 2])
GRID = Grid.covering((-0.3, -0.3, -0.3), (0.5, 0.5, 0.3), 0.1)
SOLVERS = {
    "implicit": lambda: r2s.ImplicitCloth(SCENE, 0.01),
    "explicit": lambda: r2s.ExplicitCloth(SCENE, 0.01, FABRIC),
    "mpm": lambda: r2s.MPMCloth(SCENE, 1e-4, FABRIC, GRID),
}
START = SHEET.lay_flat()
CONTROL = r2s.Control(START[jnp.array([0, 2])])


@pytest.fixture(params=SOLVERS)
def solver(request, unchecked):
    return SOLVERS[request.param]()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"x": START[:, :2]}, r"state.x must be \(9, 3\).* got \(9, 2\)"),
        ({"v": START[:4]}, r"state.v must be \(9, 3\).* got \(4, 3\)"),
        ({"control": r2s.Control(START[:1])}, r"control.pinned must be \(2, 3\).* got \(1, 3\)"),
        ({"control": r2s.Control(CONTROL.pinned, jnp.zeros(2))}, r"control.wind must be \(3,\) or"),
    ],
)
def test_shapes_that_do_not_fit_are_named(solver, change, words):
    of_state = {name: value for name, value in change.items() if name != "control"}
    state = dataclasses.replace(solver.init(START), **of_state)
    control = change.get("control", CONTROL)
    for step in (solver.step, jax.jit(lambda *arguments: solver.step(*arguments))):
        with pytest.raises(ValueError, match=words):
            step(FABRIC, state, control)


def test_arguments_in_another_order_are_named(solver):
    state = solver.init(START)
    with pytest.raises(TypeError, match="fabric must be a Fabric, got .*State"):
        solver.step(state, FABRIC, CONTROL)
    with pytest.raises(TypeError, match="control must be a Control, got .*Array"):
        solver.step(FABRIC, state, CONTROL.pinned)


@pytest.mark.parametrize(
    ("where", "value", "words"),
    [
        (lambda f: f.membrane.c33, -1.0, "membrane.c33 .* positive, found -1"),
        (lambda f: f.bending.stiffness, -1e-5, "bending.stiffness .* not negative"),
        (lambda f: f.density, 0.0, r"density \[kg/m\^2\] must be positive"),
        (lambda f: f.friction, float("nan"), "friction .* found nan"),
    ],
)
def test_numbers_that_no_fabric_has_are_named(solver, where, value, words):
    bad = eqx.tree_at(where, FABRIC, jnp.asarray(value, float))
    control = r2s.Control(CONTROL.pinned[None])
    with pytest.raises(ValueError, match=words):
        r2s.simulate(solver, bad, solver.init(START), control)


def test_a_step_of_seconds_is_questioned():
    with pytest.raises(ValueError, match="in seconds, at most 10.0, got 20"):
        r2s.ImplicitCloth(SCENE, 20.0)


@pytest.mark.parametrize(
    ("pinned", "words"),
    [([100], "pinned has vertex 100, the mesh has 9"), ([0, 0], "pinned twice"), ([-1], "-1")],
)
def test_vertices_that_cannot_be_pinned_are_named(pinned, words):
    with pytest.raises(ValueError, match=words):
        r2s.Scene(SHEET, pinned)
