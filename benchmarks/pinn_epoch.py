"""One epoch of the physics-informed network's published recipe: r2s beside PyTorch.

python benchmarks/pinn_epoch.py --torch /path/to/python   # of an environment with PyTorch

Seconds of one epoch, CPU seconds of all threads and wall seconds: forward jets and nested reverse
passes in JAX, the published recipe, and nested reverse passes in PyTorch.
"""

import argparse
import json
import statistics
import subprocess
import time

FRAMES, MARKERS, WIDTH, LAYERS = 39, 81, 50, 7
DENSITY, SIDE, PULLED, DURATION = 0.3, 0.45, 0.018, 1.267  # [kg/m^2, m, m, s]
STIFFNESS = 10.0  # [N/m]
REPEATS, TOGETHER = 5, 50  # calls, and epochs in a call


def timed(call) -> dict[str, float]:
    """Medians of CPU and wall seconds of a call, with the least and the most."""
    call()
    rows = []
    for _ in range(REPEATS):
        cpu, wall = time.process_time(), time.perf_counter()
        call()
        rows.append((time.process_time() - cpu, time.perf_counter() - wall))
    cpu, wall = zip(*rows, strict=True)
    return {
        "cpu_s": statistics.median(cpu),
        "wall_s": statistics.median(wall),
        "wall_s_min": min(wall),
        "wall_s_max": max(wall),
    }


def torch_epoch() -> dict[str, float]:
    """One epoch of Adam on markers and equation of motion, by nested reverse passes in PyTorch."""
    import torch  # pyright: ignore[reportMissingImports]

    torch.manual_seed(0)
    sizes = [3] + [WIDTH] * (LAYERS - 1) + [2]
    parts = []
    for inner, outer in zip(sizes, sizes[1:], strict=False):
        parts += [torch.nn.Linear(inner, outer), torch.nn.Tanh()]
    network = torch.nn.Sequential(*parts[:-1])
    stiffness = torch.nn.Parameter(torch.full((4,), STIFFNESS))
    optimiser = torch.optim.Adam([*network.parameters(), stiffness], lr=1e-4)
    high = torch.tensor([SIDE, SIDE, DURATION])
    points = torch.rand(FRAMES * MARKERS, 3) * high
    data = torch.rand(FRAMES * MARKERS, 2) * PULLED

    def slope(values, inputs):
        return torch.autograd.grad(values.sum(), inputs, create_graph=True)[0]

    def epoch():
        inputs = points.clone().requires_grad_(True)
        moved = PULLED / 2 * network(2 * inputs / high - 1)
        c11, c12, c22, c33 = stiffness
        first = [slope(moved[:, i], inputs) for i in range(2)]
        shear = first[0][:, 1] + first[1][:, 0]
        s11 = c11 * first[0][:, 0] + c12 * first[1][:, 1]
        s22 = c12 * first[0][:, 0] + c22 * first[1][:, 1]
        by11, by22, by12 = (slope(s, inputs) for s in (s11, s22, c33 * shear))
        speed = [slope(first[i][:, 2], inputs)[:, 2] for i in range(2)]
        motion_x = by11[:, 0] + by12[:, 1] - DENSITY * speed[0]
        motion_y = by12[:, 0] + by22[:, 1] - DENSITY * speed[1]
        motion = (motion_x**2 + motion_y**2).mean() / 2
        loss = ((moved - data) ** 2).mean() + 0.1 * motion
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        return loss.item()

    return timed(epoch) | {"threads": torch.get_num_threads()}


def _problem():
    """A pull of the same size as PyTorch's, a space and the paper's model."""
    import jax
    import jax.numpy as jnp
    import jax.random as jr

    from r2s.estimation.pinn.published_recipe import begin
    from r2s.estimation.pinn.pulls import Clamp, Pull, stacked
    from r2s.fabrics.parameters import OrthotropicSpace

    def array(value):
        return jnp.asarray(value, float)

    keys = jr.split(jr.key(0), 3)
    zero = jnp.zeros((FRAMES, 2), float)
    clamp = Clamp(zero, zero, zero)
    pull = Pull(
        size=array((SIDE, SIDE)),
        angle=array(0.0),
        places=SIDE * jr.uniform(keys[0], (MARKERS, 2), float),
        displacement=PULLED * jr.uniform(keys[1], (FRAMES, MARKERS, 2), float),
        seen=jnp.ones((FRAMES, MARKERS), bool),
        times=jnp.linspace(0, DURATION, FRAMES),
        near=clamp,
        far=clamp,
        force=None,
        gravity=jnp.zeros(2),
        normal=array(0.0),
    )
    space = OrthotropicSpace.make(DENSITY)
    pulls = stacked([pull])
    model = begin(space, pulls, jnp.full(space.dim, 0.4), key=keys[2])
    return jax, jnp, space, pulls, model


