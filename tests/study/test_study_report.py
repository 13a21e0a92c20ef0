"""The report of a study: one file without links and of limited size, also of a part of a study."""

import html
import importlib
import json
import math
import re
import sys

import numpy as np
import pandas as pd
import pytest
from made_up_study import made_up_motion, made_up_results
from plotly.offline import get_plotlyjs
from test_results import FABRICS, made_up
from test_results import METRIC as SURFACE

from r2s.study import figures
from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS, PUBLISHED_CONFIGURATIONS
from r2s.study.figures import colours_of, error_chart
from r2s.study.report import publish
from r2s.study.results import as_frame, labelled, with_skill

LIMIT = 15_000_000  # bytes of a report
LABELS = "DIFFCLOUD cloth lifting", "DiffCP mpm lifting"
REFERENCES = "true fabric on cloth", "prior mean on cloth", "default cloth"


class Page:
    """A report without plotly's own code: its HTML, its figures, and its text."""

    def __init__(self, folder):
        whole = (folder / "report.html").read_text(encoding="utf-8")
        self.html = whole.replace(get_plotlyjs(), "")
        assert len(self.html) < len(whole)
        found = re.findall(r'"application/json">(.*?)</script>', self.html, re.DOTALL)
        self.figures = [json.loads(each) for each in found]
        tags = re.compile(r"<script.*?</script>|<style.*?</style>|<[^>]+>", re.DOTALL)
        self.text = " ".join(html.unescape(tags.sub("", self.html)).split())


def some_diverged(configuration, fabric, motion, trial, repeat):
    return math.nan if configuration.approach == "diffcp" and trial == 1 else 0.02 * trial


def diverging(motion, label, frame):
    """A motion in which a configuration diverges in a frame."""
    vertices, errors = motion.vertices[label].copy(), motion.errors[label].copy()
    vertices[frame:], errors[:, frame:] = np.nan, np.nan
    return motion._replace(
        vertices={**motion.vertices, label: vertices}, errors={**motion.errors, label: errors}
    )


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    out = tmp_path_factory.mktemp("study")
    motions = [made_up_motion(motion, labels=(*LABELS, *REFERENCES)) for motion in MOTIONS]
    motions[1] = diverging(motions[1], LABELS[1], 2)
    configurations = (*PAPER_CONFIGURATIONS, PUBLISHED_CONFIGURATIONS[0])
    tables = publish(
        out,
        made_up_results(some_diverged, configurations, trials=3),
        motions,
        {"costs": pd.DataFrame({"CPU s": [12.3]})},
        [("estimates pinn_denim", "RuntimeError: <diverged>")],
        {"recordings": "made up"},
    )
    return tables, {path.stem for path in (out / "tables").iterdir()}, Page(out)


def test_all_tables_are_shown_and_written_and_failures_are_named(published):
    tables, written, page = published
    assert written == set(tables) and page.html.count("<table") == len(tables)
    assert {"findings", "chamfer", "costs", "missing", "settings"} <= written
    # the opening's picture, errors over time, motions
    assert len(page.figures) == 1 + 2 * len(MOTIONS)
    assert "RuntimeError: <diverged>" in page.text and "6 of 18 diverged" in page.text


def test_nothing_is_fetched_and_text_is_escaped(published):
    page = published[2]
    assert "<diverged>" not in page.html and "&lt;diverged&gt;" in page.html
    assert not re.search(r"<link|\b(href|src|srcset)=|https?:|//\w|@import|url\(", page.html)


def test_a_motion_has_a_slider_and_a_sheet_that_diverged_disappears(published):
    drawn = [figure for figure in published[2].figures if "frames" in figure]
    figure = next(f for f in drawn if f["layout"]["title"]["text"].startswith("fling"))
    names = [trace["name"] for trace in figure["data"]]
    assert names == ["recorded points", *LABELS, *REFERENCES]
    shown = [trace.get("visible", True) for trace in figure["data"]]
    assert shown == [True, True, "legendonly", True, "legendonly", "legendonly"]
    (slider,) = figure["layout"]["sliders"]
    steps = [step["args"][0] for step in slider["steps"]]
    assert steps == [[frame["name"]] for frame in figure["frames"]] and len(steps) == 6
    opacities = [frame["data"][2]["opacity"] for frame in figure["frames"]]
    assert [value > 0 for value in opacities] == [True, True, False, False, False, False]


def test_positions_of_a_motion_are_those_of_its_sheet_to_a_tenth_of_a_millimetre():
    motion = made_up_motion(labels=LABELS)
    (figure,) = figures.motion_figures([motion], colours_of(LABELS))
    for frame, x in zip(figure.frames, motion.vertices[LABELS[1]], strict=True):
        drawn = frame.data[2]
        shown = np.stack([drawn.x, drawn.y, drawn.z], axis=1)
        np.testing.assert_allclose(shown, 1e3 * x.reshape(-1, 3), atol=0.0501)


