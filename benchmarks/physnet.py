"""PhysNet from data to estimates: accuracy of triplets, errors beside random search, times.

    python benchmarks/physnet.py --out results/physnet
    python benchmarks/physnet.py --out results/physnet_wind --scenario wind
    python benchmarks/physnet.py --out results/physnet_points --points
    python benchmarks/physnet.py --out results/physnet_small --small

Estimates are from images of a depth camera with flaws, of fabrics and of a motion that are not in
the training data. Goes on where it was interrupted: data, networks and searches that lie in the
folder are read. The small one, of few fabrics, shows that all of it runs; its figures say nothing
of the method. Writes figures.json, errors.csv, curves.png, map.png and images.png.
"""

import argparse
import csv
import dataclasses
import io
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import physnet_pictures as pictures
from measure import progress, show
from scipy.stats import spearmanr

from r2s.estimation.physnet import dataset, estimator, preprocess, training, triplets
from r2s.estimation.physnet.dataset import Data, Settings
from r2s.estimation.physnet.estimator import Sighting
from r2s.estimation.physnet.network import DEEPER, PAPER
from r2s.estimation.physnet.training import Training
from r2s.estimation.physnet.views import View, in_frame
from r2s.files import write_json, write_text
from r2s.recordings.cameras.calibration import (
    DepthCamera,
    calibrated,
    frustum,
    look_at,
)
from r2s.recordings.cameras.flaws import TYPICAL, flawed_depth, flawed_mask
from r2s.recordings.cameras.render import render
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import Scenario, rollout

DRAWS = 200  # of random search, which is free: its motions are simulated once
STEP = 0.03  # of the range, of differences
LEVEL = 1  # of the data to estimate from: a motion that no training data have
SMALL = {
    "fabrics": 32, "unseen": 16, "epochs": 2, "steps": 20, "estimates": 1, "repeats": 1,
    "calls": 20, "networks": 1,
}  # fmt: skip
POINTS = {"fabrics": 32, "unseen": 16, "steps": 30}  # unless asked for: a motion takes a second
moved = eqx.filter_jit(rollout)


class Target(NamedTuple):
    """A fabric to estimate: which of the data, its place, and images by how they were made."""

    number: int
    place: np.ndarray
    images: dict[str, np.ndarray]


def main() -> None:
    asked = arguments()
    out = Path(asked.out)
    out.mkdir(parents=True, exist_ok=True)
    figures = json.loads((out / "figures.json").read_text()) if _is_there(out) else {}
    settings = settings_of(asked, asked.fabrics, asked.seed)
    unseen = settings_of(asked, asked.unseen, asked.seed + 1)
    figures["data"] = figures.get("data", {}) | make_data(out / "data", settings)
    view, data = dataset.load_manifest(out / "data").view, dataset.load(out / "data")
    dataset.make(out / "unseen", unseen, view=view)
    others = dataset.load(out / "unseen")
    figures.setdefault("networks", {})
    networks = []
    for seed in range(asked.seed, asked.seed + asked.networks):
        progress(f"network of seed {seed}")
        trained, found = teach(out, data, others, view, asked, seed)
        networks.append(trained)
        figures["networks"][f"{seed}"] = figures["networks"].get(f"{seed}", {}) | found
        write_json(out / "figures.json", figures)
    figures["map"] = draw(out, others, unseen, networks[0])
    chosen = targets(others, unseen, view, asked.estimates) if asked.estimates else []
    if chosen:
        pictures.draw_images(out / "images.png", chosen[0].images)
        figures["views"] = compared(chosen, networks)
        write_json(out / "figures.json", figures)
        rows = estimates(out, others, unseen, networks, chosen, asked)
        figures["estimates"] = summary(rows, unseen, asked)
    write_json(out / "figures.json", figures)
    print(json.dumps(figures, indent=2))


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--out", default="results/physnet")
    add("--scenario", default="lifting")
    add("--points", action="store_true", help="material points and isotropic fabrics")
    add("--fabrics", type=int, default=Settings.num_fabrics)
    add("--unseen", type=int, default=128, help="fabrics to judge by, moved as none before")
    add("--epochs", type=int, default=training.Schedule.epochs)
    add("--steps", type=int, default=training.Schedule.steps)
    add("--paper", action="store_true", help="the paper's two convolutions")
    add("--networks", type=int, default=1, help="of as many seeds")
    add("--estimates", type=int, default=8, help="fabrics to estimate; 0 for none")
    add("--repeats", type=int, default=1, help="searches of each fabric by each network")
    add("--calls", type=int, default=80)
    add("--seed", type=int, default=0)
    add("--small", action="store_true", help="of all less, in a few minutes")
    if parser.parse_known_args()[0].points:
        parser.set_defaults(**POINTS)
    asked = parser.parse_args()
    if asked.small:
        vars(asked).update(SMALL)
    return asked


