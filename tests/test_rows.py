"""Rows of a study: what is written is read back, damage is named, and what is undefined is not lost
in silence."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.study.configuration import Configuration
from r2s.study.rows import BASELINES, HEADER, Row, drop_undefined, read_rows, write_rows

names = st.one_of(
    st.text(max_size=8), st.sampled_from(['a,b"c', "two\nlines", "\r", "\r\n", " x ", "'", ""])
)
any_row = st.builds(
    Row,
    *([names] * 7),
    baseline=st.sampled_from(list(BASELINES)),
    metric=names,
    unit=names,
    value=st.floats(allow_nan=False),
    floor=st.none() | st.floats(allow_nan=False),
    horizon=st.none() | st.floats(allow_nan=False),
    skill=st.none() | st.floats(allow_nan=False),
)


def row(value, recording="towel_1", baseline="", metric="chamfer", on="fold", unit="m"):
    fabric = recording.split("_")[0]
    return Row(
        "gauss_newton", "xpbd", "lift", fabric, "1", recording, on, baseline, metric, unit, value
    )


@settings(max_examples=60, deadline=None)
@given(rows=st.lists(any_row, max_size=4))
def test_rows_are_read_back_as_written(tmp_path_factory, rows):
    path = tmp_path_factory.getbasetemp() / "results.csv"
    write_rows(path, rows)
    assert read_rows(path) == rows


def test_file_of_rows(tmp_path):
    path = tmp_path / "results.csv"
    write_rows(path, [row(np.float64(0.1)), row(math.nan)])
    lines = path.read_text().splitlines()
    assert lines[0] == (
        "approach,solver,estimated_from,fabric,repeat,recording,evaluated_on,baseline,metric,unit,value,"
        "floor,horizon,skill"
    )
    assert lines[1] == "gauss_newton,xpbd,lift,towel,1,towel_1,fold,,chamfer,m,0.1,,,"
    assert math.isnan(read_rows(path)[1].value)
    assert [entry.name for entry in tmp_path.iterdir()] == ["results.csv"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected the header"),
        ("approach,value\n", "expected the header"),
        (",".join(HEADER) + "\na,b\n", "line 2: expected 14 cells, found 2"),
        (",".join(HEADER) + "\na,b,c,d,e,f,g,,h,m,many,,,\n", "line 2: .*many"),
        (",".join(HEADER) + "\na,b,c,d,e,f,g,best,h,m,1.0,,,\n", "line 2: unknown baseline 'best'"),
    ],
)
def test_damaged_rows_are_refused(tmp_path, text, message):
    path = tmp_path / "damaged.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_rows(path)
    assert str(path) in str(caught.value)
    with pytest.raises(FileNotFoundError, match="nowhere.csv"):
        read_rows(tmp_path / "nowhere.csv")


def test_a_metric_without_a_value_is_not_a_run_that_diverged():
    rows = [
        replace(row(value, name), metric=metric)
        for name, values in {"well": (0.1, math.nan), "lost": (math.nan, math.nan)}.items()
        for metric, value in zip(("chamfer", "chamfer_cropped"), values, strict=True)
    ]
    kept, left_out = drop_undefined(rows)
    assert [(r.recording, r.metric) for r in kept] == [
        ("well", "chamfer"), ("lost", "chamfer"), ("lost", "chamfer_cropped")
    ]  # fmt: skip
    assert left_out == {"chamfer_cropped": 1}


def test_what_is_judged_before_a_horizon_does_not_hide_what_diverged_after_it():
    early = replace(row(0.1), metric="surface", horizon=0.5)
    lost = row(math.nan)
    assert drop_undefined([early, lost]) == ([early, lost], {})
    whole = replace(early, horizon=math.inf)  # all of the motion
    assert drop_undefined([whole, lost]) == ([whole], {"chamfer": 1})
    # what is looked at in every frame has no value because the run diverged in one that others skip
    judged = replace(lost, metric="surface", floor=1e-3)
    assert drop_undefined([whole, judged]) == ([whole, judged], {})


def test_a_row_counts_for_its_configuration_or_the_default_fabric():
    assert row(1.0).configuration == Configuration("gauss_newton", "xpbd", "lift")
    assert row(1.0, baseline="default").configuration == Configuration("", "xpbd", "")
    assert row(1.0, baseline="other_fabric").configuration is None
    with pytest.raises(ValueError, match="unknown baseline"):
        row(1.0, baseline="other fabric")
