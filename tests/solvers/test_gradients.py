"""Derivatives of a whole motion: a corner lifted off a table, with friction, air and wind."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DT, assert_gradient, cloth, everywhere, flat
from jaxtyping import Array, Float

from r2s._util.units import AIR_DENSITY
from r2s.environment.contact import Table
from r2s.environment.scene import Control, along_path
from r2s.materials.fabric import Fabric
from r2s.solvers.implicit.cloth import ImplicitCloth
from r2s.solvers.simulate import simulate

FRAMES, SUBSTEPS = 6, 5
KNOTS = jnp.linspace(0, FRAMES * SUBSTEPS * DT, 4)
REST = 0.93e-3  # where the pressure of the table carries the sheet, [m]


class Inputs(eqx.Module):
    """Everything that a motion depends on."""

    fabric: Fabric
    x: Float[Array, "vertex 3"]
    v: Float[Array, "vertex 3"]
    path: Float[Array, "knot gripper 3"]
    height: Float[Array, ""]
    wind: Float[Array, " 3"]


@pytest.fixture(scope="module")
def inputs(sheet, fabric):
    x = flat(sheet, REST)
    # up, and to the side, so that the rest slides on the table
    shift = jnp.array([[[0.0, 0.0, 0.0]], [[0.03, 0.01, 0.03]], [[0.06, 0.02, 0.06]]])
    path = x[:1][None] + jnp.concatenate([shift, shift[-1:] + jnp.array([[[0.02, 0.0, 0.01]]])])
    v = everywhere([0.05, 0.02, 0.0], sheet)
    return Inputs(fabric, x, v, path, jnp.asarray(0.0, float), jnp.array([0.5, -0.3, 0.8]))


ALPHA = pytest.param(0.6, marks=pytest.mark.slow(group="cloth"), id="alpha")


@pytest.fixture(scope="module", params=[pytest.param(None, id="BDF2"), ALPHA])
def run(sheet, request):
    """The motion of inputs, as a function of them, by either method."""
    fixed = cloth(sheet, pinned=(0,), table=0.0, air=AIR_DENSITY)
    accurate = {"tolerance": 1e-13, "spectral_radius": request.param}  # differences: little noise

    def run(inputs):
        scene = eqx.tree_at(lambda scene: scene.table, fixed.scene, Table(inputs.height))
        solver = ImplicitCloth(scene, DT, **accurate)
        times = jnp.arange(1, FRAMES * SUBSTEPS + 1).astype(float) * DT
        control = Control(along_path(times, KNOTS, inputs.path), inputs.wind)
        start = solver.init(inputs.x, inputs.v)
        return simulate(solver, inputs.fabric, start, control, save_every=SUBSTEPS).x

    return run


@pytest.fixture(scope="module")
def loss(run):
    """A scalar of all positions in all frames [m]."""
    weights = jax.random.normal(jax.random.key(1), (FRAMES, 25, 3))
    return lambda inputs: (lambda x: (jnp.sum(weights * x), x))(run(inputs))


@pytest.fixture(scope="module")
def value_and_grad(loss):
    """Compiled; once more at most, since programs are freed between tests."""
    function = jax.value_and_grad(loss, has_aux=True)
    return jax.jit(eqx.debug.assert_max_traces(function, max_traces=2))


@pytest.fixture(scope="module")
def gradient(value_and_grad, inputs):
    return value_and_grad(inputs)[1]


WHERE = {  # what to differ, and by how much [in its unit]
    "density": (lambda i: i.fabric.density, 1e-6),
    "c11": (lambda i: i.fabric.membrane.c11, 1e-1),
    "c12": (lambda i: i.fabric.membrane.c12, 1e-1),
    "c22": (lambda i: i.fabric.membrane.c22, 1e-1),
    "c33": (lambda i: i.fabric.membrane.c33, 1e-1),
    "bending": (lambda i: i.fabric.bending.stiffness, 1e-8),
    "damping": (lambda i: i.fabric.damping, 1e-5),
    "friction": (lambda i: i.fabric.friction, 1e-6),
    "thickness": (lambda i: i.fabric.thickness, 1e-8),
    "mass damping": (lambda i: i.fabric.mass_damping, 1e-5),
    "positions": (lambda i: i.x, 1e-9),
    "velocities": (lambda i: i.v, 1e-6),
    "path": (lambda i: i.path, 1e-8),
    "table height": (lambda i: i.height, 1e-8),
    "wind": (lambda i: i.wind, 1e-5),
}


@pytest.mark.parametrize("name", WHERE)
def test_the_gradient_agrees_with_differences(name, value_and_grad, gradient, inputs):
    assert_gradient(lambda at: value_and_grad(at)[0][0], gradient, inputs, *WHERE[name], rel=1e-4)


@pytest.mark.slow(group="cloth")
def test_forward_mode_equals_reverse_mode(loss, gradient, inputs):
    keys = iter(jax.random.split(jax.random.key(3), 20))
    # relative, so that all parameters count
    tangent = jax.tree.map(lambda a: a * jax.random.normal(next(keys), a.shape), inputs)
    _, forward, _ = jax.jit(lambda i, d: jax.jvp(loss, (i,), (d,), has_aux=True))(inputs, tangent)
    products = jax.tree.map(lambda g, d: jnp.sum(g * d), gradient, tangent)
    assert forward == pytest.approx(float(sum(jax.tree.leaves(products))), rel=1e-8)


@pytest.fixture(scope="module")
def several(inputs):
    """Inputs with three fabrics."""
    fabrics = (
        inputs.fabric,
        Fabric.make(0.1, (50.0, -10.0, 80.0, 20.0), 1e-6, damping=0.02),
        Fabric.make(0.4, (2e3, 5e2, 1e3, 3e2), 1e-4, damping=1e-3, friction=1.2),
    )
    return [eqx.tree_at(lambda inputs: inputs.fabric, inputs, fabric) for fabric in fabrics]


def test_one_compilation_serves_all_fabrics(value_and_grad, several):
    values = [value_and_grad(inputs)[0][0] for inputs in several]
    assert value_and_grad._cache_size() == 1
    assert len({float(value) for value in values}) == 3


@pytest.mark.slow(group="cloth")
def test_a_batch_of_fabrics_equals_the_loop(loss, value_and_grad, several):
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
    (value, x), slope = jax.jit(jax.vmap(jax.value_and_grad(loss, has_aux=True)))(batch)
    for i, single in enumerate(several):
        (expected, expected_x), expected_slope = value_and_grad(single)
        assert value[i] == pytest.approx(float(expected), rel=1e-9)
        assert np.asarray(x[i]) == pytest.approx(np.asarray(expected_x), abs=1e-10)
        for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(expected_slope), strict=True):
            error = np.max(np.abs(np.asarray(a[i]) - np.asarray(b)))
            assert error <= 1e-7 * np.max(np.abs(np.asarray(b)))  # conditioning of the solves
