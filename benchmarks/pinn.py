"""The physics-informed network: an epoch beside PyTorch, and the paper's recipe beside ours.

python benchmarks/pinn.py epochs --torch /path/to/python   # of an environment with PyTorch
python benchmarks/pinn.py fabrics                          # ours on the five fabrics
python benchmarks/pinn.py recipes --pulls 1 --seeds 5      # the paper's recipe beside ours
python benchmarks/pinn.py clouds                           # from a lift and a wind, no markers

Times are CPU seconds of all threads, and wall seconds. Tables and a picture go to --out; what is in
a table there is not measured again.
"""

import argparse
import csv
import io
import json
import statistics
import subprocess
import time
from pathlib import Path

FRAMES, MARKERS, WIDTH, LAYERS = 39, 81, 50, 7
DENSITY, SIDE, PULLED, DURATION = 0.3, 0.45, 0.018, 1.267  # [kg/m^2, m, m, s]
STIFFNESS = 10.0  # [N/m]
REPEATS, TOGETHER = 5, 50  # calls, and epochs in a call
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
    """A pull of the same size as PyTorch's, a space and the paper's model."""
    import jax
    import jax.numpy as jnp
    import jax.random as jr

    from r2s.estimation.pinn.published_recipe import begin
    from r2s.estimation.pinn.pulls import Clamp, Pull, stacked
    from r2s.fabrics.parameters import OrthotropicSpace

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

    each = lambda call: {name: s / TOGETHER for name, s in timed(call).items()}
    rows = [{"epoch": "forward jets", **each(epochs_of(published_recipe.losses))}]
    nested = lambda model, space, pulls: _nested_losses(jax, jnp, model, space, pulls)
    rows.append({"epoch": "nested reverse, JAX", **each(epochs_of(nested))})
    state = published_recipe.untouched(model)

    def of_the_paper():
        nonlocal model, state
        about = model, state, space, pulls, jnp.asarray(0), TOGETHER
        model, state, values = published_recipe.run(*about)
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


