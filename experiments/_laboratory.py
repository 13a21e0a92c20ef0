"""Drapes and pulls of fabrics, for the experiments on laboratory tests."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float

from r2s.fabrics.fabric import Fabric
from r2s.laboratory.drape import Ring, coefficient, drape
from r2s.laboratory.pull import Pull


@eqx.filter_jit
def drapes_at(around: Ring, fabric: Fabric, seed: Array) -> Float[Array, ""]:
    """The drape coefficient of a fabric."""
    return coefficient(around, drape(around, fabric, jr.key(seed)))


@eqx.filter_jit
def slopes(around: Ring, fabric: Fabric) -> Float[Array, " 2"]:
    """Change of the coefficient for a relative change of bending and of shear, [-]."""

    def at(change):
        softer = eqx.tree_at(
            lambda f: (f.bending.stiffness, f.membrane.c33),
            fabric,
            (
                fabric.bending.stiffness * jnp.exp(change[0]),
                fabric.membrane.c33 * jnp.exp(change[1]),
            ),
        )
        return coefficient(around, drape(around, softer, jr.key(0)))

    return jax.jacfwd(at)(jnp.zeros(2))


@eqx.filter_jit
def _misfit(pull: Pull, fabric: Fabric) -> Float[Array, ""]:
    return pull.misfit(fabric)


def off(pulls: list[Pull], fabric: Fabric) -> float:
    """The error of the force: root mean square over samples, over the largest of a pull, [%]; the
    mean over pulls."""
    return 100 * float(np.mean([float(_misfit(pull, fabric)) for pull in pulls]))
