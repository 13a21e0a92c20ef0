"""The material point method of r2s, set up for the benchmark.

`forward` and `gradient` give a function without arguments, compiled, and its memory [MB]. The value
is the mean square of all positions, its slope that in mu; of the sheet, in C11.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import mpm_scenes
import numpy as np

import r2s
from r2s.fabrics import presets
from r2s.laws.solid import FixedCorotated, NeoHookean, Solid
from r2s.mpm import Background, Block, Grid, Sheet
from r2s.world.air import Air
from r2s.world.contact import Table

LAWS = {"corotated": FixedCorotated, "neo-hookean": NeoHookean}
FRAMES = 32  # the states that reverse mode keeps


def forward(scene: mpm_scenes.Scene):
    loss, stiffness = _loss(scene)
    return _compiled(loss, stiffness)


def gradient(scene: mpm_scenes.Scene):
    loss, stiffness = _loss(scene)
    call, memory = _compiled(jax.value_and_grad(loss), stiffness)
    return lambda: float(call()[1]), memory


def _compiled(function, stiffness):
    run = jax.jit(function).lower(stiffness).compile()
    plan = run.memory_analysis()
    size = plan.temp_size_in_bytes + plan.argument_size_in_bytes + plan.output_size_in_bytes

    def convert(out):
        return float(out) if isinstance(out, jax.Array) else out

    return lambda: convert(jax.block_until_ready(run(stiffness))), size / 1e6


def _loss(scene):
    return _sheet_loss(scene) if scene.nodes == 0 else _block_loss(scene)


def _block_loss(scene):
    axes, law = scene.x.shape[1], LAWS[scene.law]
    grid = Grid.make((0.0,) * axes, 1 / scene.nodes, (scene.nodes,) * axes)
    background = Background.make(grid, gravity=mpm_scenes.GRAVITY, walls=mpm_scenes.WALLS)
    volume = jnp.full(scene.count, mpm_scenes.VOLUME)

    def number(value):
        return jnp.asarray(value, float)

    def material(mu):
        return Solid.make(law(mu, number(mpm_scenes.LAM)), mpm_scenes.MASS)

    solver = Block.make(background, volume, material(number(mpm_scenes.MU)), scene.dt)
    x = jnp.asarray(scene.x)
    start = solver.init(x, jnp.asarray(scene.v))
    shape = FRAMES, scene.steps // FRAMES
    controls = r2s.Control(jnp.zeros((*shape, 0, axes)), jnp.zeros((*shape, 3)))

    def loss(mu):
        return jnp.mean(r2s.simulate(solver, material(mu), start, controls).x[-1] ** 2)

    return loss, number(mpm_scenes.MU)


def _sheet_loss(scene):
    mesh, side = r2s.rectangle((0.45, 0.45), (17, 17)), 0.45
    fabric = presets.camel_ponte_roma()
    grid = Grid.covering((-0.2, -0.2, 0.0), (0.65, 0.65, 0.6), side / 16)
    around = r2s.Scene(mesh, jnp.array([0]), Table.make(0.0), Air.make())
    solver = Sheet.make(around, grid, fabric, 8e-4, membrane_damping=1e-4)
    x = jnp.pad(mesh.rest, ((0, 0), (0, 1)), constant_values=1e-3)
    shape = FRAMES, scene.steps // FRAMES
    time = jnp.arange(1, scene.steps + 1).reshape(*shape, 1, 1) / scene.steps
    path = x[0] + time * jnp.asarray(np.array([0.1, 0.1, 0.3]), x.dtype)
    controls = r2s.Control(path, jnp.zeros((*shape, 3)))

    def loss(c11):
        of = eqx.tree_at(lambda f: f.membrane.c11, fabric, c11)
        return jnp.mean(r2s.simulate(solver, of, solver.init(x), controls).x[-1] ** 2)

    return loss, fabric.membrane.c11
