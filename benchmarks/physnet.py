"""PhysNet from data to estimates: accuracy of triplets, errors beside random search, times.

    python benchmarks/physnet.py --out results/physnet
    python benchmarks/physnet.py --out results/physnet_small --small

Goes on where it was interrupted: data, network and searches that lie in the folder are read. The
small one, of few fabrics, shows that all of it runs; its figures say nothing of the method. Writes
figures.json, curves.png, map.png and images.png.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from scipy.stats import spearmanr

from r2s import synthetic
from r2s.estimators import physnet
from r2s.estimators.physnet import Sighting
from r2s.files import write_json
from r2s.observe.calibration import calibrated
from r2s.observe.flaws import TYPICAL, flawed_depth, flawed_mask
from r2s.observe.render import render
from r2s.physnet import dataset, pictures, preprocess, training
from r2s.physnet.network import DEEPER, PAPER
from r2s.scenario import motion

SEEDS = 20  # of random search, which is free: the motions are those of the training data
SMALL = {"fabrics": 32, "epochs": 2, "steps": 20, "estimates": 1, "repeats": 1, "calls": 20}
SEEN = preprocess.Flaws(noise=1.5e-3, holes=0.05, strays=0.001)  # of the images to estimate from


def main() -> None:
    asked = arguments()
    out = Path(asked.out)
    out.mkdir(parents=True, exist_ok=True)
    settings = dataset.Settings(asked.scenario, asked.fabrics, seed=asked.seed)
    paper = dataclasses.replace(PAPER, size=settings.size)
    architecture = paper if asked.paper else DEEPER
    schedule = training.Schedule(epochs=asked.epochs, steps=asked.steps, seed=asked.seed)
    figures = load(out / "figures.json")
    figures["data"] = figures.get("data", {}) | make_data(out / "data", settings)
    data, view = dataset.load(out / "data"), dataset.load_manifest(out / "data").view
    trained, found = teach(out / "training.eqx", data, view, architecture, schedule)
    figures["training"] = figures.get("training", {}) | found
    write_json(out / "figures.json", figures)
    figures["map"] = draw(out, data, settings, trained)
    write_json(out / "figures.json", figures)
    figures["estimates"] = estimates(out, data, settings, trained, asked)
    write_json(out / "figures.json", figures)
    figures["end to end"] = end_to_end(out, data, settings, trained, asked)
    write_json(out / "figures.json", figures)
    print(json.dumps(figures, indent=2))


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", default="results/physnet")
    parser.add_argument("--scenario", default="lifting")
    parser.add_argument("--fabrics", type=int, default=dataset.Settings.num_fabrics)
    parser.add_argument("--epochs", type=int, default=training.Schedule.epochs)
    parser.add_argument("--steps", type=int, default=training.Schedule.steps)
    parser.add_argument("--paper", action="store_true", help="the paper's two convolutions")
    parser.add_argument("--estimates", type=int, default=4, help="fabrics to estimate")
    parser.add_argument("--calls", type=int, default=80)
    parser.add_argument("--repeats", type=int, default=2, help="seeds of each estimate")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--small", action="store_true", help="of all less, in a few minutes")
    asked = parser.parse_args()
    if asked.small:
        vars(asked).update(SMALL)
    return asked


def load(path: Path) -> dict:
    return json.loads(path.read_text()) if path.exists() else {}


def make_data(folder: Path, settings: dataset.Settings) -> dict:
    began, spent = time.perf_counter(), time.process_time()
    before = len(list(folder.glob("*.npz")))
    dataset.make(folder, settings)
    shards = len(list(folder.glob("*.npz"))) - before
    if not shards:
        return {}
    frames = shards * settings.per_shard * settings.num_levels * 60
    wall, cpu = time.perf_counter() - began, time.process_time() - spent
    return {"frames": frames, "seconds": wall, "cpu seconds": cpu, "frames a cpu s": frames / cpu}


def teach(path: Path, data, view, architecture, schedule):
    start = training.begin(view, architecture, schedule)
    _, held_back = training.divide(data, schedule)
    untrained = training.judge(start.network, view, held_back, schedule)[1]
    trained = start
    if path.exists():  # the epochs asked for count, not those of its own schedule
        trained = training.load(path, expected=architecture)
        if dataclasses.replace(trained.schedule, epochs=schedule.epochs) != schedule:
            raise ValueError(f"{path}: was trained by {trained.schedule}, asked for {schedule}")
        trained = trained._replace(schedule=schedule)
    began, spent, done = time.perf_counter(), time.process_time(), len(trained.curve)
    say = lambda number, row: print(number, *(f"{value:.4f}" for value in row), flush=True)
    trained = training.train(trained, data, path, say)
    found = {"chance": 0.5, "untrained": untrained, "accuracy": trained.curve[-1].accuracy}
    if len(trained.curve) > done:
        found["seconds"] = time.perf_counter() - began
        found["cpu seconds"] = time.process_time() - spent
        found["epochs in that"] = len(trained.curve) - done
    pictures.draw_curves(path.parent / "curves.png", trained.curve, untrained)
    return trained, found


def draw(out: Path, data, settings, trained) -> dict:
    """The map of fabrics held back; how distances on it go with distances of parameters."""
    taught, held_back = training.divide(data, trained.schedule)
    points = training.embed(trained.network, trained.view, held_back.depth, None)
    places = data.places[held_back.fabric]
    title = f"{settings.scenario}: fabrics that the network never saw, all motions and frames"
    pictures.draw_map(out / "map.png", points, places, settings.ranges, title)
    _, sequences, own = of_level(data, settings, trained, held_back.fabric)
    one, two = np.triu_indices(len(own), 1)
    apart = np.sqrt(((sequences[one] - sequences[two]) ** 2).sum(axis=2).mean(axis=1))
    difference = np.abs(own[one] - own[two])
    names = [bound.name for bound in settings.ranges]
    correlation = lambda values: float(np.asarray(spearmanr(apart, values))[0])
    found = {name: correlation(column) for name, column in zip(names, difference.T, strict=True)}
    found["all parameters"] = correlation(np.sqrt((difference**2).sum(axis=1)))
    shown = [i for i, name in enumerate(names) if name in determined(settings)]
    found["determined"] = correlation(np.sqrt((difference[:, shown] ** 2).sum(axis=1)))
    accuracy = sequence_accuracy(data, settings, trained, held_back.fabric)
    return {"rank correlation with": found, "triplet accuracy of sequences": accuracy}


def determined(settings) -> tuple[str, ...]:
    """The parameters that the images of a scenario show."""
    lying = ("lifting", "folding")
    return ("warp", "weft", "shear", *(("friction",) if settings.scenario in lying else ()))


def of_level(data, settings, trained, fabrics, level: int = 0):
    """Of some fabrics: which, the points of the frames of one motion, and places."""
    numbers = np.unique(fabrics)
    # motions are in the order of fabrics and levels, those that diverged left out
    rows = [np.flatnonzero(data.fabric == number) for number in numbers]
    numbers = [n for n, row in zip(numbers, rows, strict=True) if len(row) == settings.num_levels]
    rows = [row[level] for row in rows if len(row) == settings.num_levels]
    depth = data.depth[rows]
    points = training.embed(
        trained.network, trained.view, depth.reshape(-1, *depth.shape[2:]), None
    )
    return np.array(numbers), points.reshape(*depth.shape[:2], -1), data.places[numbers]


def sequence_accuracy(data, settings, trained, fabrics) -> float:
    """The share of triplets of motions, compared frame by frame, whose positive is nearer."""
    levels = range(settings.num_levels)
    means = [of_level(data, settings, trained, fabrics, level)[1].mean(axis=1) for level in levels]
    generator, right = np.random.default_rng(0), []
    for _ in range(4000):
        own, other = generator.choice(len(means[0]), 2, replace=False)
        anchor, positive = generator.choice(settings.num_levels, 2, replace=False)
        negative = generator.integers(settings.num_levels)
        near = ((means[anchor][own] - means[positive][own]) ** 2).sum()
        right.append(near < ((means[anchor][own] - means[negative][other]) ** 2).sum())
    return float(np.mean(right))


def sighting_of(settings, trained, images) -> Sighting:
    experiment = dataset.levels(settings)[0]
    frames = dataset.kept_frames(experiment, settings.num_frames)
    scenario = experiment.scenario(settings.shape)
    return Sighting.make(scenario, images, frames, settings.family, trained)


def estimates(out: Path, data, settings, trained, asked) -> dict:
    """Errors of fabrics held back, as shares of the range, beside random search."""
    taught, held_back = training.divide(data, trained.schedule)
    bank, points, places = of_level(data, settings, trained, taught.fabric)
    targets, _, truths = of_level(data, settings, trained, held_back.fabric)
    errors, random, losses, random_losses, seconds = [], [], [], [], []
    spread = []
    for number in range(min(asked.estimates, len(targets))):
        row = np.flatnonzero(data.fabric == targets[number])[0]
        depth = jnp.asarray(data.depth[row] * dataset.STEP, float)
        keys = jr.split(jr.fold_in(jr.key(1), number), len(depth))
        flawed = lambda d, k: preprocess.flawed(d, trained.view, SEEN, k)
        images = preprocess.of_depths(trained.view, np.asarray(jax.vmap(flawed)(depth, keys)))
        sighting = sighting_of(settings, trained, images)
        own = []
        for seed in range(asked.repeats):
            path = out / f"history_{number}_{seed}.npz"
            fresh = not path.exists()
            done = physnet.estimate(sighting, num_calls=asked.calls, seed=seed, path=path)
            place = np.asarray(settings.family.locate(done.fabric))
            own.append(np.abs(place - truths[number]))
            losses.append(done.loss)
            if fresh:
                seconds.append(done.seconds)
        errors.extend(own)
        spread.append(np.std(own, axis=0))
        apart = np.sqrt(((points - np.asarray(sighting.points)) ** 2).sum(axis=2).mean(axis=1))
        for seed in range(SEEDS):
            tried = np.random.default_rng([seed, number]).permutation(len(apart))[: asked.calls]
            best = tried[np.argmin(apart[tried])]
            random.append(np.abs(places[best] - truths[number]))
            random_losses.append(apart[best])
        print(number, np.round(own, 3), np.round(np.median(random[-SEEDS:], 0), 3), flush=True)
    names = [bound.name for bound in settings.ranges]
    named = lambda values: dict(zip(names, np.round(values, 4).tolist(), strict=True))
    return {
        "fabrics": len(spread),
        "seeds": asked.repeats,
        "calls": asked.calls,
        "median error": named(np.median(errors, axis=0)),
        "of random search": named(np.median(random, axis=0)),
        "of the middle": named(np.median(np.abs(truths[: len(spread)] - 0.5), axis=0)),
        "deviation over seeds": named(np.mean(spread, axis=0)) if asked.repeats > 1 else {},
        "median loss": [float(np.median(losses)), float(np.median(random_losses))],
        "seconds": [float(np.median(seconds)), float(np.max(seconds))] if seconds else [],
    }


def end_to_end(out: Path, data, settings, trained, asked) -> dict:
    """One fabric held back, seen by a depth camera with flaws, and as clouds of two cameras."""
    _, held_back = training.divide(data, trained.schedule)
    targets, _, truths = of_level(data, settings, trained, held_back.fabric)
    truth, fabric = truths[0], settings.family(jnp.asarray(truths[0], float))
    experiment = dataset.levels(settings)[0]
    frames = dataset.kept_frames(experiment, settings.num_frames)
    x = np.asarray(eqx.filter_jit(motion)(experiment.scenario(settings.shape), fabric).x)
    camera = calibrated(synthetic.sensing(experiment).cameras[0])
    faces = np.asarray(experiment.scenario(settings.shape).scene.mesh.faces)
    generator, depths, masks = np.random.default_rng(0), [], []
    for frame in frames:
        depth, which = render(camera, x[frame], faces)
        depths.append(flawed_depth(camera, depth, which, x[frame], faces, TYPICAL, generator))
        masks.append(flawed_mask(which >= 0, TYPICAL.mask_error, generator))
    recording = synthetic.record(experiment, fabric, "held back", key=jr.key(3))
    seen = {
        "simulated": preprocess.of_depths(
            trained.view, data.depth[data.fabric == targets[0]][0] * dataset.STEP
        ),
        "depth camera": preprocess.of_camera(
            trained.view, camera, np.stack(depths), np.stack(masks)
        ),
        "clouds": preprocess.of_clouds(trained.view, recording, frames),
    }
    pictures.draw_images(out / "images.png", seen)
    found = {"truth": np.round(truth, 3).tolist()}
    for name, images in seen.items():
        sighting = sighting_of(settings, trained, images)
        at_truth = physnet.distances(sighting, jnp.asarray(np.stack([truth] * 4), float))[0]
        path = out / f"history_{name.replace(' ', '_')}.npz"
        done = physnet.estimate(sighting, num_calls=asked.calls, path=path)
        place = np.asarray(settings.family.locate(done.fabric))
        found[name] = {
            "error": np.round(np.abs(place - truth), 3).tolist(),
            "loss": done.loss,
            "loss at the truth": float(at_truth),
            "seconds": done.seconds,
        }
    return found


if __name__ == "__main__":
    main()
