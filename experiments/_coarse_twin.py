"""What a coarse sheet fits to a fabric's motions, and how it then moves."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from zlib import crc32

import jax
import jax.random as jr
import numpy as np
from _judged import error_of, floor_of, judged, make
from _tables import Line

from r2s.estimation.registry import METHODS
from r2s.fabrics import prior
from r2s.fabrics.fabric import Fabric
from r2s.study.estimates import SHAPES, EstimateCell, read_estimate
from r2s.study.evaluations import SHAPES as PREDICTED_ON
from r2s.study.sources import SyntheticRecording, small_strain

COARSE, FINE = SHAPES["cloth"], PREDICTED_ON["cloth"]
FITTED_TO = {"lift": ("lifting",), "lift and fling": ("lifting", "fling")}
BUDGET = METHODS["diffcloud"].budget._replace(coarse=16, starts=2, iterations=15)
DRAWS = 4


def line(folder: Path, fitted_to: Sequence[str], motion: str, fabric: str) -> Line:
    """The line of a table; `fitted_to`: of `FITTED_TO`."""
    source, truth = SyntheticRecording(fabric, motion, 0, True), small_strain(fabric)
    fits = {name: _cell(fabric, float(truth.density), FITTED_TO[name]) for name in fitted_to}
    make([*fits.values()], folder)
    (seen,) = judged([source], folder)
    error = partial(error_of, seen, solver="cloth")
    key = jr.fold_in(jr.key(0), crc32(fabric.encode()))  # each fabric has draws of its own
    draws = prior.draws(float(truth.density), DRAWS, key)
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], draws) for i in range(DRAWS)]
    found: Line = {
        "floor": f"{floor_of(seen):.2f}",
        "default": f"{np.mean([error(one, shape=COARSE) for one in each]):.1f}",
        "true fabric, fine": f"{error(truth, shape=FINE):.2f}",
        "true fabric": f"{error(truth, shape=COARSE):.2f}",
    }
    for name, cell in fits.items():
        estimate = read_estimate(cell, folder)
        assert estimate is not None
        found[f"fit to {name}"] = f"{error(estimate.fabric, shape=COARSE):.2f}"
        found[f"fit to {name}, fine"] = f"{error(estimate.fabric, shape=FINE):.2f}"
        found[f"fit to {name} over truth"] = _over(estimate.fabric, truth)
    return found


def _cell(fabric: str, density: float, scenarios: tuple[str, ...]) -> EstimateCell:
    """A sheet of `COARSE` vertices that knows nothing beforehand."""
    sources = tuple(SyntheticRecording(fabric, each, 0, False) for each in scenarios)
    return EstimateCell("diffcloud", "cloth", fabric, sources, density, BUDGET)


def _over(one: Fabric, truth: Fabric) -> str:
    return ", ".join(f"{a / b:.2f}" for a, b in zip(_numbers(one), _numbers(truth), strict=True))


def _numbers(fabric: Fabric) -> list[float]:
    """Warp, weft, shear, bending and damping."""
    membrane = fabric.membrane
    stiff = [membrane.c11, membrane.c22, membrane.c33]
    return [float(each) for each in (*stiff, fabric.bending.stiffness, fabric.damping)]
