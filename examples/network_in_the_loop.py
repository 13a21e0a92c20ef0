"""A neural network that holds a cloth's corner, trained through the cloth.

    python examples/network_in_the_loop.py

In every step it sees the free corner's place and velocity and chooses the gripper's velocity. It
learns to keep the free corner still in the air while the sheet falls and swings.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import optax

import r2s
from r2s.materials import presets

STEPS, FASTEST = 20, 0.5  # [m/s]
sheet = r2s.rectangle((0.2, 0.2), (4, 4))  # [m]
scene = r2s.Scene(sheet, [0])
solver = r2s.ImplicitCloth(scene, dt=0.02)  # [s]
start = sheet.lay_flat()
GOAL = start[-1]


def loss(network):
    """Mean squared distance [m^2] of the free corner from where it began."""

    def step(carry, _):
        state, gripper = carry
        seen = jnp.concatenate([state.x[-1] - GOAL, state.v[-1], gripper - start[0]])
        gripper = gripper + solver.dt * FASTEST * jnp.tanh(network(seen))
        control = r2s.Control(gripper[None])
        state = solver.step(presets.camel_ponte_roma(), state, control)
        return (state, gripper), jnp.sum((state.x[-1] - GOAL) ** 2)

    (_, _), squares = jax.lax.scan(step, (solver.init(start), start[0]), None, STEPS)
    return jnp.mean(squares)


@eqx.filter_jit
def train(network, state):
    value, slope = eqx.filter_value_and_grad(loss)(network)
    change, state = optimiser.update(slope, state)
    return eqx.apply_updates(network, change), state, value


optimiser = optax.adam(1e-2)
if __name__ == "__main__":
    network = eqx.nn.MLP(9, 3, width_size=32, depth=2, activation=jnp.tanh, key=jr.key(0))
    state = optimiser.init(eqx.filter(network, eqx.is_array))
    for i in range(60):
        network, state, value = train(network, state)
        if i % 10 == 0 or i == 59:
            print(f"{i:3d}  the corner is {1e3 * value**0.5:6.1f} mm off (rms)")