def resumed(out: Path, name: str, jobs: list[dict], make) -> list[dict]:
    """A row for each job, with what `make` gives of it; those that are in the file are kept."""
    from measure import progress

    from r2s.files import write_text

    path = out / f"{name}.csv"
    rows = list(csv.DictReader(io.StringIO(path.read_text()))) if path.exists() else []
    done = [{key: row.get(key) for key in jobs[0]} for row in rows]
    for job in jobs:
        if {key: str(value) for key, value in job.items()} in done:
            continue
        cpu, wall = time.process_time(), time.perf_counter()
        found = make(**job)
        seconds = {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
        rows.append({key: str(value) for key, value in (job | found | seconds).items()})
        text = io.StringIO()
        writer = csv.DictWriter(text, list(dict.fromkeys(key for row in rows for key in row)))
        writer.writeheader()
        writer.writerows(rows)
        write_text(path, text.getvalue())
        progress(", ".join(f"{key} {value}" for key, value in rows[-1].items()))
    return rows


def _number(row: dict, key: str, form: str = ".4f") -> str:
    return format(float(row[key]), form) if row.get(key) else "-"


def _show(title: str, rows: list[dict], names: list[str], keys: list[str]) -> None:
    from measure import show  # not at the top: PyTorch's environment has no JAX

    columns: dict = {key: (lambda row, key=key: str(row[key])) for key in keys}
    for name in names:
        columns[name] = lambda row, name=name: (
            f"{_number(row, 'error ' + name)} ({_number(row, 'deviation ' + name)})"
        )
    columns["CPU s"] = lambda row: _number(row, "cpu_s", ".0f")
    show(title, rows, columns)


def _fabric(name: str):
    from r2s.fabrics import presets
    from r2s.fabrics.parameters import OrthotropicSpace

    fabric = presets.FIVE[name]()
    return fabric, OrthotropicSpace.make(float(fabric.density))


def _pulls(name: str, seed: int, count: int = 3) -> list:
    """Of a fabric along warp, weft and bias, or the first ones of these."""
    import jax.random as jr
    import numpy as np

    from r2s.estimation.pinn.pulls import pull_from
    from r2s.estimation.pinn.synthetic_pulls import pulled

    fabric, _ = _fabric(name)
    some = []
    for i, angle in enumerate((0.0, np.pi / 2, np.pi / 4)[:count]):
        key = jr.fold_in(jr.key(seed), i)
        recording = pulled(fabric, name, angle, shape=SHAPE, key=key)
        some.append(pull_from(recording, angle))
    return some


def _errors(space, truth, values, standard_errors=None) -> dict[str, float]:
    """Of every parameter: relative where its range is logarithmic, else absolute."""
    row = {}
    for i, bound in enumerate(space.ranges):
        ratio = float(values[i]) / float(truth[i]) - 1 if bound.log else 0.0
        row[f"error {bound.name}"] = ratio if bound.log else float(values[i] - truth[i])
        if standard_errors is not None:
            row[f"deviation {bound.name}"] = float(standard_errors[i])
    return row


STIFFNESSES = ["warp", "weft", "shear", "coupling"]


def fabrics(out: Path, seeds: int) -> None:
    """The five fabrics, each pulled along warp, weft and bias, with other noise."""
    import jax.random as jr
    import numpy as np
    from measure import show

    from r2s.estimation.pinn.from_pulls import estimate
    from r2s.fabrics import presets

    def make(fabric: str, seed: int) -> dict:
        some = _pulls(fabric, seed)
        about, space = _fabric(fabric)
        truth = space.values(space.locate(about))
        found = estimate(some, space, key=jr.key(seed)).estimate
        return _errors(space, truth, found.values, found.standard_errors)

    jobs = [{"fabric": name, "seed": seed} for seed in range(seeds) for name in presets.FIVE]
    rows = resumed(out, "fabrics", jobs, make)
    _show("errors (deviations)", rows, STIFFNESSES, ["fabric", "seed"])
    known = [*STIFFNESSES, "damping", "friction"]
    ratio = lambda row, of: float(row[f"error {of}"]) / float(row[f"deviation {of}"])
    rms = lambda of: float(np.sqrt(np.mean([ratio(row, of) ** 2 for row in rows])))
    spread = [{"of": of, "rms": rms(of)} for of in known]
    columns = {"parameter": lambda row: row["of"], "rms": lambda row: f"{row['rms']:.2f}"}
    show("errors over deviations", spread, columns)
    _picture(out / "fabrics.png", rows)


def _picture(path: Path, rows: list[dict]) -> None:
    """Errors with two deviations, of every fabric and seed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = list(dict.fromkeys(row["fabric"] for row in rows))
    figure, axes = plt.subplots(1, 4, figsize=(13, 3.6), layout="constrained")
    for ax, name in zip(axes, STIFFNESSES, strict=True):
        for row in rows:
            at = names.index(row["fabric"]) + 0.12 * (int(row["seed"]) % 5 - 2)
            error, deviation = (float(row[f"{kind} {name}"]) for kind in ("error", "deviation"))
            size = 1 if name == "coupling" else 100
            ax.errorbar(at, size * error, 2 * size * deviation, fmt="o", ms=3, color="C0", lw=1)
        ax.axhline(0, color="0.5", lw=0.8)
        ax.set_xticks(range(len(names)), [n.replace("_", "\n") for n in names], fontsize=7)
        ax.set_ylabel("error [-]" if name == "coupling" else "error [%]")
        ax.set_title(name)
    figure.suptitle("estimate from three pulls, with two standard deviations")
    figure.savefig(path, dpi=150)
    plt.close(figure)


def recipes(out: Path, name: str, count: int, seeds: int, number: int, alone: bool) -> None:
    """The recipes on the same pulls: the paper's, ours, and long trainings of networks alone."""
    import equinox as eqx
    import jax.random as jr

    from r2s.estimation.pinn import published_recipe
    from r2s.estimation.pinn.from_pulls import estimate
    from r2s.estimation.pinn.losses import strong_losses
    from r2s.estimation.pinn.pulls import stacked
    from r2s.estimation.pinn.training import Recipe
    from r2s.estimation.pinn.weak_form import weak_losses
    from r2s.fabrics.fabric import Fabric

    some, (fabric, space) = _pulls(name, 0, count), _fabric(name)
    truth = space.values(space.locate(fabric))
    place = space.locate(Fabric.make(float(fabric.density), (10.0, 0.0, 10.0, 10.0), 1e-5))

    def make(fabric: str, pulls: int, recipe: str, seed: int) -> dict:
        del fabric, pulls
        key = jr.key(seed)
        eqx.clear_caches()
        if recipe.startswith("the paper's"):
            course = published_recipe.train(space, stacked(some), place, number, key=key)
            return _errors(space, truth, space.values(course.model.place))
        if recipe == "ours":
            found = estimate(some, space, key=key).estimate
            return _errors(space, truth, found.values, found.standard_errors)
        losses = weak_losses if recipe.endswith("weak") else strong_losses
        found = estimate(some, space, Recipe(losses=losses, lbfgs=100), key=key).network
        return _errors(space, truth, found.values)

    names = [f"the paper's, {number} epochs", "ours"]
    names += ["network alone, weak", "network alone, strong"] if alone else []
    about = {"fabric": name, "pulls": count}
    jobs = [about | {"recipe": r, "seed": s} for s in range(seeds) for r in names]
    rows = resumed(out, "recipes", jobs, make)
    _show("errors (deviations)", rows, STIFFNESSES, ["fabric", "pulls", "recipe", "seed"])


def clouds(out: Path, seeds: int) -> None:
    """The five fabrics, from clouds of a lift and of a wind without markers."""
    import jax.random as jr

    from r2s import scenarios
    from r2s.estimation.pinn.from_clouds import estimate
    from r2s.fabrics import presets
    from r2s.scenarios import synthetic

    def make(scenario: str, fabric: str, seed: int) -> dict:
        about, space = _fabric(fabric)
        key_seen, key = jr.split(jr.key(seed))
        experiment = scenarios.SIX[scenario]()
        recording = synthetic.record(experiment, about, fabric, shape=(17, 17), key=key_seen)
        found = estimate(recording, space, key=key)
        truth = space.values(space.locate(about))
        return _errors(space, truth, found.values, found.standard_errors)

    jobs = [
        {"scenario": scenario, "fabric": name, "seed": seed}
        for seed in range(seeds)
        for scenario in ("wind", "lifting")
        for name in presets.FIVE
    ]
    rows = resumed(out, "clouds", jobs, make)
    _show("errors (deviations)", rows, [*STIFFNESSES, "bending"], ["scenario", "fabric", "seed"])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("epochs", "fabrics", "recipes", "clouds", "torch"))
    parser.add_argument("--torch", help="python of an environment with PyTorch")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--epochs", type=int, default=10_000, help="of the paper's recipe")
    parser.add_argument("--fabric", default="pink_solid")
    parser.add_argument(
        "--pulls", type=int, default=3, choices=(1, 2, 3), help="along warp, weft, bias"
    )
    parser.add_argument("--alone", action="store_true", help="long trainings of networks alone too")
    parser.add_argument("--out", type=Path, default=Path("results/pinn"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.what == "torch":
        print(json.dumps(torch_epoch()))
    elif options.what == "epochs":
        from measure import show

        rows = epochs(options.torch)
        columns = {"epoch": lambda row: row["epoch"]}
        for key in ("cpu_s", "wall_s"):
            columns[key] = lambda row, key=key: f"{row[key]:.4f}"
        show("an epoch", rows, columns)
    elif options.what == "fabrics":
        fabrics(options.out, options.seeds)
    elif options.what == "clouds":
        clouds(options.out, options.seeds)
    else:
        about = options.fabric, options.pulls, options.seeds, options.epochs, options.alone
        recipes(options.out, *about)


if __name__ == "__main__":
    main()