def epochs(torch_python: str | None) -> list[dict]:
    """Rows of an epoch: forward jets, nested reverse passes in JAX, and in PyTorch."""
    jax, jnp, space, pulls, model = _problem()
    import equinox as eqx
    import optax

    from r2s.estimation.pinn import published_recipe
    from r2s.estimation.pinn.training import trainable

    weights, fixed = eqx.partition(model, trainable(model))
    optimiser = optax.adam(1e-4)

    def epochs_of(losses_of):
        """A function that makes `TOGETHER` epochs of Adam in one call, as a training does."""

        @jax.jit
        def run(weights, state, pulls):
            def loss(weights):
                data, motion = losses_of(eqx.combine(weights, fixed), space, pulls)
                return data + 0.1 * motion

            def epoch(carried, _):
                weights, state = carried
                change, state = optimiser.update(jax.grad(loss)(weights), state)
                return (eqx.apply_updates(weights, change), state), None

            return jax.lax.scan(epoch, (weights, state), None, TOGETHER)[0]

        state = optimiser.init(weights)
        return lambda: jax.block_until_ready(run(weights, state, pulls))

    def each(call):
        return {name: s / TOGETHER for name, s in timed(call).items()}

    rows = [{"epoch": "forward jets", **each(epochs_of(published_recipe.losses))}]

    def nested(model, space, pulls):
        return _nested_losses(jax, jnp, model, space, pulls)

    rows.append({"epoch": "nested reverse, JAX", **each(epochs_of(nested))})
    state = published_recipe.untouched(model)

    def of_the_paper():
        nonlocal model, state
        model, state, values = published_recipe.run(
            model, state, space, pulls, jnp.asarray(0), TOGETHER
        )
        jax.block_until_ready(values)

    of_the_paper()
    rows.append({"epoch": "the paper's recipe (Adam and L-BFGS)", **each(of_the_paper)})
    if torch_python:
        out = subprocess.run([torch_python, __file__, "torch"], stdout=subprocess.PIPE, check=True)
        rows.append({"epoch": "nested reverse, PyTorch", **json.loads(out.stdout)})
    return rows


def _nested_losses(jax, jnp, model, space, pulls):
    """The losses of the published recipe, with every derivative by a reverse pass."""
    fabric, pull = space(model.place), jax.tree.map(lambda leaf: leaf[0], pulls)
    network = jax.tree.map(lambda leaf: leaf[0], model.networks)
    law = fabric.membrane
    number, markers, _ = pull.displacement.shape
    times = jnp.repeat(pull.times, markers)[:, None]
    points = jnp.concatenate([jnp.tile(pull.places, (number, 1)), times], axis=1)

    def displacement(point):
        return network(point[None])[0]

    def stresses(point):
        (xx, xy, _), (yx, yy, _) = jax.jacrev(displacement)(point)
        shear = law.c33 * (xy + yx)
        return jnp.stack([law.c11 * xx + law.c12 * yy, law.c12 * xx + law.c22 * yy, shear])

    def residual(point):
        by = jax.jacrev(stresses)(point)

        def speed(point):
            return jax.jacrev(displacement)(point)[:, 2]

        force = jnp.stack([by[0, 0] + by[2, 1], by[2, 0] + by[1, 1]])
        return force - fabric.density * jax.jacrev(speed)(point)[:, 2]

    off = jax.vmap(displacement)(points) - pull.displacement.reshape(-1, 2)
    return jnp.mean(off**2), jnp.mean(jax.vmap(residual)(points) ** 2)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Time of an epoch.")
    parser.add_argument("what", nargs="?", default="epochs", choices=("epochs", "torch"))
    parser.add_argument("--torch", help="python of an environment with PyTorch")
    a = parser.parse_args()
    if a.what == "torch":  # in that environment, which has no JAX
        print(json.dumps(torch_epoch()))
    else:
        from measure import show

        columns = {"epoch": lambda row: row["epoch"]}
        for key in ("cpu_s", "wall_s"):
            columns[key] = lambda row, key=key: f"{row[key]:.4f}"
        show("an epoch", epochs(a.torch), columns)
