"""Air: the pressure of wind, or of still air, on the faces of a sheet."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s._util.units import AIR_DENSITY, not_negative
from r2s.mesh.mesh import Mesh
from r2s.mesh.surface import area_normals

STILL = 1e-3  # [m/s]: below this flow along a face, its friction fades to linear


class Air(eqx.Module):
    """The air around a sheet.

    - `density`: [kg/m^3].
    - `drag_coefficient`: [-], of flow normal to a face, 2 for a plate broadside. The force on a
      face is (density drag_coefficient / 2) area |u| u along its normal, u the normal flow.
    - `friction_coefficient`: [-], of flow along a face, over both of its sides: the force is
      (density friction_coefficient / 2) area |w| w, w the flow in the face's plane. About 0.02
      for a sheet of 0.3 m in a breeze (Blasius, laminar: 2 x 1.33 / sqrt(Reynolds number)).
    """

    density: Float[Array, "*batch"]
    drag_coefficient: Float[Array, "*batch"]
    friction_coefficient: Float[Array, "*batch"]

    @classmethod
    def make(
        cls,
        density: float = AIR_DENSITY,
        drag_coefficient: float = 2.0,
        friction_coefficient: float = 0.02,
    ) -> "Air":
        """Air [kg/m^3] with coefficients of drag and of skin friction [-].

        Raises `ValueError` when one is negative.
        """
        not_negative("kg/m^3", density=density)
        not_negative("-", drag=drag_coefficient, friction=friction_coefficient)
        numbers = density, drag_coefficient, friction_coefficient
        return cls(*(jnp.asarray(number, float) for number in numbers))

    def dissipation(
        self, relative_velocity: Float[Array, " 3"], area_normal: Float[Array, " 3"]
    ) -> Float[Array, ""]:
        """The potential [W] whose negative gradient in velocity is the drag on a face [N].

        `relative_velocity` [m/s] is the face's less the wind's; `area_normal` [m^2] its normal
        times its area.
        """
        area = jnp.sqrt(area_normal @ area_normal)
        normal_flow = relative_velocity @ area_normal / area
        tangential = relative_velocity - normal_flow * area_normal / area
        squared = tangential @ tangential
        drag = self.drag_coefficient * jnp.abs(normal_flow) ** 3
        # not squared ** 1.5, whose second derivative is NaN in still air
        friction = self.friction_coefficient * squared * jnp.sqrt(squared + STILL**2)
        return self.density / 2 * area * (drag + friction) / 3


class Fan(eqx.Module):
    """A round jet of air of constant width: where the wind of a control blows, and how much.

    - `centre`: a point of its axis, [m].
    - `axis`: its direction; any length but 0.
    - `radius`: at which the wind is half of that on the axis, [m].
    - `edge`: over which it falls from 88 % to 12 %, [m].
    """

    centre: Float[Array, "*batch 3"]
    axis: Float[Array, "*batch 3"]
    radius: Float[Array, "*batch"]
    edge: Float[Array, "*batch"]

    def __call__(self, points: Float[Array, "point 3"]) -> Float[Array, " point"]:
        """The fraction [-] of the control's wind that blows at each point [m]."""
        offset = points - self.centre[None]
        along = self.axis / jnp.sqrt(self.axis @ self.axis)
        across = offset - jnp.outer(offset @ along, along)
        distance = jnp.sqrt(jnp.sum(across**2, axis=1) + (self.edge / 4) ** 2)  # smooth on the axis
        return jax.nn.sigmoid(4 * (self.radius - distance) / self.edge)


Vertices = Float[Array, "vertex 3"]


def wind_on_vertices(fan: Fan | None, x: Vertices, wind: Float[Array, "*vertex 3"]) -> Vertices:
    """The wind [m/s] of a control at positions [m]."""
    strength = 1.0 if fan is None else fan(x)[:, None]
    return jnp.broadcast_to(wind, x.shape) * strength


def drag_on_vertices(
    mesh: Mesh,
    air: Air,
    fan: Fan | None,
    x: Vertices,
    v: Vertices,
    wind: Float[Array, "*vertex 3"] | None,
) -> Vertices:
    """The drag [N], from positions [m], velocities [m/s] and the wind [m/s] of a control.

    That on an element goes in equal parts to its corners.
    """
    flow = v if wind is None else v - wind_on_vertices(fan, x, wind)
    corners = mesh.samples.corners
    relative = jnp.mean(flow[corners], axis=1)
    force = -jax.vmap(jax.grad(air.dissipation))(relative, area_normals(mesh, x))
    share = force[:, None] / corners.shape[1]
    return jnp.zeros_like(x).at[corners].add(share)
