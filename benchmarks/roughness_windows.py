"""Short windows, each from the state that the sheet was in: a solver that is started again."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s.estimation.problem import Problem
from r2s.fabrics.fabric import Fabric
from r2s.scenarios.scenario import Scenario, begin, stepped
from r2s.world.scene import Control, Scene

FRAMES = 5  # of a window


class RestartedState(eqx.Module):
    """- `inner`: of the solver. - `count`: of the steps made."""

    inner: Any
    count: Array

    @property
    def x(self) -> Float[Array, "vertex 3"]:
        """Positions [m]."""
        return self.inner.x


class Restarted(eqx.Module):
    """A solver that every `FRAMES` frames goes on from a given state.

    - `solver`: any, of a `Fabric`.
    - `states`: at the ends of all frames.
    - `substeps`: steps of a frame.
    - `dt`: step, [s].
    """

    solver: Any
    states: Any
    substeps: int = eqx.field(static=True)
    dt: float = eqx.field(static=True)

    @property
    def scene(self) -> Scene:
        """Of the solver."""
        return self.solver.scene

    def init(self, x: Float[Array, "vertex 3"]) -> RestartedState:
        """At rest at positions [m]."""
        return RestartedState(self.solver.init(x), jnp.zeros((), int))

    def step(self, fabric: Fabric, state: RestartedState, control: Control) -> RestartedState:
        """The state `dt` later."""
        again = (state.count % (FRAMES * self.substeps) == 0) & (state.count > 0)
        frame = state.count // self.substeps - 1
        pick = lambda given, own: jnp.where(again, given[frame], own)
        inner = jax.tree.map(pick, self.states, state.inner)
        return RestartedState(self.solver.step(fabric, inner, control), state.count + 1)


def restarted(problem: Problem, fabric: Fabric, error: float = 0.0) -> Problem:
    """The problem with windows that begin with what a fabric does.

    With an `error` [m], that deviation of each coordinate as it is seen, and with velocities from
    the differences between frames: what tracking the sheet would give.
    """
    scenario = problem.scenario
    solver, substeps = stepped(scenario)
    states = _states(scenario, fabric)
    if error:
        noise = jax.random.normal(jax.random.key(9), states.x.shape, float)
        x = states.x + error * noise
        v = jnp.gradient(x, scenario.interval, axis=0)
        states = jax.vmap(solver.init)(x, v)  # pyright: ignore[reportAttributeAccessIssue]
    again = Restarted(solver, states, substeps, solver.dt)
    return dataclasses.replace(problem, solver=again)


@eqx.filter_jit
def _states(scenario: Scenario, fabric: Fabric) -> Any:
    """Of the cloth, at the ends of all frames."""
    solver, substeps = stepped(scenario)

    def frame(state, control):
        step = lambda state, control: (solver.step(fabric, state, control), None)
        state, _ = jax.lax.scan(step, state, control)
        return state, state

    return jax.lax.scan(frame, begin(solver, scenario), scenario.controls(substeps))[1]
