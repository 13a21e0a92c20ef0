"""Derivatives of motions by the material point method."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_gradient, flat
from folders import SHARED
from mpm_bodies import lattice

from r2s.environment.contact import Table
from r2s.environment.scene import Control, Scene
from r2s.materials.solid import FixedCorotated, NeoHookean, Solid
from r2s.solvers.mpm import Background, Block, Grid, MPMCloth
from r2s.solvers.simulate import simulate

REFERENCE = SHARED / "data" / "difftaichi_reference"


BLOCK_STEPS, SHEET_STEPS = 40, 60
BLOCK_WHERE = {  # what to differ, and by how much
    name: (lambda inputs, name=name: inputs[name], size)
    for name, size in (
        ("young", 1e-2),
        ("poisson", 1e-6),
        ("density", 1e-3),
        ("damping", 1e-8),
        ("friction", 3e-5),
        ("x", 1e-8),
        ("v", 1e-6),
        ("path", 1e-8),
    )
}
SHEET_WHERE = {
    "density": (lambda i: i["fabric"].density, 1e-6),
    "c11": (lambda i: i["fabric"].membrane.c11, 1e-3),
    "c33": (lambda i: i["fabric"].membrane.c33, 1e-3),
    "bending": (lambda i: i["fabric"].bending.stiffness, 1e-10),
    "damping": (lambda i: i["fabric"].damping, 1e-7),
    "friction": (lambda i: i["fabric"].friction, 1e-5),
    "mass damping": (lambda i: i["fabric"].mass_damping, 1e-5),
    "positions": (lambda i: i["x"], 1e-8),
    "velocities": (lambda i: i["v"], 1e-7),
    "path": (lambda i: i["path"], 1e-8),
    "wind": (lambda i: i["wind"], 1e-5),
}


@pytest.fixture(scope="module", params=[2, pytest.param(3, marks=pytest.mark.slow(group="mpm"))])
def block(request):
    """Value and gradient of a block that is dragged over a table, and its inputs."""
    spacing, axes = 0.1, slice(-request.param, None)  # the last ones
    room, low, high = (0.8, 0.8, 0.6)[axes], (0.2, 0.2, 0.0)[axes], (0.4, 0.4, 0.15)[axes]
    grid = Grid.covering((0.0,) * request.param, room, spacing)
    background = Background(grid, Table.make(0.0))
    x, volume = lattice(low, high, spacing / 2)
    x = x + 0.003
    weights = jax.random.normal(jax.random.key(0), x.shape)
    handle = jnp.array([(0.35, 0.35, 0.15)[axes]])
    rise = jnp.linspace(0, 1, BLOCK_STEPS)[:, None, None]
    numbers = {"young": 2e4, "poisson": 0.3, "density": 300.0, "damping": 1e-3, "friction": 0.4}
    inputs = {name: jnp.asarray(number, float) for name, number in numbers.items()}
    inputs |= {
        "x": x,
        "v": jnp.full(x.shape, 0.2, float),
        "path": handle[None] + rise * jnp.array([[[0.03, 0.01, 0.02]]])[..., axes],
    }
    fixed = Block.make(background, volume, _solid(inputs), 1e-3).gripped(x, handle, 0.06)

    def run(inputs):
        start, every = fixed.init(inputs["x"], inputs["v"]), BLOCK_STEPS // 4
        control = Control(inputs["path"])
        return jnp.sum(
            weights * simulate(fixed, _solid(inputs), start, control, save_every=every).x[-1]
        )

    return jax.jit(jax.value_and_grad(run)), inputs, fixed


def _solid(inputs):
    law = FixedCorotated.make(inputs["young"], inputs["poisson"])
    return Solid.make(law, inputs["density"], inputs["damping"], inputs["friction"])


@pytest.mark.parametrize("name", BLOCK_WHERE)
def test_the_gradient_of_a_block_agrees_with_differences(name, block):
    value_and_grad, inputs, _ = block
    agrees(value_and_grad, inputs, *BLOCK_WHERE[name])


def agrees(value_and_grad, inputs, where, size):
    gradient = value_and_grad(inputs)[1]
    assert_gradient(lambda at: value_and_grad(at)[0], gradient, inputs, where, size, rel=1e-5)


@pytest.mark.slow(group="mpm")
def test_forward_mode_equals_reverse_mode(block):
    _, inputs, solver = block
    background = dataclasses.replace(solver.background, forward_mode=True)
    solver = dataclasses.replace(solver, background=background)
    state, control = solver.init(inputs["x"], inputs["v"]), Control(inputs["path"][0])

    def step(young):
        solid = _solid(inputs | {"young": young})
        start = eqx.tree_at(lambda s: s.F, state, 1.02 * state.F)
        return jnp.sum(solver.step(solid, start, control).v ** 2)

    young = inputs["young"]
    _, forward = jax.jit(lambda young: jax.jvp(step, (young,), (jnp.ones_like(young),)))(young)
    assert forward == pytest.approx(float(jax.jit(jax.grad(step))(young)), rel=1e-10)
    assert forward != 0


@pytest.fixture(scope="module")
def sheet_motion(sheet, fabric):
    """Value and gradient of a sheet that is lifted off a table by a corner, in wind."""
    x = flat(sheet, 2e-3)
    grid = Grid.covering((-0.1, -0.1, 0.0), (0.4, 0.4, 0.3), 0.05)
    scene = Scene(sheet, [0], table=0.0)
    fabric = eqx.tree_at(lambda f: f.damping, fabric, jnp.asarray(2e-4, float))
    solver = MPMCloth(scene, 5e-4, fabric, grid)
    weights = jax.random.normal(jax.random.key(0), x.shape)
    shift = jnp.linspace(0, 1, SHEET_STEPS)[:, None, None] * jnp.array([[[0.01, 0.005, 0.02]]])
    v = jnp.broadcast_to(jnp.array([[0.2, 0.1, -0.1]]), x.shape)
    wind = jnp.array([0.5, -0.3, 0.8])
    inputs = {"fabric": fabric, "x": x, "v": v, "path": x[None, :1] + shift, "wind": wind}

    def loss(inputs):
        control = Control(inputs["path"], inputs["wind"])
        start = solver.init(inputs["x"], inputs["v"])
        moved = simulate(solver, inputs["fabric"], start, control, save_every=SHEET_STEPS // 6)
        return jnp.sum(weights * moved.final_state.x)

    return jax.jit(jax.value_and_grad(loss)), inputs


@pytest.mark.slow(group="mpm")
@pytest.mark.parametrize("name", SHEET_WHERE)
def test_the_gradient_of_a_sheet_agrees_with_differences(name, sheet_motion):
    value_and_grad, inputs = sheet_motion
    agrees(value_and_grad, inputs, *SHEET_WHERE[name])


@pytest.mark.slow(group="mpm")
@pytest.mark.parametrize("name, law", [("fcr", FixedCorotated), ("nh", NeoHookean)])
def test_difftaichi_is_repeated_with_its_gradients(name, law):
    """Hu et al. 2020: a block thrown into a box, 1,024 steps, in the units of that code."""
    path = REFERENCE / f"drop2d_{name}_f64.npz"
    if not path.exists():
        pytest.skip(f"no reference data: {path} not found")
    data = np.load(path)
    nodes, steps, count = int(data["n_grid"]), int(data["steps"]), len(data["x_init"])
    background = Background(
        Grid((0.0, 0.0), float(data["dx"]), (nodes, nodes)),
        gravity=float(np.max(np.abs(data["gravity"]))),
        walls=int(data["bound"]),
        mass_floor=1e-10,
    )

    def number(value):
        return jnp.asarray(value, float)

    volume, target = jnp.full(count, float(data["p_vol"])), number(data["target"])
    material = Solid.make(law(mu=number(data["mu"]), lam=number(data["la"])), float(data["p_mass"]))
    solver = Block.make(background, volume, material, float(data["dt"]))
    control = Control(jnp.zeros((steps, 0, 2)))

    def loss(v, mu, lam, x):
        solid = eqx.tree_at(lambda s: (s.law.mu, s.law.lam), material, (mu, lam))
        start = solver.init(x, jnp.broadcast_to(v[None], x.shape))
        x = simulate(solver, solid, start, control, save_every=steps // 32).final_state.x
        return jnp.sum((jnp.mean(x, axis=0) - target) ** 2) / 2, x

    x = number(data["x_init"])
    inputs = number(data["v0"]), material.law.mu, material.law.lam, x
    run = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2, 3), has_aux=True))
    (value, moved), slopes = run(*inputs)
    assert np.asarray(moved) == pytest.approx(data["x_final"], abs=1e-6)  # 2e-15 was measured
    assert value == pytest.approx(float(data["loss"]), rel=1e-9)
    for slope, key in zip(slopes, ("init_v", "mu", "la", "x0"), strict=True):
        expected = data[f"grad_{key}"]
        scale = float(np.max(np.abs(expected)))
        assert np.asarray(slope) == pytest.approx(expected, abs=1e-5 * scale)  # 6e-14
