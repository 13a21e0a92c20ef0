"""What DiffCP finds in a space of fabrics, and how it then moves."""

import dataclasses
import time
from pathlib import Path

import jax.random as jr
import numpy as np
from _tables import Line

from r2s.estimation import default_spaces
from r2s.estimation.diffcp import DEFAULT, DiffCP
from r2s.evaluation.prediction_error import from_surface
from r2s.fabrics import prior
from r2s.fabrics.parameters import LOSSES, OrthotropicSpace, ParameterSpace
from r2s.study import engine, verdicts
from r2s.study.ensembles import ensemble_of
from r2s.study.estimates import SHAPES as ESTIMATED_ON
from r2s.study.evaluations import SHAPES, predict
from r2s.study.sources import SyntheticRecording, read, read_start, small_strain

SPACES = ("isotropic", "with damping and friction", "orthotropic, too")
JUDGED = ("fling", "shaking")
BUDGET = DEFAULT._replace(coarse=6, starts=1, iterations=10)  # the same for all


def line(folder: Path, fabric: str, space: str) -> Line:
    """The line of a table."""
    lift = SyntheticRecording(fabric, "lifting", 0, False)
    judged = {each: SyntheticRecording(fabric, each, 0, True) for each in JUDGED}
    cells = [lift, *(ensemble_of(each) for each in judged.values())]
    if failed := engine.run(cells, folder, engine.Serial()):
        raise RuntimeError(f"{next(iter(failed.values()))}")
    density = float(small_strain(fabric).density)
    chosen = prior.informed(_space(space, density), density)
    began, method = time.process_time(), DiffCP(shape=ESTIMATED_ON["points"])
    found = method.estimate([read(lift, folder)], chosen, BUDGET, key=jr.key(0))
    numbers: Line = {"CPU s": f"{time.process_time() - began:.0f}"}
    for motion, source in judged.items():
        known = verdicts.judged_motion(source, folder)
        assert known is not None
        recording, start = read(source, folder), read_start(source, folder)
        numbers[f"{motion}: floor"] = f"{1e3 * float(np.mean(known.floor[known.inside])):.1f}"
        for solver, shape in SHAPES.items():
            for which, name in ((found.fabric, ""), (small_strain(fabric), ", true fabric")):
                (moved,) = predict([recording], which, solver, [start], shape)
                off = 1e3 * float(np.mean(from_surface(recording, moved.x, shape)[known.inside]))
                numbers[f"{motion}: {solver}{name}"] = f"{off:.1f}"
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
