"""Whether numbers are known yet."""

from typing import Any

import jax
from jax.core import Tracer


def is_traced(*trees: Any) -> bool:
    """Whether some array of some pytrees is traced, so that its numbers are not known."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))
