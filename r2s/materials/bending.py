"""Bending laws of hinges: the energy that a fabric stores in the angle between two triangles.

A hinge is an edge of rest length l with the rest area A of its two triangles. Its curvature is
theta l / A, its energy A times the law's energy per area. That is exact for bending along the lines
of a grid of squares, but up to three times too much across its diagonals, at any resolution, and
0.8 of it in a free strip. `r2s.materials.plate` has neither flaw.
"""

import math
from abc import abstractmethod
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.mesh.bends import Bends, HingeElements
from r2s.mesh.mesh import Mesh
from r2s.mesh.plate_elements import PlateElements


class BendingLaw(eqx.Module):
    """The methods of a bending law that solvers call; it defines the elements that it acts on.

    A user's law derives from `HingeLaw` (the angle between two triangles) or from
    `r2s.materials.plate.PlateLaw` (the curvature tensor).

    - `element`, `bend`: names of its elements and of its bends in the pattern of a matrix.
    """

    element: eqx.AbstractClassVar[str]
    bend: eqx.AbstractClassVar[str]

    @abstractmethod
    def elements(self, mesh: Mesh) -> HingeElements | PlateElements:
        """The elements of a mesh that it acts on."""

    @abstractmethod
    def on_elements(self, mesh: Mesh, bends: Float[Array, " bend"]) -> Any:
        """The law of every element in a time step that starts near these curvatures [1/m]."""

    @abstractmethod
    def stiffness_along(self, angle: float) -> Float[Array, ""]:
        """Stiffness [N m] of the flat sheet against bending at an angle [rad] to the warp."""

    def bends(self, mesh: Mesh) -> Bends:
        """The bends that the elements' curvatures are made of."""
        return self.elements(mesh).bends

    def areas(self, mesh: Mesh) -> Float[Array, " element"]:
        """The rest areas [m^2] of the elements."""
        return self.elements(mesh).areas

    def curvatures(self, mesh: Mesh, bends: Float[Array, " bend"]) -> Float[Array, "element ..."]:
        """The curvatures [1/m] of the elements, from those of all bends."""
        return self.elements(mesh).curvatures(bends)


class HingeLaw(BendingLaw):
    """A bending law of hinges: of the angle between two triangles."""

    element: ClassVar[str] = "hinges"
    bend: ClassVar[str] = "hinges"

    @abstractmethod
    def at(self, direction: Float[Array, ""], curvature: Float[Array, ""]) -> Any:
        """The law that a time step uses for a hinge which starts near this curvature [1/m].

        It has a method `energy_density(curvature)`: energy per rest area [J/m^2]. `direction` is
        the angle [rad], 0 to pi/2, between the warp and the line that the hinge bends, which is at
        right angles to its edge: 0 when warp yarns bend, pi/2 for weft yarns.
        """

    def elements(self, mesh: Mesh) -> HingeElements:
        """The hinges."""
        return HingeElements(mesh.hinge_bends, mesh.hinge_area)

    def on_elements(self, mesh: Mesh, bends: Float[Array, " hinge"]) -> Any:
        """The law of every hinge, by its direction and curvature [1/m]."""
        return jax.vmap(self.at)(mesh.hinge_direction, bends)

    def stiffness_along(self, angle: float) -> Float[Array, ""]:
        """Stiffness [N m] of a hinge that bends at an angle [rad], 0 to pi, to the warp."""
        zero = jnp.zeros((), float)
        law = self.at(jnp.asarray(min(angle, math.pi - angle), float), zero)
        return jax.hessian(law.energy_density)(zero)


class HingeBending(HingeLaw):
    """Bending with constant stiffness.

    - `stiffness`: moment per curvature and width, [N m].
    """

    stiffness: Float[Array, "*batch"]

    def at(self, direction: Float[Array, ""], curvature: Float[Array, ""]) -> "HingeBending":
        """Itself: its stiffness is constant."""
        return self

    def energy_density(self, curvature: Float[Array, ""]) -> Float[Array, ""]:
        """Energy per rest area [J/m^2] at a curvature [1/m]."""
        return self.stiffness * curvature**2 / 2
