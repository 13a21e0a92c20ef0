"""The size of a fabric's folds, which a mesh has to resolve."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from r2s._util.units import GRAVITY
from r2s.materials.fabric import Fabric

DIRECTIONS = (0.0, math.pi / 4, math.pi / 2, 3 * math.pi / 4)  # of bending, from the warp [rad]


def fold_length(fabric: Fabric) -> Float[Array, ""]:
    """The gravito-bending length [m], at which a fabric bends under its own weight.

    It is (bending / (density g))^(1/3), with the mean stiffness over four directions: Peirce's
    bending length (Journal of the Textile Institute 21, 1930). A strip of that length, held at one
    end, sags by an eighth of it. Longer cells cannot take the folds of a sheet, which then moves
    otherwise than a fine one (`docs/solvers.md` says by how much).

    >>> from r2s.materials import presets
    >>> round(float(1e3 * fold_length(presets.grey_interlock())), 1)  # [mm]
    14.3
    """
    along = jnp.stack([fabric.bending.stiffness_along(angle) for angle in DIRECTIONS])
    return (jnp.mean(along) / (fabric.density * GRAVITY)) ** (1 / 3)
