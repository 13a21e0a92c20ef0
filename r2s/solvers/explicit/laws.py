"""What laws of one element say of arrays of strains or curvatures side by side."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from r2s.materials.fabric import Fabric
from r2s.materials.membrane import OrthotropicMembrane
from r2s.materials.plate import OrthotropicPlate, PlateBending
from r2s.materials.wrinkling import Prepared, mean_bending, prepare_search
from r2s.mesh.vectors import Vector, add, dot, scale

CONSTANT = OrthotropicMembrane, PlateBending, OrthotropicPlate


class Response(NamedTuple):
    """A law for arrays (place), or (place, member).

    - `law`: of one element, or one of each member along the last axis of its arrays.
    - `stiffness`: (3, 3, ...), of a law whose stiffness is constant; None: of any other.
    - `batched`: whether there are members.
    """

    law: Any
    stiffness: Array | None
    batched: bool

    def elastic(self, strain: Vector) -> tuple[Vector, Array]:
        """Stress, and stiffness at zero strain (3, 3, ...)."""
        if self.stiffness is not None:
            return self._linear(strain), self.stiffness
        (one, two, three), _, stiffness = self._of_places(strain, strain)
        return (one, two, three), stiffness

    def damped(self, strain: Vector, rate: Vector, damping: Array) -> Vector:
        """Stress with Kelvin-Voigt viscosity.

        - `rate`: of the strain, [1/s]; `damping`: damping time, [s].
        """
        if self.stiffness is not None:
            return self._linear(add(strain, scale(damping, rate)))
        (one, two, three), viscous, _ = self._of_places(strain, rate)
        return add((one, two, three), scale(damping, tuple(viscous)))

    def _linear(self, strain: Vector) -> Vector:
        assert self.stiffness is not None
        one, two, three = (dot((row[0], row[1], row[2]), strain) for row in self.stiffness)
        return one, two, three

    def _of_places(self, strain: Vector, rate: Vector):
        of_places = jax.vmap(_stresses, in_axes=(None, 1, 1), out_axes=-1)
        if self.batched:
            of_places = jax.vmap(of_places, in_axes=-1, out_axes=-1)
        return of_places(self.law, jnp.stack(strain), jnp.stack(rate))


def response(law: Any, batched: bool) -> Response:
    """Of a membrane or a plate."""
    if not isinstance(law, CONSTANT):
        return Response(law, None, batched)

    def of_one(law):
        return jax.hessian(law.energy_density)(jnp.zeros(3, jax.tree.leaves(law)[0].dtype))

    if not batched:
        return Response(law, of_one(law), False)
    return Response(law, jax.vmap(of_one, in_axes=-1, out_axes=-1)(law)[:, :, None], True)


def critical_stress(fabric: Fabric, waves: tuple[float, float], batched: bool) -> Array:
    """Compressive stress (2, ...) [N/m] at which cells buckle, as in `r2s.materials.wrinkling`."""
    squares = jnp.asarray([wave**2 for wave in waves], float)
    if not batched:
        return mean_bending(fabric.bending) * squares
    bent = jax.vmap(mean_bending, in_axes=-1)(fabric.bending)
    return squares[:, None, None] * bent[None, None]


def hiding_of(law: Response, critical: Array, stiffness: Array) -> Prepared:
    """What wrinkles depend on, beside the strain."""
    rank = stiffness.ndim - 1
    if law.stiffness is None and not law.batched:
        critical = critical[:, None]
    return prepare_search(
        stiffness, critical.reshape(*critical.shape, *(1,) * (rank - critical.ndim))
    )


def _stresses(law: Any, strain: Array, rate: Array) -> tuple[Array, Array, Array]:
    here = law.at(strain)
    stress, viscous = jax.jvp(jax.grad(here.energy_density), (strain,), (rate,))
    return stress, viscous, jax.hessian(here.energy_density)(jnp.zeros_like(strain))
