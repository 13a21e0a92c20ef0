"""Bending laws of hinges: the energy that a fabric stores in the angle between two triangles.

A hinge is an edge of rest length l with the rest area A of its two triangles. Its curvature is
theta l / A, its energy A times the law's energy per area. On a grid of squares whose lines stay
straight that is the energy of the bent continuum exactly, for bending along the grid's lines.
Across its diagonals it is up to half as much again where these alternate, and between once and
three times as much where they are parallel, at any resolution. A strip along the warp, free to
zigzag or twist, is softer: 1 / (1 / warp + 1 / (4 bias)) of hinge stiffnesses, 0.8 of a stiffness
that is the same in all directions. `r2s.materials.plate` has neither flaw.

A law is a pytree of parameters. A `BendingLaw` owns the element that it acts on, so that solvers
need not know which kind it is; a law of hinges derives from `HingeLaw`.
"""

import math
from abc import abstractmethod
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from r2s.mesh.bends import Bends
from r2s.mesh.mesh import Mesh


class BendingLaw(eqx.Module):
    """What the solvers ask of a bending law, which owns the element that it acts on.

    A law of one's own derives from `HingeLaw` (the angle between two triangles) or from
    `r2s.materials.plate.PlateLaw` (the curvature tensor). Curvatures of all its bends go in
    (`r2s.mesh.bends`).

    - `element`, `bend`: what its elements and its bends are called in the pattern of a matrix.
    """

    element: eqx.AbstractClassVar[str]
    bend: eqx.AbstractClassVar[str]

    @abstractmethod
    def bends(self, mesh: Mesh) -> Bends:
        """What it sees of a bent sheet."""

    @abstractmethod
    def vertices(self, mesh: Mesh) -> Int[Array, "element corner"]:
        """The vertices that each element's curvature depends on."""

    @abstractmethod
    def areas(self, mesh: Mesh) -> Float[Array, " element"]:
        """The rest areas [m^2] of the elements."""

    @abstractmethod
    def curvatures(self, mesh: Mesh, bends: Float[Array, " bend"]) -> Float[Array, "element ..."]:
        """The curvatures [1/m] of the elements, from those of all bends."""

    @abstractmethod
    def gradients(
        self, mesh: Mesh, bends: Float[Array, "bend corner 3"]
    ) -> Float[Array, "element strain corner 3"]:
        """Derivatives [1/m^2] of the elements' curvatures in their vertices, from the bends'."""

    @abstractmethod
    def on_elements(self, mesh: Mesh, bends: Float[Array, " bend"]) -> Any:
        """The law of every element in a time step that starts near these curvatures [1/m]."""

    @abstractmethod
    def stiffness_along(self, angle: float) -> Float[Array, ""]:
        """Stiffness [N m] of the flat sheet against bending at an angle [rad] to the warp."""


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

    def bends(self, mesh: Mesh) -> Bends:
        """The hinges."""
        return mesh.hinge_bends

    def vertices(self, mesh: Mesh) -> Int[Array, "hinge 4"]:
        """The ends of each hinge's edge, then the vertices opposite to it."""
        return mesh.hinges

    def areas(self, mesh: Mesh) -> Float[Array, " hinge"]:
        """The rest areas [m^2] of the hinges' two faces together."""
        return mesh.hinge_area

    def curvatures(self, mesh: Mesh, bends: Float[Array, " hinge"]) -> Float[Array, " hinge"]:
        """The curvatures of the hinges themselves, [1/m]."""
        del mesh
        return bends

    def gradients(
        self, mesh: Mesh, bends: Float[Array, "hinge 4 3"]
    ) -> Float[Array, "hinge 1 4 3"]:
        """The gradients of the hinges themselves, [1/m^2]."""
        del mesh
        return bends[:, None]

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
