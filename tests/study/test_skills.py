"""Error, floor and skill by configuration follow from the definitions, and a run that diverged
improves nothing."""

import math
from functools import partial

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from r2s.metrics.horizon import CLEAR, skill
from r2s.study.configuration import REFERENCES, Configuration
from r2s.study.report import tables
from r2s.study.statistics.comparisons import learned
from r2s.study.statistics.frame import (
    as_frame,
    labelled,
    means,
    skills,
    undecided,
    with_floor,
    with_skill,
)

LIFTING = Configuration("diffcloud", "cloth", "lifting")
PINN = Configuration("pinn", "cloth", "stretching")
TRUE, MIDDLE = (f"{REFERENCES[name]} cloth" for name in ("true", "middle"))
DEFAULT = "default cloth"
FABRICS = "denim", "knit", "satin"
FLOOR = {"denim": 1e-3, "knit": 2e-3, "satin": 3e-3}
DRAWS = (16e-3, 24e-3)
MIDDLES, METRIC = 15e-3, "surface"


def errors_of(configuration: Configuration, fabric: str, trial: int, repeat: int) -> float:
    """In metres, all different."""
    start = {LIFTING: 7, PINN: 13}[configuration]
    return 1e-3 * (start + FABRICS.index(fabric) + 0.5 * trial + 0.2 * repeat)


def _row(whose, repeat, baseline, value, *, fabric, recording, motion):
    keys = dict(zip(("approach", "solver", "estimated_from"), whose, strict=True))
    place = {"fabric": fabric, "repeat": repeat, "recording": recording, "evaluated_on": motion}
    judged = {"baseline": baseline, "metric": METRIC, "unit": "m", "value": value}
    return keys | place | judged | {"floor": FLOOR[fabric], "horizon": 3.0}


def made_up(fabrics=FABRICS, motion="fling") -> list[dict]:
    """Two recordings of each fabric, judged by two estimates, the true fabric and two draws."""
    rows, nobody = [], ("", "cloth", "")
    for fabric in fabrics:
        for trial in range(2):
            recording = f"{motion}_{fabric}_{trial}"
            row = partial(_row, fabric=fabric, recording=recording, motion=motion)
            for each in (LIFTING, PINN):
                for repeat in range(2):
                    rows.append(row(each, str(repeat), "", errors_of(each, fabric, trial, repeat)))
            rows.append(row(nobody, "", "true", 2 * FLOOR[fabric]))
            rows.append(row(nobody, "", "middle", MIDDLES))
            rows += [row(nobody, str(i), "default", value) for i, value in enumerate(DRAWS)]
    return rows


def analysed(rows: list[dict]) -> pd.DataFrame:
    return labelled(with_skill(as_frame(rows), METRIC))


def known(rows: list[dict]) -> pd.DataFrame:
    return with_floor(analysed(rows), METRIC)


def lost(rows: list[dict], place: int) -> list[dict]:
    """With one run that diverged."""
    return [row | {"value": math.nan} if i == place else row for i, row in enumerate(rows)]


def test_numbers_are_those_of_the_definition():
    found, default = skills(known(made_up())), np.mean(DRAWS)
    own = [
        np.mean([(default - errors_of(LIFTING, fabric, i, j)) / (default - FLOOR[fabric])
                 for i in range(2) for j in range(2)])
        for fabric in FABRICS
    ]  # fmt: skip
    assert found.loc[(LIFTING.label, "fling"), "mean"] == pytest.approx(np.mean(own))
    true = np.mean([(default - 2 * f) / (default - f) for f in FLOOR.values()])
    assert found.loc[(TRUE, "fling"), "mean"] == pytest.approx(true)
    middle = np.mean([(default - MIDDLES) / (default - f) for f in FLOOR.values()])
    assert found.loc[(MIDDLE, "fling"), "mean"] == pytest.approx(middle)
    assert found.floor.to_numpy() == pytest.approx(2e-3)
    errors = [errors_of(LIFTING, f, i, j) for f in FABRICS for i in range(2) for j in range(2)]
    table = means(known(made_up()))
    assert table.loc[(LIFTING.label, "fling"), "mean"] == pytest.approx(np.mean(errors))
    shown = tables.skill_table(table, found)
    assert list(shown.columns[1:]) == ["fling: error [mm]", "fling: floor [mm]", "fling: skill"]
    assert list(shown.configuration) == [LIFTING.label, PINN.label, MIDDLE, TRUE, DEFAULT]
    assert shown["fling: skill"][0].startswith(f"{np.mean(own):.2f} [")


