"""A scene: what an experiment fixes. Sheet, held vertices, table, air; and what grippers do."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r2s.environment.air import Air, Fan
from r2s.environment.contact import Table
from r2s.mesh.mesh import Mesh


class Control(eqx.Module):
    """What grippers and air do: at one step, or with a leading time axis over a motion.

    - `handles`: positions of the held vertices at the end of the step, [m].
    - `wind`: [m/s], uniform (3 numbers), or one for each vertex (vertex, 3).
    """

    handles: Float[Array, "*time handle axis"]
    wind: Float[Array, "*time_and_vertex 3"]


class Scene(eqx.Module):
    """What an experiment fixes; gravity is 9.81 m/s^2 along -z.

    - `mesh`: the sheet.
    - `held`: the vertices that grippers hold, one a handle.
    - `table`, `air`: the surroundings.
    - `fan`: where the wind blows; None: everywhere.
    """

    mesh: Mesh
    held: Int[Array, " handle"]
    table: Table
    air: Air
    fan: Fan | None = None

    @property
    def is_free(self) -> Bool[Array, " vertex"]:
        """Which vertices no gripper holds."""
        return jnp.ones(self.mesh.rest.shape[0], bool).at[self.held].set(False)

    def place(
        self, x: Float[Array, "vertex 3"], handles: Float[Array, "handle 3"]
    ) -> Float[Array, "vertex 3"]:
        """Positions with the held vertices put to `handles` [m]."""
        return x.at[self.held].set(handles)

    def wind_on_elements(
        self, x: Float[Array, "vertex 3"], wind: Float[Array, "*vertex 3"]
    ) -> Float[Array, "element 3"]:
        """The wind [m/s] at the middle of every element, of a sheet at `x` [m]."""
        strength = 1.0 if self.fan is None else self.fan(x)[:, None]
        at_vertices = jnp.broadcast_to(wind, x.shape) * strength
        return jnp.mean(at_vertices[self.mesh.samples.corners], axis=1)


def along_path(
    times: Float[Array, " step"],
    knot_times: Float[Array, " knot"],
    path: Float[Array, "knot handle 3"],
) -> Float[Array, "step handle 3"]:
    """Handle positions [m] at times [s], linear between the knots, at rest before and after."""
    knots = path.reshape(path.shape[0], -1)
    at = jax.vmap(lambda column: jnp.interp(times, knot_times, column), in_axes=1, out_axes=1)
    return at(knots).reshape(times.shape[0], *path.shape[1:])
