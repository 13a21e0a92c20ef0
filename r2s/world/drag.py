"""Wind and still air on the triangles of a sheet, as forces on its vertices."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.geometry.mesh import Mesh
from r2s.world.air import Air, Fan

Vertices = Float[Array, "vertex 3"]


def drag_on_vertices(
    mesh: Mesh, air: Air, fan: Fan | None, x: Vertices, v: Vertices, wind: Float[Array, "*vertex 3"]
) -> Vertices:
    """The drag [N], from positions [m], velocities [m/s] and the wind [m/s] of a control.

    That on a face goes in equal parts to its corners.
    """
    strength = 1.0 if fan is None else fan(x)[:, None]
    flow = v - jnp.broadcast_to(wind, x.shape) * strength
    corners = x[mesh.faces]
    normals = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    relative = jnp.mean(flow[mesh.faces], axis=1)
    force = -jax.vmap(jax.grad(air.dissipation))(relative, normals) / 3
    return jnp.zeros_like(x).at[mesh.faces].add(force[:, None])
