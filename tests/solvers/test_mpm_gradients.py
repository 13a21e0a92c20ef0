"""Derivatives of motions by the material point method; memory; single precision."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import directional_difference, flat
from folders import SHARED
from jaxtyping import Array, Float
from mpm_bodies import lattice

import r2s
from r2s.environment.contact import Table
from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric
from r2s.materials.solid import FixedCorotated, NeoHookean, Solid
from r2s.solvers.mpm import Background, Block, Grid, MPMCloth
from r2s.solvers.simulate import simulate

REFERENCE = SHARED / "data" / "difftaichi_reference"


class BlockInputs(eqx.Module):
    """What the motion of a block depends on."""

    young: Array
    poisson: Array
    density: Array
    damping: Array
    friction: Array
    x: Float[Array, "particle axis"]
    v: Float[Array, "particle axis"]
    path: Float[Array, "step 1 axis"]


BLOCK_STEPS = 40
BLOCK_WHERE = {  # what to differ, and by how much
    "young": (lambda i: i.young, 1e-2),
    "poisson": (lambda i: i.poisson, 1e-6),
    "density": (lambda i: i.density, 1e-3),
    "damping": (lambda i: i.damping, 1e-8),
    "friction": (lambda i: i.friction, 3e-5),
    "positions": (lambda i: i.x, 1e-8),
    "velocities": (lambda i: i.v, 1e-6),
    "path": (lambda i: i.path, 1e-8),
}


@pytest.fixture(scope="module", params=[2, pytest.param(3, marks=pytest.mark.slow(group="mpm"))])
def block(request):
    """Value and gradient of a block that is dragged over a table, and its inputs."""
    spacing, axes = 0.1, slice(-request.param, None)  # the last ones
    room, low, high = (0.8, 0.8, 0.6)[axes], (0.2, 0.2, 0.0)[axes], (0.4, 0.4, 0.15)[axes]
    grid = Grid.covering((0.0,) * request.param, room, spacing)
    background = Background.make(grid, Table.make(0.0))
    x, volume = lattice(low, high, spacing / 2)
    x = x + 0.003
    weights = jax.random.normal(jax.random.key(0), x.shape)
    handle = jnp.array([(0.35, 0.35, 0.15)[axes]])
    shift = (
        jnp.linspace(0, 1, BLOCK_STEPS)[:, None, None]
        * jnp.array([[[0.03, 0.01, 0.02]]])[..., axes]
    )

    def number(value):
        return jnp.asarray(value, float)

    inputs = BlockInputs(
        young=number(2e4),
        poisson=number(0.3),
        density=number(300.0),
        damping=number(1e-3),
        friction=number(0.4),
        x=x,
        v=jnp.full(x.shape, 0.2, float),
        path=handle[None] + shift,
    )
    fixed = Block.make(background, volume, _solid(inputs), 1e-3).gripped(x, handle, 0.06)

    def run(inputs):
        start, every = fixed.init(inputs.x, inputs.v), BLOCK_STEPS // 4
        return simulate(fixed, _solid(inputs), start, Control(inputs.path), save_every=every).x

    def loss(inputs):
        return jnp.sum(weights * run(inputs)[-1])

    return jax.jit(jax.value_and_grad(loss)), inputs, loss, fixed


def _solid(inputs):
    law = FixedCorotated.make(inputs.young, inputs.poisson)
    return Solid.make(law, inputs.density, inputs.damping, inputs.friction)


@pytest.mark.parametrize("name", BLOCK_WHERE)
def test_the_gradient_of_a_block_agrees_with_differences(name, block):
    value_and_grad, inputs, _, _ = block
    _agrees(value_and_grad, inputs, *BLOCK_WHERE[name])


def _agrees(value_and_grad, inputs, where, size):
    direction = jax.random.normal(jax.random.key(2), where(inputs).shape)

    def value(part):
        return value_and_grad(eqx.tree_at(where, inputs, part))[0]

    expected = directional_difference(value, where(inputs), direction, size)
    found = jnp.sum(where(value_and_grad(inputs)[1]) * direction)
    assert found == pytest.approx(float(expected), rel=1e-5)
    assert abs(found) > 1e-12


@pytest.mark.slow(group="mpm")
def test_forward_mode_equals_reverse_mode(block):
    _, inputs, _, solver = block
    solver = eqx.tree_at(lambda s: s.background, solver, _forward(solver.background))
    state = solver.init(inputs.x, inputs.v)
    control = Control(inputs.path[0])

    def step(young):
        solid = _solid(eqx.tree_at(lambda i: i.young, inputs, young))
        start = eqx.tree_at(lambda s: s.F, state, 1.02 * state.F)
        return jnp.sum(solver.step(solid, start, control).v ** 2)

    young = inputs.young
    _, forward = jax.jit(lambda young: jax.jvp(step, (young,), (jnp.ones_like(young),)))(young)
    assert forward == pytest.approx(float(jax.jit(jax.grad(step))(young)), rel=1e-10)
    assert forward != 0


def _forward(background):
    grid, table = background.grid, background.table
    return Background.make(grid, table, forward_mode=True)


class SheetInputs(eqx.Module):
    """What the motion of a sheet depends on."""

    fabric: Fabric
    x: Float[Array, "vertex 3"]
    v: Float[Array, "vertex 3"]
    path: Float[Array, "step 1 3"]
    wind: Float[Array, " 3"]


SHEET_STEPS = 60
SHEET_WHERE = {
    "density": (lambda i: i.fabric.density, 1e-6),
    "c11": (lambda i: i.fabric.membrane.c11, 1e-3),
    "c33": (lambda i: i.fabric.membrane.c33, 1e-3),
    "bending": (lambda i: i.fabric.bending.stiffness, 1e-10),
    "damping": (lambda i: i.fabric.damping, 1e-7),
    "friction": (lambda i: i.fabric.friction, 1e-5),
    "mass damping": (lambda i: i.fabric.mass_damping, 1e-5),
    "positions": (lambda i: i.x, 1e-8),
    "velocities": (lambda i: i.v, 1e-7),
    "path": (lambda i: i.path, 1e-8),
    "wind": (lambda i: i.wind, 1e-5),
}


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
    inputs = SheetInputs(fabric, x, v, x[None, :1] + shift, wind)

    def loss(inputs):
        control, start = Control(inputs.path, inputs.wind), solver.init(inputs.x, inputs.v)
        moved = simulate(solver, inputs.fabric, start, control, save_every=SHEET_STEPS // 6)
        return jnp.sum(weights * moved.final_state.x)

    return jax.jit(jax.value_and_grad(loss)), inputs


@pytest.mark.slow(group="mpm")
@pytest.mark.parametrize("name", SHEET_WHERE)
def test_the_gradient_of_a_sheet_agrees_with_differences(name, sheet_motion):
    value_and_grad, inputs = sheet_motion
    _agrees(value_and_grad, inputs, *SHEET_WHERE[name])


@pytest.mark.slow(group="mpm")
def test_a_gradient_needs_a_tenth_of_the_memory_of_all_states():
    """Of 2,000 steps; the states of the frames, and of the steps in one, are kept."""
    frames, substeps = 50, 40
    grid = Grid.covering((0.0, 0.0), (1.0, 1.0), 1 / 16)
    x, volume = lattice((0.25, 0.25), (0.75, 0.75), 1 / 64)
    background = Background.make(grid)
    material = Solid.make(FixedCorotated.make(1e3, 0.3), 1e3)
    solver = Block.make(background, volume, material, 1e-4)
    control = Control(jnp.zeros((frames * substeps, 0, 2)))

    def loss(young):
        solid = Solid.make(FixedCorotated.make(young, 0.3), 1e3)
        moved = simulate(solver, solid, solver.init(x), control, save_every=substeps)
        return jnp.sum(moved.final_state.x)

    needed = r2s.predicted_memory(jax.grad(loss), jnp.asarray(1e3))
    a_state = len(x) * (2 + 2 + 4 + 4) * 8  # [byte]
    assert needed < frames * substeps * a_state / 10


@pytest.mark.parametrize(
    "name, law",
    [
        pytest.param("fcr", FixedCorotated, marks=pytest.mark.slow(group="mpm")),
        pytest.param("nh", NeoHookean, marks=pytest.mark.slow(group="mpm")),
    ],
)
def test_difftaichi_is_repeated_with_its_gradients(name, law):
    """Hu et al. 2020: a block thrown into a box, 1,024 steps, in the units of that code."""
    path = REFERENCE / f"drop2d_{name}_f64.npz"
    if not path.exists():
        pytest.skip(f"no reference data: {path} not found")
    data = np.load(path)
    nodes, steps, count = int(data["n_grid"]), int(data["steps"]), len(data["x_init"])
    background = Background.make(
        Grid.make((0.0, 0.0), float(data["dx"]), (nodes, nodes)),
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

    def loss(v, apart, mu, lam, x):
        solid = eqx.tree_at(lambda s: (s.law.mu, s.law.lam), material, (mu, lam))
        start = solver.init(x, jnp.broadcast_to(v[None], x.shape) + apart)
        x = simulate(solver, solid, start, control, save_every=steps // 32).final_state.x
        return jnp.sum((jnp.mean(x, axis=0) - target) ** 2) / 2, x

    x = number(data["x_init"])
    inputs = number(data["v0"]), jnp.zeros_like(x), material.law.mu, material.law.lam, x
    run = jax.jit(jax.value_and_grad(loss, argnums=tuple(range(5)), has_aux=True))
    (value, moved), (of_v, of_each_v, *slopes) = run(*inputs)
    assert np.asarray(moved) == pytest.approx(data["x_final"], abs=1e-6)  # 2e-15 was measured
    assert value == pytest.approx(float(data["loss"]), rel=1e-9)
    for found, key in zip((of_v, *slopes), ("init_v", "mu", "la", "x0"), strict=True):
        expected = data[f"grad_{key}"]
        scale = float(np.max(np.abs(expected)))
        assert np.asarray(found) == pytest.approx(expected, abs=1e-5 * scale)  # 6e-14
    of_all = np.asarray(jnp.sum(of_each_v, axis=0))
    assert of_all == pytest.approx(data["grad_init_v"], rel=1e-9)
    if np.any(data["grad_v0_per_particle"]):
        scale = float(np.max(np.abs(data["grad_v0_per_particle"])))
        assert np.asarray(of_each_v) == pytest.approx(
            data["grad_v0_per_particle"], abs=1e-5 * scale
        )
