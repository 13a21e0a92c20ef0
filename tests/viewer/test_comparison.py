"""Pictures of a prediction and of an estimate: what stands in them."""

import jax.numpy as jnp
import numpy as np
import pytest
from recorded_lift import cloth, recorded

from r2s.estimation.estimate import point_estimate
from r2s.materials.parameters import OrthotropicSpace
from r2s.recordings.open import SimulatedCloth
from r2s.viewer import comparison
from r2s.viewer.comparison import draw_estimate, draw_prediction


@pytest.fixture
def figures(monkeypatch):
    """The figures that are drawn; they are written, too."""
    drawn, write = [], comparison.write_figure
    monkeypatch.setattr(
        comparison,
        "write_figure",
        lambda path, figure: (drawn.append(figure), write(path, figure))[1],
    )
    return drawn


def distances(figure) -> list[float]:
    """What stands under the frames [mm], in order."""
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    return [float(text.split()[3]) for text in texts if text.startswith("all points: mean")]


def test_a_sheet_that_is_moved_by_20_mm_is_that_far_from_the_points(figures, tmp_path):
    recording, sheet = recorded(), cloth()
    flat = sheet.x.copy()
    flat[..., 2] += 0.15 * np.linspace(0, 1, len(flat))[:, None]  # above all points
    sheets = {"near": sheet, "above": SimulatedCloth(flat, sheet.faces)}
    path = draw_prediction(tmp_path / "both.png", recording, sheets)
    assert path.read_bytes()[:4] == b"\x89PNG"
    near, above = np.split(np.array(distances(figures[0])), 2)
    assert len(near) == comparison.FRAMES
    assert np.all(above > near + 20)
    assert np.all(np.diff(above) > 20)  # it rises


def test_a_run_that_diverged_has_no_distance(figures, tmp_path):
    sheet = cloth()
    lost = SimulatedCloth(np.full_like(sheet.x, np.nan), sheet.faces)
    draw_prediction(tmp_path / "lost.png", recorded(), {"lost": lost})
    assert distances(figures[0]) == []
    texts = [text.get_text() for axes in figures[0].axes for text in axes.texts]
    assert texts.count("diverged") == comparison.FRAMES


def test_each_parameter_has_a_panel_over_its_range(figures, tmp_path):
    """Of a method without standard errors the prior alone is drawn."""
    space = OrthotropicSpace.make(density=0.3)
    found = point_estimate(
        "made", space, jnp.full(space.dim, 0.3), 1.0, np.ones(1), np.ones((1, 1, space.dim)), 1.0
    )
    draw_estimate(tmp_path / "estimate.png", found, space)
    panels = figures[0].axes
    ends = [(bound.low, bound.high) for bound in space.ranges]
    np.testing.assert_allclose([axes.get_xlim() for axes in panels], ends)
    assert all(len(axes.lines) == 2 for axes in panels)  # the prior, and where the estimate is
