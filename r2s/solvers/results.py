"""What the steps of all solvers share: checks of their arguments, and how a run ended."""

import enum
from typing import Any, SupportsInt

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from r2s._util.checks import check_kinds
from r2s.environment.scene import Control, Scene
from r2s.materials.fabric import Fabric

LONGEST = 10.0  # [s], of a step, as while a sheet comes to rest: more is hardly meant in seconds


class Result(enum.IntEnum):
    """Success, or what failed first. A state carries it as an integer, which passes through
    `jax.jit`."""

    SUCCESS = 0
    NEWTON = 1
    SELF_CONTACT = 2
    LINEAR_SOLVE = 3
    GRID = 4
    TIME_STEP = 5
    NON_FINITE = 6


_SENTENCES = {
    Result.SUCCESS: "Nothing failed.",
    Result.NEWTON: "Newton's method did not converge: shorten the step, or allow more iterations.",
    Result.SELF_CONTACT: (
        "The contacts of the fabric with itself were not resolved: shorten the step, or allow more "
        "rounds of contact."
    ),
    Result.LINEAR_SOLVE: (
        "The linear solve of a Newton step failed: check that stiffnesses and masses are positive "
        "and finite, or shorten the step."
    ),
    Result.GRID: "A particle left the grid: enlarge the grid, or shorten the step.",
    Result.TIME_STEP: (
        "The explicit time step was unstable: shorten the step, soften the material, or coarsen "
        "the grid."
    ),
    Result.NON_FINITE: (
        "A position became infinite or not a number: check the fabric, the control and the initial "
        "state, or shorten the step."
    ),
}


def describe(code: SupportsInt) -> str:
    """One sentence that says what a failure code means and what to do.

    Accepts a `Result`, an integer or an integer array without axes. Raises `ValueError` for a
    number that is no code.
    """
    return _SENTENCES[Result(int(code))]


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Whether all numbers of a tree of arrays are finite."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))


def no_failure() -> Int[Array, ""]:
    """The code of a run in which nothing has failed."""
    return jnp.zeros((), int)


def first_failure(before: Int[Array, ""], now: Int[Array, ""]) -> Int[Array, ""]:
    """The code of a run so far and of what comes after it: the first failure stays."""
    return jnp.where(before == Result.SUCCESS.value, now, before).astype(int)


def check_step_arguments(
    scene: Scene, fabric: Any, state: Any, control: Any, kind: type[Any]
) -> None:
    """Raise `TypeError` for arguments in another order, `ValueError` for shapes that do not fit.

    - `kind`: that of the solver's states.
    """
    expected = {"fabric": (fabric, Fabric), "state": (state, kind), "control": (control, Control)}
    check_kinds("step(fabric, state, control)", **expected)
    scene.check(state, control)
