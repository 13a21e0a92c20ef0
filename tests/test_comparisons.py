"""What pictures of a study are made of: which run is drawn, and of which vertices."""

import numpy as np
import pytest

from r2s.geometry.mesh import rectangle
from r2s.study import comparisons
from r2s.study.comparisons import label_of
from r2s.study.evaluations import EvaluationCell
from r2s.study.sources import SyntheticRecording
from r2s.study.verdicts import Judged


@pytest.mark.parametrize(
    ("shape", "left"),
    [((25, 25), (13, 13)), ((9, 9), (9, 9)), ((17, 33), (5, 9)), ((24, 24), None)],
)
def test_fewer_vertices_are_those_of_a_coarser_mesh(shape, left):
    rest = np.asarray(rectangle((0.4, 0.2), shape).rest, float)
    x = np.pad(rest, ((0, 0), (0, 1)))[None]
    thinned, found = comparisons._thinned(x, shape)
    assert found == (left or found)
    coarse = rectangle((0.4, 0.2), found)
    np.testing.assert_allclose(thinned[0, :, :2], np.asarray(coarse.rest), atol=1e-7)


def test_the_run_in_the_middle_is_drawn_and_one_that_diverged_is_the_last():
    runs = np.array([[5.0, 1.0], [np.nan, np.nan], [3.0, 9.0], [4.0, 0.0]])
    assert comparisons._middle(runs, None) == 0
    early = Judged(np.arange(2.0), np.zeros(2), 1.0)  # the first frame alone
    assert comparisons._middle(runs, early) == 3
    assert comparisons._middle(runs[:2], None) == 0
    assert comparisons._middle(np.full((2, 2), np.nan), None) == 0


def test_the_true_fabric_is_not_taken_for_the_default():
    source = SyntheticRecording("pink_solid", "fling", 0, True)
    true, drawn = (
        EvaluationCell(None, "cloth", 0.1, "pink_solid", (source,), draw) for draw in (None, 0)
    )
    assert label_of(true) == "true fabric on cloth" and label_of(drawn) == "default cloth"
