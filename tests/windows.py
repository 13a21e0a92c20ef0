"""Problems of which some frames count."""

import dataclasses
from typing import Any

import jax.numpy as jnp

from r2s.estimation.problem import Problem


def window(problem: Problem, first: int, last: int) -> Problem:
    """The problem in which only the frames from `first` to `last` count."""
    kept = [i for i, frame in enumerate(problem.frames) if first <= frame <= last]
    index = jnp.array(kept)

    def pick(part: Any, names: tuple[str, ...]) -> Any:
        if part is None:
            return None
        return dataclasses.replace(part, **{name: getattr(part, name)[index] for name in names})

    return dataclasses.replace(
        problem,
        frames=tuple(problem.frames[i] for i in kept),
        clouds=pick(problem.clouds, ("points", "mask")),
        markers=pick(problem.markers, ("positions", "seen")),
        force=pick(problem.force, ("values", "seen")),
        expected=pick(problem.expected, ("grippers", "targets", "mask", "apart")),
    )
