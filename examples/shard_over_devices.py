"""The same sweep on all devices: `shard_map`, here over two that are made of one CPU.

python examples/shard_over_devices.py
"""

import os

if "host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
    two = "--xla_force_host_platform_device_count=2"  # only before jax is imported
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {two}"

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import jax.random as jr  # noqa: E402
import numpy as np  # noqa: E402
from jax.sharding import Mesh, PartitionSpec  # noqa: E402

import r2s  # noqa: E402

FABRICS, STEPS = 16, 10
sheet = r2s.rectangle((0.2, 0.2), (4, 4))  # [m]
pinned = jnp.array([0, 3])
scene = r2s.Scene(sheet, pinned)
solver = r2s.ImplicitCloth(scene, dt=0.025)  # [s]
start = jnp.pad(sheet.rest, ((0, 0), (0, 1)))
control = r2s.Control(jnp.broadcast_to(start[pinned], (STEPS, 2, 3)))
space = r2s.OrthotropicSpace.make(density=0.2)  # [kg/m^2]


def sag(place):
    """How far the free corners have fallen [m]."""
    moved = r2s.simulate(solver, space(place), solver.init(start), control)
    return -moved.x[-1, jnp.array([12, 15]), 2].mean()


if __name__ == "__main__":
    places = jr.uniform(jr.key(0), (FABRICS, space.dim))
    along = PartitionSpec("fabric")
    devices = Mesh(np.array(jax.devices()), ("fabric",))
    each = jax.vmap(sag)  # of the fabrics on one device
    on_all = jax.jit(
        jax.shard_map(each, mesh=devices, in_specs=along, out_specs=along, check_vma=False)
    )
    found = on_all(places)
    print(f"{len(found.sharding.device_set)} devices, {FABRICS} fabrics")
    alone = jax.jit(each)(places)
    print(f"largest difference from one device: {1e3 * float(abs(found - alone).max()):.6f} mm")
