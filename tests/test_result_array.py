"""The results of a study: what is compared, and how it is resampled."""

import math

import numpy as np
import pytest
from made_up_study import made_up_rows

from r2s.study.configuration import PAPER_CONFIGURATIONS, Configuration
from r2s.study.rows import Row
from r2s.study.statistics.distances import distance_table, means
from r2s.study.statistics.result_array import (
    configurations_of,
    mean_over_repeats,
    result_array,
    select,
)

LIFTING = PAPER_CONFIGURATIONS[0]


def row(
    value, repeat="1", recording="fling_denim1", on="fling", baseline="", configuration=LIFTING
):
    return Row(*configuration, "denim", repeat, recording, on, baseline, "chamfer", "m", value)


def test_configurations_are_named_and_in_the_order_of_the_paper():
    rows = made_up_rows(
        configurations=[Configuration("new", "cloth", "wind"), *reversed(PAPER_CONFIGURATIONS)]
    )
    found = configurations_of(rows)
    assert found == (
        *PAPER_CONFIGURATIONS,
        Configuration("new", "cloth", "wind"),
        Configuration("", "cloth", ""),
    )
    assert [c.label for c in (*found[:3], *found[-2:])] == [
        "DIFFCLOUD cloth lifting",
        "DIFFCLOUD cloth wind",
        "DiffCP points lifting",
        "new cloth wind",
        "default cloth",
    ]


def test_what_diverged_is_neither_absent_nor_averaged():
    rows = [row(0.1), row(math.nan, "2"), row(0.3, recording="fling_denim2")]
    results = result_array(rows, "chamfer")
    assert results.present.tolist() == [[[True, True], [True, False]]]
    np.testing.assert_array_equal(mean_over_repeats(results), [[np.inf, 0.3]])
    np.testing.assert_array_equal(mean_over_repeats(results, diverged=np.nan), [[0.1, 0.3]])
    found = means(results)
    assert math.isnan(found.mean[0]) and found.diverged[0] == 1 and found.runs[0] == 3
    assert found.median[0] == 0.3  # what diverged is larger than both others


def test_other_baselines_and_motions_are_left_out():
    rows = [row(0.1), row(0.2, on="lifting"), row(0.3, baseline="other_fabric")]
    assert result_array(rows, "chamfer").values.tolist() == [[[0.1]]]
    assert result_array(rows, "chamfer", own=True).values.tolist() == [[[0.2]]]
    assert result_array(rows, "hausdorff").values.shape == (0, 0, 0)
    part = select(result_array(rows, "chamfer"), lambda c: c.solver == "points")
    assert part.values.shape == (0, 1, 1)


def test_two_values_of_one_place_and_two_units_are_refused():
    with pytest.raises(ValueError, match="chamfer of DIFFCLOUD cloth lifting, repeat 1, on fling"):
        result_array([row(0.1), row(0.1)], "chamfer")
    other = Row(*LIFTING, "denim", "2", "fling_denim1", "fling", "", "chamfer", "mm", 1.0)
    with pytest.raises(ValueError, match="several units"):
        result_array([row(0.1), other], "chamfer")


def test_table_of_distances():
    rows = made_up_rows(configurations=PAPER_CONFIGURATIONS[:2], repeats=2, trials=2)
    rows += [
        row(0.0123, on="lifting"),
        row(0.5, configuration=PAPER_CONFIGURATIONS[2], recording="fling_x"),
    ]
    rows += [row(math.nan, configuration=PAPER_CONFIGURATIONS[3], recording="fling_x")]
    rows += [row(0.07, baseline="other_fabric"), row(0.08, baseline="repeatability")]
    table = distance_table(rows, "chamfer")
    assert table.header == (
        "configuration",
        "folding [mm]",
        "fling [mm]",
        "shaking [mm]",
        "own [mm]",
    )
    cells = {line[0]: line[1:] for line in table.rows}
    assert cells["DIFFCLOUD cloth lifting"][3] == "12.3"  # one value has no interval
    assert cells["DiffCP points lifting"] == ("-", "500.0", "-", "-")
    assert cells["PhysNet cloth lifting"][1] == "diverged"
    assert cells["DIFFCLOUD (of another fabric) cloth lifting"][1] == "70.0"
    assert "another trial cloth lifting" in cells
    mean, low, high = (float(x.strip("[],")) for x in cells["default cloth"][0].split())
    assert low < mean < high and abs(mean - 40) < 4