def _is_there(out: Path) -> bool:
    return (out / "figures.json").exists()


def settings_of(asked: argparse.Namespace, fabrics: int, seed: int) -> Settings:
    settings = Settings(asked.scenario, fabrics, seed=seed)
    judged = seed != asked.seed
    # all that is judged is moved alike, and as nothing before
    apart: dict[str, Any] = {"num_levels": 3, "per_shard": fabrics} if judged else {}
    if not asked.points:
        return dataclasses.replace(settings, **apart)
    about: dict[str, Any] = {"material_points": True, "isotropic": True, "ranges": ()}
    about |= {"num_levels": 3, "shape": (7, 7), "per_shard": 4} | apart
    return dataclasses.replace(settings, **about)


def make_data(folder: Path, settings: Settings) -> dict[str, float]:
    began, spent = time.perf_counter(), time.process_time()
    before = len(list(folder.glob("*.npz")))
    dataset.make(folder, settings)
    shards = len(list(folder.glob("*.npz"))) - before
    if not shards:
        return {}
    frames = shards * settings.per_shard * settings.num_levels * 60
    wall, cpu = time.perf_counter() - began, time.process_time() - spent
    return {"frames": frames, "seconds": wall, "cpu seconds": cpu, "frames a cpu s": frames / cpu}


def teach(out: Path, data: Data, others: Data, view, asked, seed: int):
    """The network of a seed, trained or read, and its accuracy; curves of the first one."""
    path = out / f"training_{seed}.eqx"
    paper = dataclasses.replace(PAPER, size=view.size)
    schedule = training.Schedule(epochs=asked.epochs, steps=asked.steps, seed=seed)
    start = training.begin(view, paper if asked.paper else DEEPER, schedule)
    _, validation = training.divide(data, schedule)
    untrained = training.judge(start.network, view, validation, schedule)[1]
    trained = start
    if path.exists():  # the epochs asked for count, not those of its own schedule
        trained = training.load(path, expected=start.network.architecture)
        if dataclasses.replace(trained.schedule, epochs=schedule.epochs) != schedule:
            raise ValueError(f"{path}: was trained by {trained.schedule}, asked for {schedule}")
        trained = trained._replace(schedule=schedule)
    began, spent, done = time.perf_counter(), time.process_time(), len(trained.curve)

    def say(number, row):
        return print(number, *(f"{value:.4f}" for value in row), flush=True)

    trained = training.train(trained, data, path, say)
    found = {"chance": 0.5, "untrained": untrained, "accuracy": trained.curve[-1].accuracy}
    images = triplets.images_of(others, np.ones(len(others.fabric), bool))
    found["accuracy in unseen motions"] = training.judge(trained.network, view, images, schedule)[1]
    if len(trained.curve) > done:
        found["seconds"] = time.perf_counter() - began
        found["cpu seconds"] = time.process_time() - spent
        found["epochs in that"] = len(trained.curve) - done
    if seed == asked.seed:
        pictures.draw_curves(out / "curves.png", trained.curve, untrained)
    return trained, found


