"""Fit a fabric with a loss of one's own: here, how far a strip hangs down.

    python examples/fit_own_loss.py

A space maps the unit cube to fabrics; any differentiable function of a motion is a loss.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

import r2s

STEPS = 40
sheet = r2s.rectangle((0.15, 0.05), (7, 3))  # [m]
pinned = jnp.arange(6)  # the first two rows: a strip that is clamped, and droops
scene = r2s.Scene(sheet, pinned)
solver = r2s.ImplicitCloth(scene, dt=0.02)  # [s]
start = sheet.lay_flat()
space = r2s.OrthotropicSpace.make(density=0.2)  # [kg/m^2]
BENDING = [bound.name for bound in space.ranges].index("bending")
control = r2s.Control(jnp.broadcast_to(start[pinned], (STEPS, 6, 3)))


def droop(place):
    """How far below the clamp the free end is [m], of the fabric at a place of the space."""
    fabric = eqx.tree_at(lambda f: f.mass_damping, space(place), jnp.asarray(8.0))  # [1/s]
    return -r2s.simulate(solver, fabric, solver.init(start), control).x[-1, -3:, 2].mean()


def fabric_place(bending):
    return jnp.full(space.dim, 0.5).at[BENDING].set(bending)


@eqx.filter_jit
def improve(bending, state, seen):
    def loss(bending):
        return ((droop(fabric_place(bending)) - seen) * 1e3) ** 2  # [mm^2]

    value, slope = jax.value_and_grad(loss)(bending)
    change, state = optimiser.update(slope, state)
    return optax.apply_updates(bending, change), state, value


optimiser = optax.adam(0.02)
if __name__ == "__main__":
    truth = jnp.asarray(0.62)
    seen = eqx.filter_jit(droop)(fabric_place(truth))  # in earnest: measured
    bending = jnp.asarray(0.5)
    state = optimiser.init(bending)
    for _ in range(40):
        bending, state, value = improve(bending, state, seen)

    def stiffness(place):
        return float(space(fabric_place(place)).bending.stiffness)

    print(f"droop {1e3 * seen:.2f} mm, off by {value**0.5:.3f} mm")
    print(f"bending stiffness {stiffness(bending):.3g} N m, truth {stiffness(truth):.3g} N m")
