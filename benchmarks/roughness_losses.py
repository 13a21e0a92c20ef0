"""Which distance from a cloud to a sheet tells fabrics apart: precisely, without bias, from afar.

Precision and bias are those of the least of a loss near the truth: -H^-1 g, with the gradient g of
each noisy recording at the truth by reverse mode, and the Hessian H by central differences (2 % of
the range to either side) of that gradient for a cloud without noise or outliers. The motion is
linear there, with slopes over 2 % of the range. Cameras are as written down; what a lift hardly
tells of (bending, damping) is known.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import measure
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from roughness_tools import kept, picture, recorded, table, truth, unknown_of
from scipy.stats import rankdata

from r2s import scenarios
from r2s.estimation.prediction import predict
from r2s.estimation.problem import Clouds, Problem, window
from r2s.evaluation import losses
from r2s.evaluation.losses import (
    from_surface,
    huber,
    robust,
    sinkhorn,
    squared,
    to_surface,
    trimmed_mean,
)
from r2s.geometry.surface import sample_weights
from r2s.scenarios.synthetic import Sensing, sensing

FABRIC, FRAMES, POINTS = "grey_interlock", (34, 39, 44, 49, 54, 59), 300
KNOWN = {"warp": 0, "weft": 1, "shear": 2, "coupling": 3, "friction": 6}
KEYS, PLACES = 8, 96
SECANT, STEP = 0.02, 0.02  # of the range
STRAY = 0.01  # [m]: what is farther from the true sheet is an outlier, ten deviations of the noise
DENSE, SAMPLES = 10, 256  # squared, samples of a face to see what is hidden; of the sheet, compared
STRICT = 5e-3  # [m], the scale at which outliers do not count

Frame = tuple[Array, Array, Array, Array, Array]  # points, mask, vertices, samples, visible


def _one_sided(points, mask, x, samples, visible):
    everything = jnp.ones(len(samples), bool)
    return losses.one_sided_chamfer(samples, everything, jnp.where(mask[:, None], points, jnp.inf))


def _towards(penalty, mean=losses.masked_mean) -> Callable:
    """From the cloud to the sheet."""
    return lambda faces, p, m, x, s, v: to_surface(p, m, x, faces, penalty, mean)


def _back(faces, p, m, x, s, v):
    return from_surface(s, v, p, m)


LOSSES: dict[str, Callable] = {
    "robust (Cauchy, 15 mm)": _towards(robust),
    f"robust (Geman-McClure, {1e3 * STRICT:g} mm)": _towards(lambda d: robust(d, STRICT)),
    "squared": _towards(squared),
    "Huber (10 mm)": _towards(huber),
    "squared, least 90 %": _towards(squared, trimmed_mean),
    "from the visible surface": _back,
    "both ways": lambda *a: _towards(squared)(*a) + _back(*a),
    "Sinkhorn (20 mm)": lambda faces, p, m, x, s, v: sinkhorn(p, m, s, v),
    "robust, last frame": _towards(robust),
    "DIFFCLOUD: all of the surface, last frame": lambda faces, *a: _one_sided(*a),
}


def main(out: Path, small: bool) -> None:
    """One table, one picture."""
    names = list(LOSSES)[:3] if small else list(LOSSES)
    keys, places = (2, 4) if small else (KEYS, PLACES)
    paths = {name: out / f"loss_{number}.npz" for number, name in enumerate(names)}
    if not all(path.exists() for path in paths.values()):
        shown = Shown.make(keys, places)
        for name, path in paths.items():
            kept(path, lambda name=name: measured(shown, name))
    rows = [row_of(name, dict(np.load(path))) for name, path in paths.items()]
    table(out / "losses.csv", f"losses, {keys} noises, {places} places", rows)
    picture(drawn(rows), out / "losses.png")


class Shown(eqx.Module):
    """What all losses are given.

    - `perfect`: a cloud without noise and outliers; `clouds`: with each of the noises; `clean`:
      these without outliers.
    - `x`, `slope`: vertices [m] at the truth, and their slopes in `KNOWN` [m/range].
    - `others`: vertices at random places, and how far off `KNOWN` these are [range].
    """

    problem: Problem
    seen: Sensing
    perfect: Clouds
    clouds: list[Clouds | None]
    clean: list[Clouds]
    x: Float[Array, "frame vertex 3"]
    slope: Float[Array, "frame vertex 3 known"]
    others: Float[Array, "place frame vertex 3"]
    away: Float[Array, " place"]

    @classmethod
    def make(cls, keys: int, places: int) -> "Shown":
        """From recordings with some noises, and motions of some places."""
        problem, place = truth(FABRIC, "lifting", num_points=POINTS)
        problem = chosen(problem)
        index = np.array(list(KNOWN.values()))
        move = lambda place: _predict(problem, unknown_of(problem, place)).x
        ends = [
            move(place + sign * SECANT / 2 * np.eye(len(place))[i])
            for i in index
            for sign in (-1, 1)
        ]
        slope = [(b - a) / SECANT for a, b in zip(ends[::2], ends[1::2], strict=True)]
        drawn = np.asarray(jax.random.uniform(jax.random.key(11), (places, len(place)), float))
        x = move(place)
        made = lambda key: Problem.make(
            recorded(FABRIC, "lifting", 1.0, key), problem.space, num_points=POINTS, seed=key
        )
        clouds = [chosen(made(key)).clouds for key in range(keys)]
        away = np.linalg.norm((drawn - place)[:, index], axis=1)
        return cls(
            problem,
            sensing(scenarios.lifting()),
            clean(problem, x, problem.clouds, noise=False),
            clouds,
            [clean(problem, x, cloud, noise=True) for cloud in clouds],
            x,
            jnp.stack(slope, axis=-1),
            jnp.stack([move(place) for place in drawn]),
            jnp.asarray(away, float),
        )


_predict = eqx.filter_jit(predict)


def chosen(problem: Problem) -> Problem:
    """The problem with `FRAMES` alone."""
    parts = [window(problem, frame, frame).clouds for frame in FRAMES]
    clouds = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    return dataclasses.replace(problem, frames=FRAMES, clouds=clouds)


def clean(problem: Problem, x: Float[Array, "frame vertex 3"], clouds: Clouds | None, noise: bool):
    """Clouds without outliers, and those without `noise` moved onto the sheet."""
    assert clouds is not None
    faces = problem.scenario.scene.mesh.faces
    at = jax.vmap(lambda p, m, x: losses.surface_residuals(p, m, x, faces)[:2])
    distance, direction = at(clouds.points, clouds.mask, x)
    moved = clouds.points if noise else clouds.points - distance[..., None] * direction
    return Clouds(moved, clouds.mask & (distance < STRAY))


def loss_of(name: str, shown: Shown, clouds: Clouds, x: Float[Array, "frame vertex 3"]):
    """A mean over the frames [m^2]."""
    scene = shown.problem.scenario.scene
    faces, lowest = scene.mesh.faces, scene.table.height + shown.seen.margin
    weights = sample_weights(DENSE)
    picked = jax.random.permutation(jax.random.key(13), len(faces) * len(weights))[:SAMPLES]

    def frame(given):
        points, mask, x = given
        surface = jnp.einsum("sk,fki->fsi", weights, x[faces]).reshape(-1, 3)
        hidden = jax.lax.stop_gradient(surface)
        visible = jnp.any(jnp.stack([camera.sees(hidden) for camera in shown.seen.cameras]), axis=0)
        visible = visible & (hidden[:, 2] > lowest)
        return LOSSES[name](faces, points, mask, x, surface[picked], visible[picked])

    given = clouds.points, clouds.mask, x
    if "last frame" in name:
        return frame(jax.tree.map(lambda leaf: leaf[-1], given))
    return jnp.mean(jax.lax.map(frame, given))


def measured(shown: Shown, name: str) -> dict:
    """Errors (noise, known) [range] with outliers, then without; losses far away; seconds."""

    @eqx.filter_jit
    def slope(shown, clouds, change):
        moved = lambda change: shown.x + shown.slope @ change
        return jax.value_and_grad(lambda change: loss_of(name, shown, clouds, moved(change)))(
            change
        )

    value = eqx.filter_jit(lambda shown, clouds, x: loss_of(name, shown, clouds, x))
    zero = jnp.zeros(len(KNOWN), float)
    gradients = [slope(shown, clouds, zero)[1] for clouds in (*shown.clouds, *shown.clean)]
    axes = STEP * jnp.eye(len(KNOWN))
    ends = [[slope(shown, shown.perfect, sign * axis)[1] for sign in (-1, 1)] for axis in axes]
    hessian = np.array([(np.asarray(b) - np.asarray(a)) / (2 * STEP) for a, b in ends])
    hessian = (hessian + hessian.T) / 2
    before = time.process_time()
    jax.block_until_ready([slope(shown, shown.clouds[0], zero) for _ in range(3)])
    seconds = (time.process_time() - before) / 3
    far = np.array([float(value(shown, shown.clouds[0], x)) for x in shown.others])
    return {
        "errors": -np.linalg.solve(hessian, np.array(gradients).T).T,
        "curvatures": np.linalg.eigvalsh(hessian),
        "seconds": seconds,
        "far": far,
        "away": np.asarray(shown.away),
        "widths": _widths(shown.problem),
    }


def _widths(problem: Problem) -> np.ndarray:
    """How much the known parameters change over their range: relative where that is logarithmic."""
    ranges = [problem.space.ranges[i] for i in KNOWN.values()]
    return np.array([np.log(b.high / b.low) if b.log else b.high - b.low for b in ranges])


def row_of(name: str, found: dict[str, np.ndarray]) -> measure.Row:
    """Of the table: percent of the parameters (coupling: hundredths); NaN where H is no least's."""
    least = bool(found["curvatures"][0] > 0)
    errors = 100 * found["errors"] * found["widths"] * (1 if least else np.nan)
    row: measure.Row = {"loss": name}
    for word, members in zip(("", ", no outliers"), np.split(errors, 2), strict=True):
        deviation, bias = members.std(axis=0, ddof=1), members.mean(axis=0)
        row[f"deviation{word}, median %"] = np.median(deviation)
        row[f"bias{word}, median %"] = np.median(np.abs(bias))
        row[f"bias{word}, most %"] = np.abs(bias).max()
        row[f"bias / its error{word}"] = np.max(np.abs(bias) / deviation) * np.sqrt(len(members))
    row["has a least"] = least
    row["rank correlation"] = _correlation(found["far"], found["away"])
    row["gradient, cpu ms"] = 1e3 * float(found["seconds"])
    return row


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's, of ranks."""
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def drawn(rows: list[measure.Row]) -> Figure:
    """Deviation and bias, and the rank correlation."""
    figure = Figure(figsize=(9.5, 0.5 * len(rows) + 1.3), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(2, 1))
    at = np.arange(len(rows))
    bars = (
        ("deviation, median %", "deviation", "C0"),
        ("bias, median %", "bias, absolute", "C1"),
        ("deviation, no outliers, median %", "deviation without outliers", "#a6c8e0"),
        ("bias, no outliers, median %", "bias without outliers", "#ffd0a0"),
    )
    for k, (column, label, colour) in enumerate(bars):
        left.barh(at + 0.2 * (k - 1.5), [r[column] for r in rows], 0.19, label=label, color=colour)
    left.set_xscale("log")
    left.set_xlim(left=0.1)
    for height, row in zip(at, rows, strict=True):
        left.text(0.11, height, "" if row["has a least"] else "no least", va="center", fontsize=8)
    left.set_xlabel("median over five parameters [%]", fontsize=8)
    left.set_yticks(at, [r["loss"] for r in rows], fontsize=8)
    left.invert_yaxis()
    figure.legend(fontsize=8, loc="outside lower center", ncols=4)
    right.barh(at, [r["rank correlation"] for r in rows], 0.6, color="C2")
    right.set_xlabel("rank correlation of loss and distance\nover the whole range [-]", fontsize=8)
    return figure
