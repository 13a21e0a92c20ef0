"""Wind and still air on the elements of a sheet, as forces on its vertices."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.environment.air import Air, Fan
from r2s.mesh.elements import area_normals
from r2s.mesh.mesh import Mesh

Vertices = Float[Array, "vertex 3"]


def drag_on_vertices(
    mesh: Mesh, air: Air, fan: Fan | None, x: Vertices, v: Vertices, wind: Float[Array, "*vertex 3"]
) -> Vertices:
    """The drag [N], from positions [m], velocities [m/s] and the wind [m/s] of a control.

    That on an element goes in equal parts to its corners.
    """
    strength = 1.0 if fan is None else fan(x)[:, None]
    flow = v - jnp.broadcast_to(wind, x.shape) * strength
    corners = mesh.samples.corners
    relative = jnp.mean(flow[corners], axis=1)
    force = -jax.vmap(jax.grad(air.dissipation))(relative, area_normals(mesh, x))
    share = force[:, None] / corners.shape[1]
    return jnp.zeros_like(x).at[corners].add(share)
