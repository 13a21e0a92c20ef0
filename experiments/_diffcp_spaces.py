"""What DiffCP finds in a space of fabrics, and how it then moves."""

import dataclasses
import time
from pathlib import Path

import jax.random as jr
from _judged import error_of, floor_of, judged, make
from _tables import Line

from r2s.estimation import default_spaces
from r2s.estimation.diffcp import DEFAULT, DiffCP
from r2s.fabrics import prior
from r2s.fabrics.parameters import LOSSES, OrthotropicSpace, ParameterSpace
from r2s.study.estimates import SHAPES as ESTIMATED_ON
from r2s.study.evaluations import SHAPES
from r2s.study.sources import SyntheticRecording, read, small_strain

SPACES = ("isotropic", "with damping and friction", "orthotropic, too")
JUDGED = ("fling", "shaking")
BUDGET = DEFAULT._replace(coarse=6, starts=1, iterations=10)  # the same for all


def line(folder: Path, fabric: str, space: str) -> Line:
    """The line of a table."""
    lift = SyntheticRecording(fabric, "lifting", 0, False)
    make([lift], folder)
    motions = judged([SyntheticRecording(fabric, each, 0, True) for each in JUDGED], folder)
    density = float(small_strain(fabric).density)
    chosen = prior.informed(_space(space, density), density)
    began, method = time.process_time(), DiffCP(shape=ESTIMATED_ON["points"])
    found = method.estimate([read(lift, folder)], chosen, BUDGET, key=jr.key(0))
    numbers: Line = {"CPU s": f"{time.process_time() - began:.0f}"}
    for name, motion in zip(JUDGED, motions, strict=True):
        numbers[f"{name}: floor"] = f"{floor_of(motion):.1f}"
        for solver, shape in SHAPES.items():
            for which, whose in ((found.fabric, ""), (small_strain(fabric), ", true fabric")):
                off = error_of(motion, which, solver, shape)
                numbers[f"{name}: {solver}{whose}"] = f"{off:.1f}"
    told = zip(found.ranges, found.values, strict=True)
    numbers["found"] = ", ".join(f"{each.name} {value:.3g}" for each, value in told)
    return numbers


def _space(name: str, density: float) -> ParameterSpace:
    """On points all of it is as stiff as the isotropic at most, so that steps are as long."""
    if name != SPACES[2]:
        return default_spaces.on_points(density, LOSSES if name == SPACES[1] else ())
    space = default_spaces.on_cloth(density)
    stiffest = {"warp": 1000.0, "weft": 1000.0, "shear": 500.0}
    ranges = tuple(
        dataclasses.replace(each, high=stiffest.get(each.name, each.high)) for each in space.ranges
    )
    return OrthotropicSpace(density=space.density, thickness=space.thickness, ranges=ranges)
