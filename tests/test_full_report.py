"""The report of a whole study, also where most of it is missing."""

import math

import numpy as np
import pytest
from made_up_study import made_up_comparison, made_up_rows
from test_report import Page

from r2s.fabrics.parameters import Range
from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS, PUBLISHED_CONFIGURATIONS
from r2s.study.costs import Cost, cost_table
from r2s.study.report import full, overlays
from r2s.study.report.figures import looks_of
from r2s.study.report.page import PNG
from r2s.study.statistics.parameters import Estimated

ESTIMATED = Estimated(
    "diffcloud_denim",
    (Range("C11", "N/m", 3.0, 3000.0),),
    np.array([123.0]),
    np.array([0.1]),
    np.array([True]),
    np.array([np.nan]),
)
CONFIGURATIONS = (*PAPER_CONFIGURATIONS, PUBLISHED_CONFIGURATIONS[0])
COSTS = cost_table([Cost("estimates", count=3, seconds=12.345, each=4.1, peak_memory=512.0)])


def some_diverged(configuration, fabric, motion, trial, repeat):
    return math.nan if configuration.approach == "diffcp" and trial == 1 else 0.02 * trial


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    out = tmp_path_factory.mktemp("study")
    labels = "DIFFCLOUD cloth lifting", "b"
    motions = [made_up_comparison(motion, labels=labels) for motion in MOTIONS]
    motions[1].motions["b"][2:] = np.nan
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(full, "MOST_IN_VIEWER", 2)
        tables = full.publish(
            out,
            made_up_rows(some_diverged, CONFIGURATIONS, trials=3),
            motions,
            {"cloth": [ESTIMATED], "points": []},
            [("estimates pinn_denim", "RuntimeError: <diverged>")],
            {"recordings": "made up"},
            more=[("Costs", "", {"costs": COSTS}), ("Nothing", "is said of it", {})],
        )
    return out, tables, Page((out / "report.html").read_text())


def test_all_parts_are_there(published):
    out, tables, page = published
    for text in (
        "Findings", "fabrics that would tell:", "Distances in millimetres",
        "In the units of the paper", "Ranks", "What matters", "Error over time",
        "Viewer", "123 ± 12 N/m",
        "RuntimeError: <diverged>", "12.3",
        "peak memory [MB]", "recordings", "made up", "version of jax", "diverged)",
        "1 more recordings are not in it", "DIFFCLOUD as published cloth lifting",
        "videos/fling_black_denim1.",
    ):  # fmt: skip
        assert text in page.text, text
    written = {path.stem for path in (out / "tables").iterdir()}
    assert len(written) == len(tables) == len(page.all("table"))
    assert {"findings", "chamfer", "ranks", "factors", "costs", "missing"} <= written
    assert all((out / "tables" / f"{n}.{end}").exists() for n in written for end in ("md", "tex"))
    assert len(page.all("canvas")) == 1 and len(page.all("option")) == 2
    assert "is said of it" not in page.text


def test_pictures_and_videos_are_written(published):
    out, _, page = published
    names = {path.name for path in (out / "figures").iterdir()}
    both = {
        f"{kind}_{motion}_black_denim.png" for kind in ("errors", "sheets") for motion in MOTIONS
    }
    assert names == {"distances.png", "ranks.png", "factors.png"} | both
    assert all((out / "figures" / name).read_bytes().startswith(PNG) for name in names)
    assert len(page.all("img")) == len(names)
    assert len(list((out / "videos").iterdir())) == len(MOTIONS)


def test_pictures_come_first_and_tables_of_other_distances_last(published):
    text = published[2].text
    order = "Error over time", "Sheets at", "Findings", "Viewer", "Distances in millimetres"
    places = [text.index(heading) for heading in (*order, "In the units of the paper", "Settings")]
    assert places == sorted(places)


@pytest.mark.parametrize(
    "rows",
    [
        [],
        made_up_rows(lambda *_: math.nan, PAPER_CONFIGURATIONS[:1], ["denim"], ["fling"], trials=1),
        made_up_rows(
            configurations=PAPER_CONFIGURATIONS[2:3], fabrics=["denim"], trials=1, repeats=1
        ),
        made_up_rows(configurations=[], metrics=["hausdorff"]),
    ],
    ids=["nothing", "all diverged", "one configuration", "default fabric alone"],
)
def test_parts_of_a_study_are_reported(tmp_path, rows):
    full.publish(tmp_path, rows)
    page = Page((tmp_path / "report.html").read_text())
    assert "Findings" in page.text and "Settings" in page.text
    assert "Configurations of the paper that have no result here" in page.text


def test_pictures_of_a_video_move():
    shown = made_up_comparison()
    first, *_, last = list(overlays.pictures(shown, looks_of(shown.motions)))
    assert first.shape == last.shape and first.shape[0] % 2 == first.shape[1] % 2 == 0
    assert np.mean(np.any(first != last, axis=-1)) > 0.005
