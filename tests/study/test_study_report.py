"""The report of a whole study: one file without links and of limited size, also where most of the
study is missing."""

import json
import math
import re
import sys
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from made_up_study import made_up_motion, made_up_results
from plotly.offline import get_plotlyjs
from test_skills import FABRICS, made_up
from test_skills import METRIC as SURFACE

from r2s.mesh.mesh import rectangle
from r2s.study.configuration import MOTIONS, PAPER_CONFIGURATIONS, PUBLISHED_CONFIGURATIONS
from r2s.study.report import figures
from r2s.study.report.figures import colours_of, error_chart, median_run, thinned
from r2s.study.report.page import publish
from r2s.study.report.tables import significant
from r2s.study.results import PARAMETERS
from r2s.study.statistics.frame import (
    as_frame,
    labelled,
    with_skill,
)
from r2s.study.verdicts import Judged

LIMIT = 15_000_000  # bytes of a report
LABELS = "DIFFCLOUD cloth lifting", "DiffCP mpm lifting"
REFERENCES = "true fabric on cloth", "prior median on cloth", "default cloth"
VOID = {"meta", "br"}
ESTIMATED = pd.DataFrame(
    [
        ("cloth", "denim", "C11", "N/m", 123.0, 104.3, 145.0, 0.1, 110.0),
        ("cloth", "denim", "coupling", "-", -0.25, -0.41, -0.086, 0.3, math.nan),
        ("cloth", "rag", "C11", "N/m", 1e-5, 1e-6, 1e-3, 0.9, math.nan),
    ],
    columns=list(PARAMETERS),
)


