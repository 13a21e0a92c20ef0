"""The physics-informed network: an epoch beside PyTorch, and the paper's recipe beside ours.

python benchmarks/pinn.py epochs --torch /path/to/python   # of an environment with PyTorch
python benchmarks/pinn.py fabrics                          # ours on the five fabrics
python benchmarks/pinn.py recipes --seeds 5 --epochs 1000  # the paper's recipe beside ours

Times are CPU seconds of all threads, and wall seconds.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time

FRAMES, MARKERS, WIDTH, LAYERS = 39, 81, 50, 7
DENSITY, SIDE, PULLED, DURATION = 0.3, 0.45, 0.018, 1.267  # [kg/m^2, m, m, s]
STIFFNESS = 10.0  # [N/m]
REPEATS, TOGETHER = 5, 10  # calls, and epochs in a call
SHAPE = (33, 33)  # vertices of the sheets that are pulled


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
    """A pull of the same size as PyTorch's, a family and the paper's model."""
    import jax
    import jax.numpy as jnp
    import jax.random as jr

    from r2s.family import OrthotropicFamily
    from r2s.pinn.data import Clamp, Pull, stacked
    from r2s.pinn.paper import begin

    array = lambda value: jnp.asarray(value, float)
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
    family = OrthotropicFamily.make(DENSITY)
    pulls = stacked([pull])
    model = begin(family, pulls, jnp.full(family.dim, 0.4), key=keys[2])
    return jax, jnp, family, pulls, model


def epochs(torch_python: str | None) -> list[dict]:
    """Rows of an epoch: forward jets, nested reverse passes in JAX, and in PyTorch."""
    jax, jnp, family, pulls, model = _problem()
    import equinox as eqx
    import optax

    from r2s.pinn import paper
    from r2s.pinn.training import trainable

    weights, fixed = eqx.partition(model, trainable(model))
    optimiser = optax.adam(1e-4)

    def epochs_of(losses_of):
        """A function that makes `TOGETHER` epochs of Adam in one call, as a training does."""

        @jax.jit
        def run(weights, state, pulls):
            def loss(weights):
                data, motion = losses_of(eqx.combine(weights, fixed), family, pulls)
                return data + 0.1 * motion

            def epoch(carried, _):
                weights, state = carried
                change, state = optimiser.update(jax.grad(loss)(weights), state)
                return (eqx.apply_updates(weights, change), state), None

            return jax.lax.scan(epoch, (weights, state), None, TOGETHER)[0]

        state = optimiser.init(weights)
        return lambda: jax.block_until_ready(run(weights, state, pulls))

    each = lambda call: {name: s / TOGETHER for name, s in timed(call).items()}
    rows = [{"epoch": "forward jets", **each(epochs_of(paper.losses))}]
    nested = lambda model, family, pulls: _nested_losses(jax, jnp, model, family, pulls)
    rows.append({"epoch": "nested reverse, JAX", **each(epochs_of(nested))})
    states = None

    def of_the_paper():
        nonlocal model, states
        about = model, states, family, pulls, jnp.asarray(0), TOGETHER
        model, states, values = paper.run(*about)
        jax.block_until_ready(values)

    of_the_paper()
    rows.append({"epoch": "the paper's recipe (Adam and L-BFGS)", **each(of_the_paper)})
    if torch_python:
        out = subprocess.run([torch_python, __file__, "torch"], stdout=subprocess.PIPE, check=True)
        rows.append({"epoch": "nested reverse, PyTorch", **json.loads(out.stdout)})
    return rows


def _nested_losses(jax, jnp, model, family, pulls):
    """The losses of `r2s.pinn.paper`, with every derivative by a reverse pass."""
    fabric, pull = family(model.place), jax.tree.map(lambda leaf: leaf[0], pulls)
    network = jax.tree.map(lambda leaf: leaf[0], model.networks)
    law = fabric.membrane
    number, markers, _ = pull.displacement.shape
    times = jnp.repeat(pull.times, markers)[:, None]
    points = jnp.concatenate([jnp.tile(pull.places, (number, 1)), times], axis=1)
    displacement = lambda point: network(point[None])[0]

    def stresses(point):
        (xx, xy, _), (yx, yy, _) = jax.jacrev(displacement)(point)
        shear = law.c33 * (xy + yx)
        return jnp.stack([law.c11 * xx + law.c12 * yy, law.c12 * xx + law.c22 * yy, shear])

    def residual(point):
        by = jax.jacrev(stresses)(point)
        speed = lambda point: jax.jacrev(displacement)(point)[:, 2]
        force = jnp.stack([by[0, 0] + by[2, 1], by[2, 0] + by[1, 1]])
        return force - fabric.density * jax.jacrev(speed)(point)[:, 2]

    off = jax.vmap(displacement)(points) - pull.displacement.reshape(-1, 2)
    return jnp.mean(off**2), jnp.mean(jax.vmap(residual)(points) ** 2)


def _pulls(name: str, seed: int):
    import jax.random as jr
    import numpy as np

    from r2s import presets
    from r2s.pinn.data import pull_from
    from r2s.pinn.synthetic import pulled

    fabric = presets.FIVE[name]()
    some = []
    for i, angle in enumerate((0.0, np.pi / 2, np.pi / 4)):
        key = jr.fold_in(jr.key(seed), i)
        recording = pulled(fabric, name, angle, shape=SHAPE, key=key)
        some.append(pull_from(recording, angle))
    return fabric, some


def _errors(family, fabric, values):
    """Of warp, weft, shear relative, of coupling absolute."""
    import numpy as np

    truth = np.asarray(family.values(family.locate(fabric)))
    return [float(v / t - 1) for v, t in zip(values[:3], truth[:3], strict=True)] + [
        float(values[3] - truth[3])
    ]


def fabrics(seeds: int) -> list[dict]:
    """Rows of the five fabrics, each pulled along warp, weft and bias."""
    import jax.random as jr

    from r2s import presets
    from r2s.estimators.pinn import estimate
    from r2s.family import OrthotropicFamily

    rows = []
    for seed in range(seeds):
        for name in presets.FIVE:
            fabric, some = _pulls(name, seed)
            family = OrthotropicFamily.make(float(fabric.density))
            cpu, wall = time.process_time(), time.perf_counter()
            found = estimate(some, family, key=jr.key(seed)).estimate
            seconds = time.process_time() - cpu, time.perf_counter() - wall
            rows.append(
                {
                    "fabric": name,
                    "seed": seed,
                    "cpu_s": seconds[0],
                    "wall_s": seconds[1],
                    "errors": _errors(family, fabric, found.values),
                    "deviations": found.deviations[:4].tolist(),
                    "determined": found.determined[:4].tolist(),
                }
            )
            print(json.dumps(rows[-1]), flush=True)
    return rows


def recipes(name: str, seeds: int, number: int, alone: bool) -> list[dict]:
    """Rows of the recipes on the same data: the paper's, our networks alone, and the estimate."""
    import equinox as eqx
    import jax.random as jr

    from r2s.estimators.pinn import estimate
    from r2s.fabric import Fabric
    from r2s.family import OrthotropicFamily
    from r2s.pinn import paper
    from r2s.pinn.data import stacked
    from r2s.pinn.losses import strong_losses
    from r2s.pinn.training import Recipe
    from r2s.pinn.weak import weak_losses

    fabric, some = _pulls(name, 0)
    family = OrthotropicFamily.make(float(fabric.density))
    ten = Fabric.make(float(fabric.density), (10.0, 0.0, 10.0, 10.0), 1e-5)
    place = family.locate(ten)
    rows = []

    def note(recipe, seed, began, values):
        cpu, wall = time.process_time() - began[0], time.perf_counter() - began[1]
        errors = _errors(family, fabric, values)
        rows.append(
            {"recipe": recipe, "seed": seed, "cpu_s": cpu, "wall_s": wall, "errors": errors}
        )
        print(json.dumps(rows[-1]), flush=True)

    clock = lambda: (time.process_time(), time.perf_counter())
    for seed in range(seeds):
        key, began = jr.key(seed), clock()
        course = paper.train(family, stacked(some), place, number, key=key)
        note(f"the paper's, {number} epochs", seed, began, family.values(course.model.place))
        began = clock()
        note("ours", seed, began, estimate(some, family, key=key).estimate.values)
        for form in (weak_losses, strong_losses) if alone else ():
            began, recipe = clock(), Recipe(losses=form, lbfgs=100)
            found = estimate(some, family, recipe, key=key)
            note(f"network alone, {form.__name__}", seed, began, found.network.values)
        eqx.clear_caches()
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("epochs", "fabrics", "recipes", "torch"))
    parser.add_argument("--torch", help="python of an environment with PyTorch")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--epochs", type=int, default=10_000, help="of the paper's recipe")
    parser.add_argument("--fabric", default="pink_solid")
    parser.add_argument("--alone", action="store_true", help="long trainings of networks alone too")
    options = parser.parse_args()
    if options.what == "torch":
        print(json.dumps(torch_epoch()))
    elif options.what == "epochs":
        for row in epochs(options.torch):
            print(json.dumps(row))
    elif options.what == "fabrics":
        fabrics(options.seeds)
    else:
        recipes(options.fabric, options.seeds, options.epochs, options.alone)
    sys.stdout.flush()


if __name__ == "__main__":
    main()