def test_a_motion_plays_at_the_times_of_its_frames():
    """Where two frames were dropped, the one before is shown three times as long."""
    motion = made_up_motion(labels=LABELS)
    times = 0.1 * np.array([0, 1, 2, 5, 6, 7])
    (figure,) = figures.motion_figures([motion._replace(times=times)], colours_of(LABELS))
    names = [frame.name for frame in figure.frames]
    assert names[:4] == ["0.000 s", "0.100 s", "0.200 s", "0.500 s"]
    played = figure.layout.updatemenus[0].buttons[0].args[0]
    assert list(played) == [names[i] for i in (0, 1, 2, 2, 2, 3, 4, 5)]


@pytest.mark.slow(group="study")
def test_a_large_study_stays_within_the_limit(tmp_path):
    """Fifteen motions of twelve sheets of 13 x 13 vertices and 5,000 points in 120 frames."""
    generator = np.random.default_rng(0)
    labels = [f"approach{i} cloth lifting" for i in range(12)]
    x = generator.uniform(-0.4, 0.4, (120, 13, 13, 3))
    cloud = generator.uniform(-0.4, 0.4, (5000, 3))
    motion = made_up_motion(labels=labels)._replace(
        times=np.arange(120) / 30,
        clouds=[cloud] * 120,
        vertices=dict.fromkeys(labels, x),
        errors=dict.fromkeys(labels, generator.uniform(0, 0.02, (40, 120))),
        floor=np.full(120, 1e-3),
    )
    motions = [motion._replace(fabric=f"fabric{i}", recording=f"fling{i}") for i in range(15)]
    publish(tmp_path, made_up_results(configurations=[], trials=1), motions)
    size = (tmp_path / "report.html").stat().st_size
    assert 0.5 * LIMIT < size < LIMIT
    assert len(Page(tmp_path).figures[-1]["frames"]) > 5


def skilled(rows):
    return labelled(with_skill(as_frame(rows), SURFACE))


def test_a_fabric_that_a_configuration_lacks_is_in_no_mean_but_in_the_table_by_fabric(tmp_path):
    rows = [r for r in made_up() if (r["fabric"], r["approach"]) != ("satin", "pinn")]
    tables = publish(tmp_path, skilled(rows))
    assert set(tables["skill_by_fabric"].fabric) == set(FABRICS)
    assert tables["skill"]["fling: floor [mm]"][0] == "1.50"  # of the two others
    assert len(tables["learned"]) == 3


@pytest.mark.parametrize(
    "results",
    [
        made_up_results()[:0],
        made_up_results(lambda *_: math.nan, PAPER_CONFIGURATIONS[:1], ["denim"], ["fling"], 1),
        made_up_results(configurations=PAPER_CONFIGURATIONS[2:3], fabrics=["denim"], trials=1,
                        repeats=1),
        made_up_results(configurations=[], metrics=["hausdorff"]),
    ],
    ids=["nothing", "all diverged", "one configuration", "default fabric alone"],
)  # fmt: skip
def test_parts_of_a_study_are_reported(tmp_path, results):
    tables = publish(tmp_path, results)
    assert Page(tmp_path).html.count("<table") == len(tables)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"horizon": np.inf},
        {"horizon": 0.0},
        {"floor": None, "horizon": None},
        {"floor": np.full(6, np.inf)},
    ],
    ids=["horizon", "never reached", "none inside", "no ensemble", "infinite floor"],
)
def test_errors_over_time_are_drawn(changes):
    runs = np.array([[1e-3, 2e-3, 3e-3, np.nan, np.nan, np.nan], np.full(6, 2e-3)])
    errors = {LABELS[0]: runs, LABELS[1]: np.full((1, 6), 4e-3), "default cloth": 2 * runs[1:]}
    motion = made_up_motion(labels=tuple(errors))._replace(errors=errors, **changes)
    figure = error_chart(motion, colours_of(errors))
    lines = {trace.name: trace for trace in figure.data if trace.mode == "lines"}
    assert list(lines) == [f"{LABELS[0]} (1 of 2 diverged)", LABELS[1], "default cloth"]
    first = lines[f"{LABELS[0]} (1 of 2 diverged)"].y
    np.testing.assert_allclose(first, [1.5, 2.0, 2.5, np.nan, np.nan, np.nan])
    assert figure.layout.yaxis.range[1] == pytest.approx(1.1 * 4)
    assert bool(figure.layout.shapes) == (changes.get("horizon", 0.7) in (0.7, 0.0))


def test_a_missing_library_is_named_with_its_extra(monkeypatch):
    monkeypatch.delitem(sys.modules, "r2s.study.results")
    monkeypatch.setitem(sys.modules, "plotly", None)
    with pytest.raises(ImportError, match=r"plotly is missing: pip install 'r2s\[study\]'"):
        importlib.import_module("r2s.study.results")
