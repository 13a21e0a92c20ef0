"""Drape coefficients of the five fabrics: over folds that start otherwise, and on finer meshes.

python experiments/drapes.py      # 6 minutes on one core

Each fabric's specimen is simulated from several seeds on the usual ring, and from one on a ring of
a third and of four times as many vertices. Also by how much the coefficient changes with bending
and with shear, for a relative change, as its derivative says.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from _tables import Line, command_line, keep
from jaxtyping import Array, Float

from r2s.fabrics import presets
from r2s.fabrics.fabric import Fabric
from r2s.laboratory.drape import Ring, coefficient, drape, ring

SEEDS = 8
COARSE, FINE = (44, 6), (144, 20)


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


if __name__ == "__main__":
    a = command_line(__doc__, "results/drapes.csv").parse_args()
    usual, coarse, fine = ring(), ring(shape=COARSE), ring(shape=FINE)
    lines: list[Line] = []
    for name in presets.FIVE:
        fabric = presets.MEASURED[name]()
        found = [float(drapes_at(usual, fabric, jnp.asarray(seed))) for seed in range(SEEDS)]
        bending, shear = slopes(usual, fabric)
        row = {"mean": np.mean(found), "deviation over seeds": np.std(found, ddof=1)}
        row |= {
            f"{shape[0]} x {shape[1]}": float(drapes_at(each, fabric, jnp.asarray(0)))
            for shape, each in ((COARSE, coarse), (FINE, fine))
        }
        row |= {"per bending": float(bending), "per shear": float(shear)}
        lines.append({"fabric": name} | {key: f"{value:.3f}" for key, value in row.items()})
        keep(a.out, lines, "Drape coefficients, 0.30 m discs on 0.18 m [-].")
