"""The whole range of fabrics: values and gradients are finite in float32, in air and on a table."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cloth, flat

from r2s._util.units import GRAVITY
from r2s.environment.scene import Control
from r2s.materials.fabric import Fabric
from r2s.mesh.mesh import rectangle
from r2s.solvers.simulate import simulate

STIFFNESSES = (3.0, 1e2, 1e4)  # [N/m]: from the softest that estimators look for
BENDINGS = (1e-7, 1e-5, 1e-3)  # [N m]
DENSITIES = (0.05, 0.5)  # [kg/m^2]
SIDE, CELLS = 0.3, 8  # [m], a side
# A fabric is none whose weight, hung on one vertex, is more than its stiffness over a cell can
# carry: in this range those of 3 N/m and 0.5 kg/m^2, which stretch to three times their length.
MOST_WEIGHT = 1.0


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
        def both(fabric):
            def run(fabric):
                return jnp.mean(simulate(solver, fabric, start, control, save_every=3).x[-1] ** 2)

            return jax.value_and_grad(run)(fabric)

        failed, tried = [], 0
        for c11, c22, bending, density in itertools.product(
            STIFFNESSES, STIFFNESSES, BENDINGS, DENSITIES
        ):
            softest = min(c11, c22) * SIDE / CELLS
            if density * GRAVITY * SIDE**2 > MOST_WEIGHT * softest:
                continue
            law = (c11, 0.2 * (c11 * c22) ** 0.5, c22, 0.3 * min(c11, c22))
            tried += 1
            value, gradient = both(Fabric.make(density, law, bending))
            numbers = np.array([value, *jax.tree.leaves(gradient)])
            assert numbers.dtype == np.float32
            if not np.all(np.isfinite(numbers)):
                failed.append((c11, c22, bending, density))
        assert tried == 39 and not failed
