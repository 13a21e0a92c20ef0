"""The table of results: written to the last bit, and what counts for what."""

import math

import numpy as np
import pandas as pd
from made_up_study import made_up_results

from r2s.study.configuration import PAPER_CONFIGURATIONS
from r2s.study.statistics import frame
from r2s.study.statistics.frame import as_frame, write_results


def row(value, recording="towel_1", baseline="", metric="chamfer", repeat="1", **more):
    whose = {"approach": "new", "solver": "cloth", "estimated_from": "lifting"}
    place = {"fabric": recording.split("_")[0], "repeat": repeat, "recording": recording}
    judged = {"evaluated_on": "folding", "baseline": baseline, "metric": metric, "unit": "m"}
    return whose | place | judged | {"value": value} | more


def test_results_are_read_back_as_written(tmp_path):
    path = tmp_path / "results.csv"
    values = (0.1 + 0.2, 1e-300, math.nan, math.inf)
    rows = [row(value, f'a, "{i}"\nb', skill=-math.inf) for i, value in enumerate(values)]
    written = as_frame([*rows, row(1 / 3, floor=2e-3, horizon=math.inf)])
    write_results(path, written)
    read = pd.read_csv(path)
    for name in ("value", "floor", "horizon", "skill"):
        np.testing.assert_array_equal(read[name], written[name])
    assert list(read.recording) == list(written.recording)
    assert path.read_text().splitlines()[0] == (
        "approach,solver,estimated_from,fabric,repeat,recording,evaluated_on,baseline,metric,unit,"
        "value,floor,horizon,skill"
    )
    assert [entry.name for entry in tmp_path.iterdir()] == ["results.csv"]


def test_a_metric_without_a_value_is_not_a_run_that_diverged():
    rows = [
        row(value, name, metric=metric)
        for name, values in {"well": (0.1, math.nan), "lost": (math.nan, math.nan)}.items()
        for metric, value in zip(("chamfer", "chamfer_cropped"), values, strict=True)
    ]
    kept = frame.without_undefined(as_frame(rows))
    assert list(zip(kept.recording, kept.metric, strict=True)) == [
        ("well", "chamfer"), ("lost", "chamfer"), ("lost", "chamfer_cropped")
    ]  # fmt: skip


def test_what_is_judged_before_a_horizon_does_not_hide_what_diverged_after_it():
    def kept(*rows):
        return list(frame.without_undefined(as_frame(rows)).metric)

    lost, early = row(math.nan), row(0.1, metric="surface", horizon=0.5)
    assert kept(early, lost) == ["surface", "chamfer"]
    whole = early | {"horizon": math.inf}
    assert kept(whole, lost) == ["surface"]
    # a distance beside a floor is looked at in every frame: without a value the run diverged
    assert kept(row(0.1), row(math.nan, metric="surface", floor=1e-3)) == ["chamfer", "surface"]


def test_means_are_over_fabrics_that_every_configuration_has():
    results = made_up_results(configurations=PAPER_CONFIGURATIONS[:2])
    lacking = results[(results.fabric != "pink_solid") | (results.estimated_from != "wind")]
    assert frame.fabrics_in_common(lacking) == ["black_denim", "grey_interlock"]
    assert len(frame.fabrics_in_common(results)) == 3
    apart = lacking[(lacking.fabric == "pink_solid") | (lacking.estimated_from != "lifting")]
    assert len(frame.fabrics_in_common(apart)) == 3  # no fabric has both: all count
