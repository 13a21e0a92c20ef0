"""The point of a study's verdicts: on truths that are known, the true fabric beats knowing nothing.

None is chaotic. Of the ten motions `CONVERGED` are: mesh and step move them by less than 2 mm up to
the horizon. The others are known to a third of what fabrics differ by; in one the mesh passes half
of that after a quarter of a second, so that no skill is told of it (docs/study.md).
"""

from collections.abc import Iterator

import jax
import numpy as np
import pytest

from r2s.materials import presets
from r2s.study import engine, results, verdicts
from r2s.study.ensembles import read_ensemble
from r2s.study.evaluations import EvaluationTask
from r2s.study.plan import DRAWS
from r2s.study.recordings import SyntheticRecording, small_strain
from r2s.study.report.tables import verdict
from r2s.study.verdicts import SURFACE

KNOWN = 1 / 3  # of what fabrics differ by: mesh and step, mean up to the horizon
EARLY = 0.5  # [s]: a horizon before this one tells nothing
UNTOLD = {("red_jet_set", "shaking")}
CONVERGED = {
    ("pink_solid", "fling"),
    ("red_jet_set", "fling"),
    ("black_denim", "shaking"),
    ("pink_solid", "shaking"),
    *UNTOLD,
}


@pytest.fixture(autouse=True)
def single_precision() -> Iterator[None]:
    """As studies are made, and twice as fast: floors are the same in float64 (docs/study.md)."""
    with jax.enable_x64(False):
        yield


@pytest.mark.slow(group="verdicts")
@pytest.mark.parametrize("motion", ["fling", "shaking"])
@pytest.mark.parametrize("fabric", presets.FIVE)
def test_the_true_fabric_beats_the_default_where_the_truth_is_known(tmp_path, fabric, motion):
    source = SyntheticRecording(fabric, motion, 0, True)
    density = float(small_strain(fabric).density)
    draws = (None, *range(DRAWS))
    cells = [EvaluationTask(None, "cloth", density, fabric, (source,), each) for each in draws]
    ensembles = verdicts.ensembles(cells)
    assert engine.run([*ensembles, *cells], tmp_path, engine.Serial()) == {}
    found = results.collect(cells, tmp_path)
    found = found[found.metric == SURFACE]
    (true,) = found[found.baseline == "true"].itertuples()
    drawn = found[found.baseline == "default"].value
    (ensemble,) = (read_ensemble(each, tmp_path) for each in ensembles)
    inside = ensemble.times < true.horizon
    stiffness, path, mesh, step = (
        float(ensemble.causes[cause][:, inside].mean())
        for cause in ("stiffness", "path", "mesh", "step")
    )
    between = np.mean(np.sqrt(np.mean(ensemble.apart**2, axis=1)))
    assert true.value < np.mean(drawn)
    words = verdict(stiffness, path, mesh, step)
    assert words != "chaotic" and (words == "converged") == ((fabric, motion) in CONVERGED), words
    if (fabric, motion) in UNTOLD:
        assert true.horizon < EARLY and np.isnan(true.skill)
    else:
        assert np.hypot(mesh, step) < KNOWN * between
        assert true.horizon > EARLY and true.skill > 0
