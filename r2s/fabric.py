"""Fabric: what an estimator estimates. Presets with their provenance are in `r2s.presets`."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.physics.bending import HingeBending
from r2s.physics.membrane import OrthotropicMembrane


class Fabric(eqx.Module):
    """A fabric. A leading batch axis on every field makes it a sweep, for `jax.vmap`.

    - `density`: areal density, [kg/m^2].
    - `membrane`, `bending`: the laws of its energies, [N/m] and [N m].
    - `damping`: stiffness-proportional (Kelvin-Voigt) damping time, [s]: the viscous stress is
      `damping` times the stiffness times the rate of strain.
    - `friction`: Coulomb coefficient against the table, [-].
    - `thickness`: distance from the table at which contact begins, [m].
    """

    density: Float[Array, "*batch"]
    membrane: OrthotropicMembrane
    bending: HingeBending
    damping: Float[Array, "*batch"]
    friction: Float[Array, "*batch"]
    thickness: Float[Array, "*batch"]

    @classmethod
    def make(
        cls,
        density: float,
        membrane: tuple[float, float, float, float],
        bending: float,
        damping: float = 0.01,
        friction: float = 0.5,
        thickness: float = 1e-3,
    ) -> "Fabric":
        """A fabric from numbers: areal density [kg/m^2], (C11, C12, C22, C33) [N/m], bending
        stiffness [N m], damping time [s], friction [-], thickness [m].

        Raises `ValueError` when one is out of its physical range.
        """
        c11, c12, c22, c33 = membrane
        if not min(density, c11, c22, c33, thickness) > 0:
            raise ValueError(
                "density [kg/m^2], C11, C22, C33 [N/m] and thickness [m] must be positive, got "
                f"{density}, {c11}, {c22}, {c33} and {thickness}"
            )
        if not c12**2 < c11 * c22:
            raise ValueError(
                f"C12^2 must be less than C11 C22, or the sheet has a negative stiffness: "
                f"C12 = {c12} N/m, C11 C22 = {c11 * c22} (N/m)^2"
            )
        if not min(bending, damping, friction) >= 0:
            raise ValueError(
                "bending stiffness [N m], damping [s] and friction [-] must not be negative, got "
                f"{bending}, {damping} and {friction}"
            )
        array = lambda value: jnp.asarray(value, float)
        return cls(
            density=array(density),
            membrane=OrthotropicMembrane(array(c11), array(c12), array(c22), array(c33)),
            bending=HingeBending(array(bending)),
            damping=array(damping),
            friction=array(friction),
            thickness=array(thickness),
        )
