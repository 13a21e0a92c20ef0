"""What the parts of benchmarks/roughness.py share: problems of a known truth, what is kept."""

import csv
import dataclasses
import io
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import measure
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from r2s import scenarios
from r2s.cloth.cloth import Cloth
from r2s.estimation import gauss_newton
from r2s.estimation.problem import Problem
from r2s.fabrics import presets
from r2s.fabrics.fabric import Fabric
from r2s.fabrics.parameters import OrthotropicSpace, ParameterSpace, Range
from r2s.files import write_bytes, write_text
from r2s.recordings.recording import Recording
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import Scenario

POINTS = 100  # of a cloud, a frame: the roughness is that of the motion, not of the cloud
FINE = 4  # times as many steps: 5.6 ms, which hardly damp

loss_at = eqx.filter_jit(gauss_newton.loss_at)
normal_at = eqx.filter_jit(gauss_newton.normal_at)


class Damped(ParameterSpace):
    """A space whose fabrics have `factor` times their damping; 0: none."""

    space: ParameterSpace
    factor: Float[Array, ""]
    ranges: tuple[Range, ...] = eqx.field(static=True)

    @classmethod
    def make(cls, space: ParameterSpace, factor: float) -> "Damped":
        """Of a space and a factor."""
        return cls(space=space, factor=jnp.asarray(factor, float), ranges=space.ranges)

    def __call__(self, u: Float[Array, " dim"]) -> Fabric:
        """The fabric at a point of the unit cube."""
        fabric = self.space(u)
        return eqx.tree_at(lambda f: f.damping, fabric, fabric.damping * self.factor)

    def locate(self, fabric: Fabric) -> Float[Array, " dim"]:
        """Where a fabric lies; nowhere finite when all have no damping."""
        before = lambda damping: damping / self.factor
        return self.space.locate(eqx.tree_at(lambda f: f.damping, fabric, replace_fn=before))


def true_fabric(name: str, factor: float = 1.0) -> Fabric:
    """A preset with `factor` times its damping."""
    scale = lambda damping: damping * jnp.asarray(factor, float)
    return eqx.tree_at(lambda f: f.damping, presets.FIVE[name](), replace_fn=scale)


def recorded(
    name: str, scenario: str, factor: float = 1.0, number: int = 0, bare: bool = False
) -> Recording:
    """The synthetic recording of a preset with `factor` times its damping; `number` its noise."""
    fabric = true_fabric(name, factor)
    experiment = scenarios.SIX[scenario]()
    solver = (lambda scenario, _: in_vacuum(scenario)) if bare else None
    return synthetic.record(experiment, fabric, name, solver=solver, key=jax.random.key(number))


def in_vacuum(scenario: Scenario) -> Cloth:
    """The cloth without air, in steps so short that they hardly damp."""
    nothing = jnp.zeros((), float)
    scene = eqx.tree_at(lambda scene: scene.air.density, scenario.scene, nothing)
    return Cloth.make(scene, scenario.interval / (FINE * scenario.substeps))


def truth(
    name: str, scenario: str, factor: float = 1.0, num_points: int = POINTS, bare: bool = False
) -> tuple[Problem, np.ndarray]:
    """The problem of a preset with `factor` times its damping, and its true place.

    `bare`: simulated, and recorded, in a vacuum and in short steps.
    """
    fabric = presets.FIVE[name]()
    space = OrthotropicSpace.make(float(fabric.density))
    recording = recorded(name, scenario, factor, bare=bare)
    problem = Problem.make(recording, Damped.make(space, factor), num_points=num_points)
    if bare:
        problem = dataclasses.replace(problem, solver=in_vacuum(problem.scenario))
    return problem, np.asarray(space.locate(fabric))


def unknown_of(problem: Problem, place: Any) -> Float[Array, " unknown"]:
    """A place of the space, with everything else as it was written down."""
    rest = jnp.zeros(gauss_newton.size((problem,)) - problem.space.dim, float)
    return jnp.concatenate([jnp.asarray(place, float), rest])


def losses_at(problem: Problem, places: Float[np.ndarray, "place dim"]) -> np.ndarray:
    """The default loss [m^2] at some places."""
    return np.array([float(loss_at((problem,), unknown_of(problem, place))) for place in places])


def kept(path: Path, make: Callable[[], dict[str, Any]]) -> dict[str, np.ndarray]:
    """Arrays that an earlier run made and wrote; else those that are made now, and their CPU time.

    `cpu_s` [s] among them is that of making them, with compilation.
    """
    if not path.exists():
        measure.progress(path.stem)
        before = time.process_time()
        made = make()
        made["cpu_s"] = time.process_time() - before
        buffer = io.BytesIO()
        np.savez(buffer, **made)
        write_bytes(path, buffer.getvalue())
    with np.load(path) as found:
        return dict(found)


def table(path: Path, title: str, rows: Sequence[measure.Row]) -> None:
    """Print rows of the same columns, and write them as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())
    columns = {name: (lambda row, name=name: _text(row[name])) for name in rows[0]}
    measure.show(title, rows, columns)


def _text(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, (float, np.floating)) else str(value)


def picture(figure: Figure, path: Path) -> None:
    """A figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_bytes(path, buffer.getvalue())
    print(f"{path}")
