"""The whole range of fabrics: values and gradients are finite in float32, in air and on a table."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cloth, flat

from r2s.environment.scene import Control
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import rectangle
from r2s.solvers.simulate import simulate

STIFFNESSES, BENDINGS = (3.0, 1e4), (1e-7, 1e-3)  # [N/m] and [N m]: what estimators look for
SIDE, CELLS = 0.3, 8  # [m], a side


@pytest.mark.slow(group="cloth")
@pytest.mark.parametrize("table", [None, 0.0])
def test_every_fabric_of_the_range_has_a_finite_gradient(table):
    with jax.enable_x64(False):
        mesh = rectangle((SIDE, SIDE), (CELLS + 1, CELLS + 1))
        solver = cloth(mesh, pinned=(0,), table=table, air=1.2, dt=1 / 60)
        along = jnp.minimum(jnp.arange(1, 61) / 60, 1.0)
        path = jnp.stack([0.1 * along, 0.1 * along, 1e-3 + 0.2 * along], axis=-1)
        control = Control(path[:, None])
        start = solver.init(flat(mesh, 1e-3))

        @eqx.filter_jit
        @jax.value_and_grad
        def end(fabric):
            return jnp.mean(simulate(solver, fabric, start, control, save_every=3).x[-1] ** 2)

        for c11, c22, bending in itertools.product(STIFFNESSES, STIFFNESSES, BENDINGS):
            law = (c11, 0.2 * (c11 * c22) ** 0.5, c22, 0.3 * min(c11, c22))
            numbers = np.array(jax.tree.leaves(end(Fabric.make(0.05, law, bending))))
            assert numbers.dtype == np.float32
            assert np.all(np.isfinite(numbers)), (c11, c22, bending)