def draw(out: Path, others: Data, settings: Settings, trained: Training) -> dict[str, Any]:
    """The map of unseen fabrics; how distances on it go with distances of parameters."""
    images = triplets.images_of(others, np.ones(len(others.fabric), bool))
    points = training.embed(trained.network, trained.view, images.depth, None)
    title = f"{settings.scenario}: fabrics that the network never saw, all motions and frames"
    places = others.places[images.fabric]
    pictures.draw_map(out / "map.png", points, places, settings.ranges, title)
    numbers, depth = of_level(others, settings)
    one, two = np.triu_indices(len(numbers), 1)
    sequences = embedded(trained, depth)
    apart = distance(sequences[one], sequences[two])
    difference = np.abs(others.places[numbers[one]] - others.places[numbers[two]])

    def correlation(values):
        return float(np.asarray(spearmanr(apart, values))[0])

    names = [bound.name for bound in settings.ranges]
    found = {name: correlation(column) for name, column in zip(names, difference.T, strict=True)}
    found["all parameters"] = correlation(np.sqrt((difference**2).sum(axis=1)))
    return {"rank correlation with": found, "between fabrics": float(np.median(apart))}


def of_level(data: Data, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Which fabrics have all their motions, and their depth images in motion `LEVEL`."""
    # motions are in the order of fabrics and levels, those that diverged left out
    rows = [np.flatnonzero(data.fabric == number) for number in range(len(data.places))]
    whole = [number for number, row in enumerate(rows) if len(row) == settings.num_levels]
    return np.array(whole), data.depth[[rows[number][LEVEL] for number in whole]]


def embedded(trained: Training, depth: np.ndarray) -> np.ndarray:
    """Where sequences (sequence, frame, down, across) of depth images lie, without flaws."""
    points = training.embed(
        trained.network, trained.view, depth.reshape(-1, *depth.shape[2:]), None
    )
    return points.reshape(*depth.shape[:2], -1)


def distance(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """The rms distance, frame by frame, of sequences of points."""
    return np.sqrt(((one - two) ** 2).sum(axis=-1).mean(axis=-1))


def targets(others: Data, settings: Settings, view, count: int) -> list[Target]:
    """Fabrics to estimate: as simulated, as a depth camera saw them, as clouds of two cameras."""
    experiment = dataset.levels(settings)[LEVEL]
    frames = dataset.kept_frames(experiment.frames_used, settings.num_frames)
    scenario = experiment.scenario(settings.shape)
    solver = solver_of(settings, scenario)
    camera = calibrated(synthetic.sensing(experiment).cameras[0])
    faces = np.asarray(scenario.scene.mesh.faces)
    numbers, depth = of_level(others, settings)
    found = []
    for number, simulated in zip(numbers[:count], depth[:count], strict=True):
        progress(f"images of fabric {number}")
        fabric = settings.space(jnp.asarray(others.places[number], float))
        x = np.asarray(moved(scenario, fabric, solver=solver).x)
        generator = np.random.default_rng(int(number))
        depths, masks = [], []
        for frame in frames:
            exact, which = render(camera, x[frame], faces)
            depths.append(flawed_depth(camera, exact, which, x[frame], faces, TYPICAL, generator))
            masks.append(flawed_mask(which >= 0, TYPICAL.mask_error, generator))
        by = None if solver is None else lambda scenario, fabric: solver
        recording = synthetic.record(
            experiment, fabric, "unseen", shape=settings.shape, solver=by, key=jr.key(int(number))
        )
        images = {
            "simulated": preprocess.of_depths(view, simulated * dataset.DEPTH_UNIT),
            "depth camera": preprocess.of_camera(view, camera, np.stack(depths), np.stack(masks)),
            "clouds": preprocess.of_clouds(view, recording, frames),
        }
        found.append(Target(int(number), others.places[number], images))
    return found


def solver_of(settings: Settings, scenario: Scenario):
    """None for the cloth; else the material points of the data, for a scenario of theirs."""
    scenarios = [experiment.scenario(settings.shape) for experiment in dataset.levels(settings)]
    solver = dataset.solver_of(settings, scenarios)
    return solver and eqx.tree_at(lambda s: s.scene, solver, scenario.scene)


def compared(chosen: list[Target], networks: list[Training]) -> dict[str, list[float]]:
    """Median distances of images with flaws from those without, by each network; where the sheet is
    out of the camera's frame, that counts, too."""
    found: dict[str, list[float]] = {"depth camera": [], "clouds": []}
    for trained in networks:
        for name, distances in found.items():
            apart = []
            for target in chosen:
                points = [
                    np.asarray(estimator.embedded(trained.network, jnp.asarray(images, float)))
                    for images in (target.images["simulated"], target.images[name])
                ]
                apart.append(distance(*points))
            distances.append(float(np.median(apart)))
    return found


def estimates(out, others, settings, networks, chosen, asked) -> list[dict[str, Any]]:
    """A row for every network, fabric, kind of images and search; and errors.csv."""
    experiment = dataset.levels(settings)[LEVEL]
    frames = dataset.kept_frames(experiment.frames_used, settings.num_frames)
    scenario = experiment.scenario(settings.shape)
    solver = solver_of(settings, scenario)
    bank, depth = of_level(others, settings)
    cameras = [calibrated(camera) for camera in synthetic.sensing(experiment).cameras]
    rows = []
    for index, trained in enumerate(networks):
        by_kind = {"depth camera": cameras[:1], "clouds": cameras}
        banks = {
            kind: embedded(trained, in_view(trained.view, depth, some))
            for kind, some in by_kind.items()
        }
        for order, target in enumerate(chosen):
            # clouds of the first fabrics only: each takes another search
            kinds = ("depth camera", "clouds") if order < 3 and index == 0 else ("depth camera",)
            for kind in kinds:
                images = target.images[kind]
                sighting = Sighting.make(
                    scenario, images, frames, settings.space, trained, solver, by_kind[kind]
                )
                guessed = random_search(
                    sighting, banks[kind], bank, others.places, target, asked.calls
                )
                if index == 0 and kind == "depth camera":
                    guessed["deviation"] = deviations(sighting, target)
                for seed in range(asked.repeats):
                    name = f"history_{index}_{kind.replace(' ', '_')}_{order}_{seed}.npz"
                    row = searched(out / name, sighting, target, asked.calls, seed)
                    row = {"network": index, "fabric": target.number, "images": kind} | row
                    rows.append(row | guessed)
                    progress(f"{kind}, fabric {order}: errors {np.round(row['error'], 3)}")
    write_rows(out / "errors.csv", rows, settings)
    return rows


def in_view(view: View, depth: np.ndarray, cameras: list[DepthCamera]) -> np.ndarray:
    """Depth images of a view without what is out of the cameras' frames."""
    pose = np.array(look_at(view.position, view.target))
    middles = (np.arange(view.size) + 0.5 - view.size / 2) / view.focal_length
    rays = np.stack([*np.meshgrid(middles, middles), np.ones((view.size,) * 2)], axis=-1)
    points = (depth * dataset.DEPTH_UNIT)[..., None] * (rays @ pose[:3, :3].T) + pose[:3, 3]
    planes = jnp.asarray(np.stack([frustum(camera) for camera in cameras]), float)
    inside = in_frame(jnp.asarray(points.reshape(-1, 3), float), planes)
    return np.where(np.asarray(inside).reshape(depth.shape), depth, 0)


def searched(path: Path, sighting: Sighting, target: Target, calls: int, seed: int):
    fresh, spent = not path.exists(), time.process_time()
    done = estimator.estimate(sighting, num_calls=calls, seed=seed, path=path)
    place = np.asarray(sighting.space.locate(done.fabric))
    at_truth = estimator.responses(sighting, 4)(target.place[None])[0] - estimator.target(sighting)
    return {
        "search": seed,
        "error": np.abs(place - target.place),
        "loss": done.loss,
        "loss at the truth": float(np.sqrt((at_truth**2).mean())),
        "cpu seconds": time.process_time() - spent if fresh else float("nan"),
    }


def deviations(sighting: Sighting, target: Target) -> np.ndarray:
    """What images determine of a fabric: deviations of its place, by least squares at the truth.

    The error of the images counts as the same in all frames, and the ranges as a flat prior.
    """
    respond, place = estimator.responses(sighting, 4), target.place
    ends = [np.clip(place + sign * STEP * np.eye(len(place)), 0, 1) for sign in (-1, 1)]
    places = np.concatenate([*ends, place[None]])
    found = np.concatenate([respond(places[i : i + 4]) for i in range(0, len(places), 4)])
    low, high, here = np.split(found, [len(place), 2 * len(place)])
    slope = (high - low) / (ends[1] - ends[0]).sum(axis=1, keepdims=True)
    variance = ((here[0] - estimator.target(sighting)) ** 2).mean() * len(sighting.frames)
    return np.sqrt(np.diag(np.linalg.inv(slope @ slope.T / variance + 12 * np.eye(len(place)))))


def random_search(sighting, points, bank, places, target, calls) -> dict[str, Any]:
    """The median error and loss of as many simulations at random, of the same motion."""
    apart = distance(points, np.asarray(sighting.points)[None])
    apart = np.where(bank == target.number, np.inf, apart)
    errors, losses = [], []
    for seed in range(DRAWS):
        generator = np.random.default_rng([seed, target.number])
        tried = generator.choice(len(bank), min(calls, len(bank) - 1), replace=False)
        best = tried[np.argmin(apart[tried])]
        errors.append(np.abs(places[bank[best]] - target.place))
        losses.append(apart[best])
    return {"random error": np.array(errors), "random loss": float(np.median(losses))}


def summary(rows: list[dict[str, Any]], settings: Settings, asked) -> dict[str, Any]:
    """Median errors as shares of the ranges, of each network too; printed as a table."""
    names = [bound.name for bound in settings.ranges]
    camera = [row for row in rows if row["images"] == "depth camera"]

    def pick(chosen):
        return np.median([row["error"] for row in chosen], axis=0)

    networks = sorted({row["network"] for row in camera})
    each = np.array([pick([r for r in camera if r["network"] == n]) for n in networks])
    by_chance = np.median(np.concatenate([row["random error"] for row in camera]), axis=0)
    clouds = [row for row in rows if row["images"] == "clouds"]
    known = np.median([row["deviation"] for row in camera if "deviation" in row], axis=0)
    table = [
        {
            "parameter": name,
            "found": float(pick(camera)[i]),
            "networks": np.round(each[:, i], 4).tolist(),
            "random search": float(by_chance[i]),
            "clouds": float(pick(clouds)[i]) if clouds else None,
            "deviation by the images": float(known[i]),
        }
        for i, name in enumerate(names)
    ]

    def text(value):
        return f"{value:.3f}" if isinstance(value, float) else f"{value}"

    columns = {key: (lambda row, key=key: text(row[key])) for key in table[0]}
    show("median error, share of the range", table, columns)

    def median(key):
        return float(np.nanmedian([row[key] for row in camera]))

    seconds = [row["cpu seconds"] for row in camera if np.isfinite(row["cpu seconds"])]
    return {
        "fabrics": len({row["fabric"] for row in camera}),
        "searches": len(camera),
        "calls": asked.calls,
        "median error": table,
        "loss": {key: median(key) for key in ("loss", "loss at the truth", "random loss")},
        "cpu seconds": [float(np.median(seconds)), max(seconds)] if seconds else [],
    }


def write_rows(path: Path, rows: list[dict[str, Any]], settings: Settings) -> None:
    """One line for every parameter of every search."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    head = ("network", "fabric", "images", "search", "loss", "loss at the truth", "random loss")
    writer.writerow((*head, "parameter", "error", "random error"))
    for row in rows:
        guessed = np.median(row["random error"], axis=0)
        for bound, *errors in zip(settings.ranges, row["error"], guessed, strict=True):
            numbers = (f"{error:.5f}" for error in errors)
            writer.writerow((*(row[key] for key in head), bound.name, *numbers))
    write_text(path, buffer.getvalue())


if __name__ == "__main__":
    main()
