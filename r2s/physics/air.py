"""Air: the pressure of wind, or of still air, on the faces of a sheet."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.units import AIR_DENSITY


class Air(eqx.Module):
    """The air around a sheet.

    - `density`: [kg/m^3].
    - `drag_coefficient`: [-], of flow normal to a face, 2 for a plate broadside. The force on a
      face is (density drag_coefficient / 2) area |u| u along its normal, u the normal flow.
    """

    density: Float[Array, "*batch"]
    drag_coefficient: Float[Array, "*batch"]

    @classmethod
    def make(cls, density: float = AIR_DENSITY, drag_coefficient: float = 2.0) -> "Air":
        """Air [kg/m^3] with a drag coefficient [-]; raises `ValueError` when either is negative."""
        if density < 0 or drag_coefficient < 0:
            raise ValueError(
                "air needs a density >= 0 kg/m^3 and a drag coefficient >= 0, "
                f"got {density} and {drag_coefficient}"
            )
        return cls(jnp.asarray(density, float), jnp.asarray(drag_coefficient, float))

    def dissipation(
        self, relative_velocity: Float[Array, " 3"], area_normal: Float[Array, " 3"]
    ) -> Float[Array, ""]:
        """The potential [W] whose negative gradient in velocity is the drag on a face [N].

        `relative_velocity` [m/s] is the face's less the wind's; `area_normal` [m^2] its normal
        times its area.
        """
        area = jnp.sqrt(area_normal @ area_normal)
        normal_flow = jnp.abs(relative_velocity @ area_normal) / area
        return self.density * self.drag_coefficient / 2 * area * normal_flow**3 / 3
