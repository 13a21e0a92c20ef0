"""A thousand fabrics at once: what does a corner's sag depend on?

    python examples/sweep_fabrics.py

A fabric whose fields have a leading axis is a sweep: one `vmap`, one compilation.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import r2s

FABRICS, STEPS = 1000, 10
sheet = r2s.rectangle((0.2, 0.2), (4, 4))  # [m]
pinned = jnp.array([0, 3])
scene = r2s.Scene(sheet, pinned)
solver = r2s.ImplicitCloth(scene, dt=0.025)  # [s]
start = sheet.lay_flat()
control = r2s.Control(jnp.broadcast_to(start[pinned], (STEPS, 2, 3)))
space = r2s.OrthotropicSpace.make(density=0.2)  # [kg/m^2]


@eqx.filter_jit
@eqx.filter_vmap
def sag(place):
    """How far the free corners have fallen [m], for places (fabric, parameter) of the space."""
    moved = r2s.simulate(solver, space(place), solver.init(start), control)
    return -moved.x[-1, jnp.array([12, 15]), 2].mean()


if __name__ == "__main__":
    places = jr.uniform(jr.key(0), (FABRICS, space.dim))
    began = time.process_time()
    found = np.asarray(jax.block_until_ready(sag(places)))
    seconds = time.process_time() - began
    print(f"{FABRICS} fabrics in {seconds:.1f} CPU seconds, compilation included")
    print(f"sag {1e3 * found.min():.1f} to {1e3 * found.max():.1f} mm; correlation with")
    for bound, column in zip(space.ranges, np.asarray(places).T, strict=True):
        print(f"    {bound.name:10s}{np.corrcoef(column, found)[0, 1]:+.2f}")
