"""What a scenario needs of a solver, and one that brakes a hanging sheet until it is at rest."""

from typing import Any, Protocol

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r2s.environment.scene import Control
from r2s.materials.fabric import Fabric
from r2s.solvers.simulate import Solver


class SheetSolver(Solver, Protocol):
    """A solver of a held sheet: ImplicitCloth, ExplicitCloth and MPMCloth."""

    def init(self, x: Array, v: Array | None = None, acceleration: Array | None = None) -> Any:
        """The state at positions [m], velocities [m/s] and accelerations [m/s^2]; None: zero."""

    def step_with_forces(self, fabric: Fabric, state: Any, control: Control) -> tuple[Any, Array]:
        """The state `dt` later, and the mean forces [N] on the pinned vertices, weight included."""
        ...


class BrakedState(eqx.Module):
    """The state of a solver (`inner`) after `count` steps."""

    inner: Any
    count: Array

    @property
    def x(self) -> Float[Array, "vertex 3"]:
        """Positions [m]."""
        return self.inner.x

    @property
    def v(self) -> Float[Array, "vertex 3"]:
        """Velocities [m/s]."""
        return self.inner.v

    @property
    def failure(self) -> Int[Array, ""]:
        """The first `r2s.solvers.results.Result` so far."""
        return self.inner.failure


class Braked(eqx.Module):
    """A solver of a sheet whose first `steps` have more mass damping, `brake` [1/s]."""

    solver: SheetSolver
    brake: Float[Array, ""]
    steps: int = eqx.field(static=True)
    dt: Float[Array, ""] | float

    def check(self, fabric: Fabric) -> None:
        """Raises `ValueError` where the steps are too long for a fabric."""
        self.solver.check(fabric)

    def fits(self, fabric: Fabric) -> Bool[Array, ""]:
        """Whether the steps of the solver are short enough for a fabric, as far as is known."""
        return self.solver.fits(fabric)

    def init(
        self, x: Array, v: Array | None = None, acceleration: Array | None = None
    ) -> BrakedState:
        """At positions [m], velocities [m/s] and accelerations [m/s^2]; None: zero."""
        return BrakedState(self.solver.init(x, v, acceleration), jnp.zeros((), int))

    def step(self, fabric: Fabric, state: BrakedState, control: Control) -> BrakedState:
        """The state `dt` later."""
        inner = self.solver.step(self._braked(fabric, state), state.inner, control)
        return BrakedState(inner, state.count + 1)

    def step_with_forces(
        self, fabric: Fabric, state: BrakedState, control: Control
    ) -> tuple[BrakedState, Float[Array, "pinned 3"]]:
        """The state `dt` later, and the grippers' forces [N] on the pinned vertices."""
        braked = self._braked(fabric, state)
        inner, forces = self.solver.step_with_forces(braked, state.inner, control)
        return BrakedState(inner, state.count + 1), forces

    def _braked(self, fabric: Fabric, state: BrakedState) -> Fabric:
        """The fabric with the mass damping [1/s] of this step."""
        brake = jnp.where(state.count < self.steps, self.brake, 0)
        return eqx.tree_at(lambda f: f.mass_damping, fabric, fabric.mass_damping + brake)
