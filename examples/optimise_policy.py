"""Where should a gripper go, so that the free corner of a cloth ends where it is wanted?

    python examples/optimise_policy.py

The path is a few knots, which optax moves down the exact gradient of the motion.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

import r2s
from r2s.materials import presets

STEPS, KNOTS, ITERATIONS = 24, 4, 40
TARGET = jnp.array([0.12, 0.15, 0.001])  # [m]
sheet = r2s.rectangle((0.2, 0.2), (5, 5))  # [m]
scene = r2s.Scene(sheet, pinned=[0], table=0.0)
solver = r2s.ImplicitCloth(scene, dt=0.025)  # [s]
start = jnp.pad(sheet.rest, ((0, 0), (0, 1)), constant_values=0.001)


def final(knots):
    """Positions [m] after the pinned corner went along knots (knot, 3) [m], linear between them."""
    times = jnp.arange(1, STEPS + 1) / STEPS
    at = jnp.linspace(0, 1, KNOTS + 1)
    way = jnp.concatenate([start[:1], start[:1] + knots])
    path = jax.vmap(lambda axis: jnp.interp(times, at, axis), in_axes=1, out_axes=1)(way)
    control = r2s.Control(path[:, None])
    return r2s.simulate(solver, presets.black_denim(), solver.init(start), control).final_state.x


def loss(knots):
    """Squared distance [m^2] of the opposite corner from the target."""
    return jnp.sum((final(knots)[-1] - TARGET) ** 2)


@eqx.filter_jit
def improve(knots, state):
    value, slope = jax.value_and_grad(loss)(knots)
    change, state = optimiser.update(slope, state)
    return optax.apply_updates(knots, change), state, value


optimiser = optax.adam(optax.cosine_decay_schedule(0.01, ITERATIONS))
if __name__ == "__main__":
    knots = jnp.linspace(0, 1, KNOTS + 1)[1:, None] * jnp.array([0.0, 0.0, 0.05])
    state = optimiser.init(knots)
    for i in range(ITERATIONS):
        knots, state, value = improve(knots, state)
        if i % 5 == 0 or i == ITERATIONS - 1:
            print(f"{i:3d}  the corner is {1e3 * value**0.5:6.1f} mm from where it should be")