def test_the_default_of_a_skill_is_the_mean_of_the_draws_that_did_not_diverge():
    row = partial(_row, fabric="knit", recording="fling_0", motion="fling")
    whose, nobody = ("diffcloud", "cloth", "lifting"), ("", "cloth", "")
    own = [row(whose, "0", "", 7e-3), row(nobody, "", "true", 2e-3), row(whose, "1", "", math.nan)]
    drawn = [row(nobody, str(i), "default", value) for i, value in enumerate((10e-3, 14e-3))]

    def told(rows):
        return with_skill(as_frame(rows), METRIC).skill.tolist()

    assert told([*own, *drawn])[:3] == [pytest.approx(0.5), pytest.approx(1), -math.inf]
    assert np.isnan(told([*own, *drawn])[3:]).all()
    gone = row(nobody, "2", "default", math.nan)
    assert told([*own, *drawn, gone])[:3] == [pytest.approx(0.5), pytest.approx(1), -math.inf]
    assert np.isnan(told([*own[:2], gone])).all()  # all draws diverged
    assert np.isnan(told(own)).all()  # no default
    near = [each | {"value": 2.5e-3} for each in drawn]
    assert math.isnan(told([*own, *near])[0])  # not clearly above the floor
    without = [each | {"floor": math.nan} for each in (*own, *drawn)]
    assert np.isnan(told(without)).all()


def test_the_interval_of_one_recording_and_repeat_is_students_over_fabrics():
    rows = [r for r in made_up() if r["recording"].endswith("_0")]
    alone = known([r for r in rows if r["baseline"] == "default" or r["repeat"] in ("0", "")])
    found = skills(alone).loc[(PINN.label, "fling")]
    own = np.array([skill(errors_of(PINN, f, 0, 0), 20e-3, FLOOR[f]) for f in FABRICS])
    reach = stats.t.ppf(0.95, 2) * own.std(ddof=1) / math.sqrt(3)
    assert (found.low, found.high) == pytest.approx((own.mean() - reach, own.mean() + reach))
    whole = skills(known(made_up())).loc[(PINN.label, "fling")]
    assert whole.high - whole.low != pytest.approx(2 * reach)  # motions and repeats add to it


@pytest.mark.parametrize("place", range(len(made_up())))
def test_a_run_that_diverged_improves_nothing(place):
    before, after = known(made_up()), known(lost(made_up(), place))
    whose = before.configuration.iloc[place], "fling"
    first, second = means(before).loc[whose], means(after).loc[whose]
    assert second.diverged == 1 and second["mean"] == math.inf
    assert second["median"] >= first["median"]
    shown = tables.skill_table(means(after), skills(after)).set_index("configuration")
    assert "diverged" in shown.loc[whose[0], "fling: error [mm]"]
    if whose[0] == DEFAULT:
        return
    good, bad = skills(before).loc[whose], skills(after).loc[whose]
    assert bad["mean"] == -math.inf and math.isnan(bad.high) and bad["median"] <= good["median"]
    others = [label for label, _ in skills(before).index if label != whose[0]]
    pd.testing.assert_frame_equal(skills(before).loc[others], skills(after).loc[others])


def test_recordings_that_do_not_discriminate_decide_nothing():
    """Of one fabric the floor is as large as the default's error: less error is no better one."""
    level = [r | {"floor": 19e-3} if r["fabric"] == "satin" else r for r in made_up()]
    alike = sorted({r["recording"] for r in made_up() if r["fabric"] == "satin"})
    one = next(i for i, r in enumerate(level) if r["fabric"] == "satin")
    for rows in (level, lost(level, one)):
        assert undecided(analysed(rows), METRIC) == alike
    assert undecided(analysed(made_up()), METRIC) == []
    without = [r | {"floor": math.nan} for r in made_up()]  # of no ensemble
    assert undecided(analysed(without), METRIC) == [] and known(without).empty


def test_what_is_learned_is_the_error_over_that_of_the_middle_of_the_prior():
    found = learned(analysed(made_up()), METRIC).set_index("conclusion")
    assert list(found.index) == [LIFTING.label, PINN.label, TRUE]
    for whose in (LIFTING, PINN):
        logs = np.array([
            np.mean([np.log(MIDDLES / errors_of(whose, f, t, r)) for t in (0, 1) for r in (0, 1)])
            for f in FABRICS
        ])  # fmt: skip
        assert found.ratio[whose.label] == pytest.approx(np.exp(logs.mean()))
        assert found.agreeing[whose.label] == (logs > 0).sum()
    assert found.answer[LIFTING.label] == "holds"  # 7 to 10 mm in each, for 15
    assert found.answer[PINN.label] == "undecided"  # 13 to 16


def test_nothing_is_learned_where_runs_diverged_or_no_skill_is_known():
    found = learned(analysed(lost(made_up(), 0)), METRIC).set_index("conclusion")
    assert found.answer[LIFTING.label] == "undecided"
    assert found.diverged_smaller[LIFTING.label] == 1
    without = [r for r in made_up() if r["baseline"] != "middle"]
    assert learned(analysed(without), METRIC).empty
    unknown = [r | {"floor": 1.01 * np.mean(DRAWS) / CLEAR} for r in made_up()]
    assert learned(analysed(unknown), METRIC).empty
    shown = tables.skill_table(means(known(unknown)), skills(known(unknown)))
    assert set(shown["fling: skill"][:-1]) == {"not known"}
