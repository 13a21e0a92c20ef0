"""What a report begins with: pictures of error over time, and of the frame that decides."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_study import made_up_comparison
from test_report import Page
from test_skill_table import made_up

from r2s.study.report import error_over_time, full, opening
from r2s.study.report.figures import GREY, INK, looks_of
from r2s.study.report.motions import deciding_frame
from r2s.study.report.page import PNG

LABELS = "DIFFCLOUD cloth lifting", "DiffCP points lifting"
REFERENCES = "true fabric on cloth", "middle of the prior on cloth", "default cloth"


def with_errors(errors, **changes):
    """Six frames, 0.2 s apart."""
    shown = made_up_comparison(labels=tuple(errors))
    found = {label: np.atleast_2d(np.asarray(each, float)) for label, each in errors.items()}
    return replace(shown, errors=found, **changes)


numbers = st.floats(0, 1) | st.just(np.nan)


@settings(max_examples=50)
@given(st.data(), st.floats(0, 1.5) | st.just(np.inf))
def test_the_frame_that_decides_is_before_the_horizon(data, horizon):
    runs = st.lists(numbers, min_size=6, max_size=6)
    labels = data.draw(st.sampled_from([LABELS, REFERENCES, LABELS[:1], LABELS + REFERENCES]))
    shown = with_errors({label: data.draw(runs) for label in labels}, horizon=horizon)
    frame = deciding_frame(shown)
    assert (frame is None) == (not shown.inside.any())
    assert frame is None or shown.times[frame] < horizon


def test_the_frame_that_decides_is_where_what_is_compared_is_farthest_apart():
    first, second = [1, 1, 5, 1, 1, 9], [1, 3, 6, 1, 1, 1]
    far = {"true fabric on cloth": [0, 0, 0, 0, 0, 0], "default cloth": [9, 0, 0, 0, 0, 0]}
    both = dict(zip(LABELS, (first, second), strict=True))
    assert deciding_frame(with_errors(both, horizon=np.inf)) == 5
    assert deciding_frame(with_errors(both)) == 1  # the last one is beyond the horizon
    assert deciding_frame(with_errors(both | far)) == 1  # of configurations, where there are two
    assert deciding_frame(with_errors({LABELS[0]: first} | far)) == 0
    assert deciding_frame(with_errors({LABELS[0]: first})) == 2
    lost = {LABELS[0]: [1, np.nan, np.nan, np.nan, np.nan, np.nan], LABELS[1]: [3, 9, 9, 9, 9, 9]}
    assert deciding_frame(with_errors(lost)) == 0  # nothing is left to compare with, after it
    assert deciding_frame(with_errors(both, horizon=0.0)) is None


def test_frames_that_cameras_saw_little_of_do_not_decide():
    shown = with_errors({LABELS[0]: [1, 2, 9, 3, 1, 1]})
    clouds = tuple(cloud[:3] if i == 2 else cloud for i, cloud in enumerate(shown.clouds))
    assert deciding_frame(replace(shown, clouds=clouds)) == 3


def test_a_mean_with_a_run_that_diverged_is_infinite():
    runs = np.array([[1e-3, np.nan, np.nan, np.nan, np.nan, np.nan], np.full(6, 2e-3)])
    mean = with_errors({LABELS[0]: runs}).mean_errors[LABELS[0]]
    assert mean.tolist() == [1.5e-3] + 5 * [np.inf]


def test_what_runs_away_does_not_widen_a_picture():
    known = {"default cloth": np.full(6, 10e-3), LABELS[0]: np.full(6, 8e-3)}
    away = known | {LABELS[0]: np.full(6, 10.0)}
    assert error_over_time._top(with_errors(known)) == pytest.approx(11.0)
    assert error_over_time._top(with_errors(away)) == pytest.approx(22.0)


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
def test_a_picture_of_each_motion_is_written(tmp_path, changes):
    runs = np.array([[1e-3, 2e-3, 3e-3, np.nan, np.nan, np.nan], np.full(6, 2e-3)])
    errors = {LABELS[0]: runs, LABELS[1]: np.full(6, 4e-3), "default cloth": 2 * runs[1:]}
    motions = [
        replace(with_errors(errors, **changes), evaluated_on=motion, fabric=fabric)
        for motion in ("fling", "folding")
        for fabric in ("denim", "knit")
    ]
    (tmp_path / "figures").mkdir()
    over_time, sheets = opening.picture_sections(tmp_path, motions, looks_of(errors))
    assert len(over_time.figures) == 4
    assert len(sheets.figures) == (0 if changes.get("horizon") == 0 else 4)
    assert [caption.split(" (")[0] for _, caption in over_time.figures] == [
        "folding, denim", "folding, knit", "fling, denim", "fling, knit"
    ]  # fmt: skip
    for path, _ in (*over_time.figures, *sheets.figures):
        assert path.read_bytes().startswith(PNG)
    said = " ".join(over_time.paragraphs)
    assert ("no ensemble" in said) == (changes.get("horizon", 1) is None)


def test_a_configuration_has_one_colour_whatever_else_is_shown():
    looks = looks_of((*REFERENCES, *LABELS))
    assert looks["true fabric on cloth"].colour == INK and looks["default cloth"].colour == GREY
    assert len({look.colour for look in looks.values()}) == len(looks)
    assert looks == looks_of((*LABELS, *REFERENCES)) | looks
    assert looks_of(LABELS)[LABELS[1]] == looks[LABELS[1]]
    assert [looks[label].line for label in LABELS] == ["-", "--"]


def test_a_page_begins_with_pictures_then_skill_then_sentences(tmp_path):
    full.publish(tmp_path, made_up(), [made_up_comparison(labels=(*LABELS, *REFERENCES))])
    text = Page((tmp_path / "report.html").read_text()).text
    order = "Error over time", "Sheets at the frames", "1 at the floor", "Findings", "Settings"
    places = [text.index(words) for words in order]
    assert places == sorted(places)
    assert "Configurations are compared by the mean distance" in text
    written = {path.stem for path in (tmp_path / "tables").iterdir()}
    assert {"skill", "skill_needed", "surface"} <= written


def test_a_fabric_that_a_configuration_lacks_has_a_table_of_its_own(tmp_path):
    rows = made_up()
    first = rows[0].fabric
    lacking = next(row.configuration for row in rows if row.approach)
    assert lacking is not None
    rows = [row for row in rows if (row.fabric, row.configuration) != (first, lacking)]
    full.publish(tmp_path, rows, [made_up_comparison(labels=LABELS)])
    table = (tmp_path / "tables" / f"skill_{first}.md").read_text()
    assert f"Of {first} alone" in table and lacking.label not in table
    assert lacking.label in (tmp_path / "tables" / "skill.md").read_text()


def test_given_recordings_say_in_one_line_that_they_have_no_horizon(tmp_path):
    rows = [replace(row, floor=None, horizon=None, skill=None) for row in made_up()]
    shown = replace(made_up_comparison(labels=LABELS), floor=None, horizon=None)
    full.publish(tmp_path, rows, [shown])
    text = Page((tmp_path / "report.html").read_text()).text
    assert text.count("have neither floor nor horizon") == 1
    assert not (tmp_path / "tables" / "skill.md").exists()
