"""A scene: sheet, pinned vertices, table and air of an experiment; and the control of each step."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from r2s._util.arrays import is_traced
from r2s._util.checks import check_kinds
from r2s._util.units import AIR_DENSITY, GRAVITY
from r2s.environment.air import Air, Fan, wind_on_vertices
from r2s.environment.contact import Table
from r2s.mesh.mesh import Mesh


class Control(eqx.Module):
    """Positions of the grippers and the wind, at the end of one step or of every step of a motion.

    - `pinned`: positions of the pinned vertices, [m]: (pinned, 3), or (step, pinned, 3).
    - `wind`: [m/s], the same everywhere (3 numbers), or one for each vertex (vertex, 3); over a
      motion with a leading axis of steps, or one that stays. None: still air.
    """

    pinned: Float[Array, "*step pinned axis"]
    wind: Float[Array, "*step_and_vertex 3"] | None = None

    def at(self, step: Int[Array, ""] | int) -> "Control":
        """That of one step of a motion; a wind of 3 numbers stays.

        Raises `IndexError` for a number of a step that the motion does not have.
        """
        steps = len(self.pinned)
        if isinstance(step, int) and not -steps <= step < steps:
            raise IndexError(f"step {step} of a control that has {steps}")
        wind = self.wind
        if wind is not None and wind.ndim > 1:
            wind = wind[step]
        return Control(self.pinned[step], wind)


class Scene(eqx.Module):
    """The fixed parts of an experiment.

    - `mesh`: the sheet.
    - `pinned`: the vertices whose positions a `Control` gives.
    - `table`: horizontal, as `Table` or the height of its surface [m]; None: there is none.
    - `air`: as `Air` or its density [kg/m^3]; None: there is none.
    - `fan`: where the wind blows; None: everywhere.
    - `gravity`: downwards (along -z), [m/s^2].

    Raises `ValueError` for vertices that the mesh does not have, that stand twice or are no whole
    numbers, and for a gravity that is negative.
    """

    mesh: Mesh
    pinned: Int[Array, " pinned"]
    table: Table
    air: Air
    fan: Fan | None
    gravity: Float[Array, ""]

    def __init__(
        self,
        mesh: Mesh,
        pinned: Int[Array, " pinned"] | np.ndarray | Sequence[int] = (),
        table: Table | float | None = None,
        air: Air | float | None = AIR_DENSITY,
        fan: Fan | None = None,
        gravity: Float[Array, ""] | float = GRAVITY,
    ) -> None:
        check_kinds("Scene(mesh, pinned)", mesh=(mesh, Mesh))
        self.mesh, self.fan = mesh, fan
        numbers: Any = pinned if is_traced(pinned) else np.asarray(pinned)
        if numbers.size and not jnp.issubdtype(numbers.dtype, jnp.integer):
            raise ValueError(f"pinned must be whole numbers, of vertices; got {numbers.dtype}")
        if not is_traced(gravity) and not (np.ndim(gravity) == 0 and np.all(gravity >= 0)):
            raise ValueError(f"gravity acts downwards, one number [m/s^2] from 0 on; got {gravity}")
        self.pinned = jnp.asarray(pinned, int)
        self.table = table if isinstance(table, Table) else Table.make(table)
        self.air = air if isinstance(air, Air) else Air.make(0.0 if air is None else air)
        self.gravity = jnp.asarray(gravity, float)
        _check(mesh, self.pinned)

    @property
    def is_free(self) -> Bool[Array, " vertex"]:
        """Which vertices are not pinned."""
        return jnp.ones(self.mesh.rest.shape[0], bool).at[self.pinned].set(False)

    def check(self, state: Any, control: Control) -> None:
        """Raise `ValueError` for positions, grippers or wind of another shape than this scene's.

        Shapes are known where values are traced, too.
        """
        vertices, grippers = self.mesh.rest.shape[0], len(self.pinned)
        self.check_vertices(**{"state.x": state.x, "state.v": state.v})
        if control.pinned.shape != (grippers, 3):
            raise ValueError(
                f"control.pinned must be ({grippers}, 3) in a step, a place of each pinned "
                f"vertex; got {control.pinned.shape}"
            )
        if control.wind is not None and control.wind.shape not in ((3,), (vertices, 3)):
            raise ValueError(
                f"control.wind must be (3,) or ({vertices}, 3) in a step [m/s]; got "
                f"{control.wind.shape}"
            )

    def check_vertices(self, **arrays: Array | None) -> None:
        """Raise `ValueError` for an array that has not three finite numbers for each vertex."""
        expected = (self.mesh.rest.shape[0], 3)
        for name, array in arrays.items():
            if array is not None and array.shape != expected:
                raise ValueError(
                    f"{name} must be {expected}, a place or velocity of each vertex of the mesh; "
                    f"got {array.shape}"
                )
            if array is not None and not is_traced(array):
                bad = ~np.isfinite(np.asarray(array)).all(axis=1)
                if bad.any():
                    raise ValueError(f"{name} of vertex {int(bad.argmax())} is not finite")

    def starting(
        self, x: ArrayLike, v: ArrayLike | None = None, acceleration: ArrayLike | None = None
    ) -> tuple[Array, Array, Array]:
        """Positions, velocities and accelerations (default: zero) of the vertices in the precision
        of the mesh; raises as `check_vertices`."""
        x = jnp.asarray(x, self.mesh.rest.dtype)
        v, acceleration = (
            jnp.zeros_like(x) if each is None else jnp.asarray(each, x.dtype)
            for each in (v, acceleration)
        )
        self.check_vertices(x=x, v=v, acceleration=acceleration)
        return x, v, acceleration

    def place(
        self, x: Float[Array, "vertex 3"], pinned: Float[Array, "pinned 3"]
    ) -> Float[Array, "vertex 3"]:
        """Positions [m] with the pinned vertices put where `pinned` [m] says."""
        return x.at[self.pinned].set(pinned)

    def wind_on_elements(
        self, x: Float[Array, "vertex 3"], wind: Float[Array, "*vertex 3"] | None
    ) -> Float[Array, "element 3"]:
        """The wind [m/s] at the middle of every element, of a sheet at `x` [m]."""
        if wind is None:
            return jnp.zeros((len(self.mesh.samples.corners), 3), x.dtype)
        return jnp.mean(wind_on_vertices(self.fan, x, wind)[self.mesh.samples.corners], axis=1)


def _check(mesh: Mesh, pinned: Array) -> None:
    """Raise `ValueError` for pinned vertices that a mesh does not have, where they are known."""
    if pinned.ndim != 1:
        raise ValueError(f"pinned must be a list of vertices, got an array of {pinned.shape}")
    if is_traced(pinned):
        return
    count, numbers = mesh.rest.shape[0], np.asarray(pinned)
    beyond = numbers[(numbers < 0) | (numbers >= count)]
    if beyond.size:
        raise ValueError(f"pinned has vertex {beyond[0]}, the mesh has {count}: 0 to {count - 1}")
    if len(set(numbers.tolist())) < len(numbers):
        raise ValueError(f"a vertex is pinned twice: {sorted(numbers.tolist())}")


def along_path(
    times: Float[Array, " step"],
    knot_times: Float[Array, " knot"],
    path: Float[Array, "knot gripper 3"],
) -> Float[Array, "step gripper 3"]:
    """Gripper positions [m] at times [s], linear between the knots, at rest before and after.

    Raises `ValueError` for a path of another shape, and for knots whose times do not rise.
    """
    if path.ndim != 3 or path.shape[0] != knot_times.shape[0]:
        raise ValueError(
            f"path must be (knot, gripper, 3) with {knot_times.shape[0]} knots, got {path.shape}"
        )
    if not is_traced(knot_times) and np.any(np.diff(np.asarray(knot_times)) < 0):
        raise ValueError("knot_times must rise")
    knots = path.reshape(path.shape[0], -1)
    interpolated = jax.vmap(jnp.interp, in_axes=(None, None, 1), out_axes=1)
    return interpolated(times, knot_times, knots).reshape(times.shape[0], *path.shape[1:])
