"""A constitutive law of one's own: a membrane that stiffens when it is stretched.

    python examples/own_law.py

A law is a pytree of parameters with two methods; the solver and its derivatives need no more.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

import r2s
from r2s.materials import presets
from r2s.materials.membrane import OrthotropicMembrane


class Stiffening(eqx.Module):
    """Orthotropic, and stiffer by `rate` times the square of the strain's size [-]."""

    small: OrthotropicMembrane
    rate: Float[Array, ""]

    def at(self, strain: Float[Array, " 3"]) -> "Stiffening":
        return self  # its energy says it all

    def energy_density(self, strain: Float[Array, " 3"]) -> Float[Array, ""]:
        """[J/m^2] at a Green strain (E11, E22, 2 E12)."""
        return self.small.energy_density(strain) * (1 + self.rate * jnp.sum(strain**2))


sheet = r2s.rectangle((0.2, 0.2), (5, 5))  # [m]
pinned = jnp.array([0, 4])
scene = r2s.Scene(sheet, pinned)
solver = r2s.ImplicitCloth(scene, dt=0.02)  # [s]
start = sheet.lay_flat()
control = r2s.Control(jnp.broadcast_to(start[pinned], (20, 2, 3)))
knit = presets.grey_interlock()


@eqx.filter_jit
def lowest(rate):
    """How high the lowest point is [m] after 0.4 s."""
    fabric = dataclasses.replace(knit, membrane=Stiffening(knit.membrane, rate))
    return jnp.min(r2s.simulate(solver, fabric, solver.init(start), control).x[-1, :, 2])


if __name__ == "__main__":
    for rate in (0.0, 100.0, 1000.0):
        height, slope = eqx.filter_jit(jax.value_and_grad(lowest))(jnp.asarray(rate))
        print(f"rate {rate:6.0f}: {1e3 * height:8.3f} mm, derivative {1e6 * slope:+.4f} um per 1")