class Page(HTMLParser):
    """Checks that tags are closed in order; collects tags, figures and text."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.text, self.figures = [], [], "", []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        inside = self.open[-1] if self.open else ""
        if inside == "script" and self.tags[-1][1].get("type") == "application/json":
            self.figures.append(json.loads(data))
        elif inside not in ("script", "style"):
            self.text += data

    def count(self, tag):
        return sum(name == tag for name, _ in self.tags)


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
        ESTIMATED,
        [("estimates pinn_denim", "RuntimeError: <diverged>")],
        {"recordings": "made up"},
        making={"costs": ("Costs", pd.DataFrame({"CPU s": [12.3]}))},
    )
    text = (out / "report.html").read_text(encoding="utf-8")
    return out, tables, text, Page(text)


def test_all_tables_are_shown_and_written_and_failures_are_named(published):
    out, tables, _, page = published
    written = {path.stem for path in (out / "tables").iterdir()}
    assert written == set(tables) and page.count("table") == len(tables)
    assert {"findings", "chamfer", "ranks", "costs", "missing", "settings"} <= written
    # the opening's picture, errors over time, motions
    assert len(page.figures) == 1 + 2 * len(MOTIONS)
    assert "RuntimeError: <diverged>" in page.text and "6 of 18 diverged" in page.text


def test_nothing_is_fetched(published):
    text, page = published[2:]
    names = {name for _, found in page.tags for name in found}
    assert not names & {"href", "src", "srcset"} and page.count("link") == 0
    own = text.replace(get_plotlyjs(), "")
    assert len(own) < len(text) and not re.search(r"https?:|//\w|@import|url\(", own)


def test_text_is_escaped(published):
    assert "<diverged>" not in published[2] and "&lt;diverged&gt;" in published[2]


def test_a_motion_has_a_slider_and_a_sheet_that_diverged_disappears(published):
    figure = next(each for each in published[3].figures if each.get("frames")
                  and each["layout"]["title"]["text"].startswith("fling"))  # fmt: skip
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
        np.testing.assert_allclose(shown, 1e3 * x, atol=0.0501)


@pytest.mark.slow(group="study")
def test_a_large_study_stays_within_the_limit(tmp_path):
    """Fifteen motions of twelve sheets of 13 x 13 vertices and 5,000 points in 120 frames."""
    generator, mesh = np.random.default_rng(0), rectangle((0.4, 0.4), (13, 13))
    labels = [f"approach{i} cloth lifting" for i in range(12)]
    rest = np.pad(np.asarray(mesh.rest, float), ((0, 0), (0, 1)))
    x = rest + 0.1 * generator.normal(size=(120, 1, 3))
    cloud = generator.uniform(-0.4, 0.4, (5000, 3))
    motion = made_up_motion(labels=labels)._replace(
        times=np.arange(120) / 30,
        clouds=[cloud] * 120,
        faces=dict.fromkeys(labels, np.asarray(mesh.faces)),
        vertices=dict.fromkeys(labels, x),
        errors=dict.fromkeys(labels, generator.uniform(0, 0.02, (40, 120))),
        floor=np.full(120, 1e-3),
    )
    motions = [motion._replace(fabric=f"fabric{i}", recording=f"fling{i}") for i in range(15)]
    publish(tmp_path, made_up_results(configurations=[], trials=1), motions)
    size = (tmp_path / "report.html").stat().st_size
    assert 0.5 * LIMIT < size < LIMIT
    assert len(Page((tmp_path / "report.html").read_text()).figures[-1]["frames"]) > 5


def skilled(rows):
    return labelled(with_skill(as_frame(rows), SURFACE))


@pytest.mark.slow(group="study")
def test_one_fabric_is_said_to_decide_nothing(tmp_path):
    publish(tmp_path / "one", skilled(made_up(FABRICS[:1])))
    publish(tmp_path / "three", skilled(made_up()))
    one, three = (
        Page((tmp_path / name / "report.html").read_text()).text for name in ("one", "three")
    )
    assert "One fabric decides nothing between approaches" in one
    assert "decides nothing" not in three and "from 3 fabrics" in three
    assert "The highest mean skill has DIFFCLOUD cloth lifting in fling (0.65 [" in three


def test_a_fabric_that_a_configuration_lacks_is_in_no_mean_but_in_the_table_by_fabric(tmp_path):
    rows = [r for r in made_up() if (r["fabric"], r["approach"]) != ("satin", "pinn")]
    tables = publish(tmp_path, skilled(rows))
    text = Page((tmp_path / "report.html").read_text()).text
    assert "Not every configuration has an estimate of satin" in text
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
    publish(tmp_path, results)
    page = Page((tmp_path / "report.html").read_text())
    assert "What is missing" in page.text and "Settings" in page.text
    assert "Configurations of the paper that have no result here" in page.text


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


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0.00"), (150.2, "150"), (999.9, "1000"), (-12345.0, "-12300"), (1e-7, "1.00e-07")],
)
def test_numbers_have_three_digits(value, text):
    assert significant(value) == text


def test_a_missing_library_is_named_with_its_extra(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("r2s.study.report")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "plotly", None)
    with pytest.raises(ImportError, match=r"plotly is missing: pip install 'r2s\[study\]'"):
        import r2s.study.report  # noqa: F401


@pytest.mark.parametrize(
    ("shape", "left"),
    [((25, 25), (13, 13)), ((9, 9), (9, 9)), ((17, 33), (5, 9)), ((24, 24), None)],
)
def test_fewer_vertices_are_those_of_a_coarser_mesh(shape, left):
    rest = np.asarray(rectangle((0.4, 0.2), shape).rest, float)
    x = np.pad(rest, ((0, 0), (0, 1)))[None]
    kept, found = thinned(x, shape)
    assert found == (left or found)
    coarse = rectangle((0.4, 0.2), found)
    np.testing.assert_allclose(kept[0, :, :2], np.asarray(coarse.rest), atol=1e-7)


def test_the_run_in_the_middle_is_drawn_and_one_that_diverged_is_the_last():
    runs = np.array([[5.0, 1.0], [np.nan, np.nan], [3.0, 9.0], [4.0, 0.0]])
    assert median_run(runs, None) == 0
    early = Judged(np.arange(2.0), np.zeros(2), 1.0)  # the first frame alone
    assert median_run(runs, early) == 3
    assert median_run(runs[:2], None) == 0
    assert median_run(np.full((2, 2), np.nan), None) == 0


def with_errors(errors, **changes):
    """Six frames, 0.2 s apart."""
    found = {label: np.atleast_2d(np.asarray(each, float)) for label, each in errors.items()}
    return made_up_motion(labels=tuple(errors))._replace(errors=found, **changes)


def test_a_mean_with_a_run_that_diverged_is_infinite():
    runs = np.array([[1e-3, np.nan, np.nan, np.nan, np.nan, np.nan], np.full(6, 2e-3)])
    mean = with_errors({LABELS[0]: runs}).mean_errors[LABELS[0]]
    assert mean.tolist() == [1.5e-3] + 5 * [np.inf]
