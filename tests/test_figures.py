"""What all pictures share: limits, the points that are drawn, and the extra that is named."""

import sys

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from r2s.study.report import figures  # noqa: E402


def test_limits_hold_the_cloth_but_not_what_strays():
    generator = np.random.default_rng(0)
    dots = generator.uniform(0, 1, (1000, 3))
    dots[:3] = 40.0
    vertices = np.array([[1.2, 0.5, 0.5], [0.5, -0.3, 0.5], [9.0, 9.0, 9.0], [np.nan, 0, 0]])
    low, high = figures.limits(dots, vertices)
    assert 1.2 <= high[0] < 1.3 and -0.4 < low[1] <= -0.3
    assert high[2] < 1.1 and (high < 2).all()


def test_a_cloud_is_thinned_to_the_same_finite_points():
    cloud = np.random.default_rng(0).uniform(size=(2 * figures.MOST_DOTS, 3))
    cloud[::10] = np.nan
    found = figures.thin(cloud)
    assert len(found) == figures.MOST_DOTS and np.isfinite(found).all()
    np.testing.assert_array_equal(found, figures.thin(cloud))


def test_without_matplotlib_the_extra_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "r2s.study.report.figures")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"pip install 'r2s\[study\]'"):
        import r2s.study.report.figures  # noqa: F401
