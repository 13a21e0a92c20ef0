"""The table of results, and error, floor and skill from it: by their definitions, and so that a run
that diverged improves nothing."""

import math
from functools import partial

import numpy as np
import pandas as pd
import pytest
from made_up_study import made_up_results
from scipy import stats

from r2s.metrics.horizon import CLEAR, skill
from r2s.study import report as tables
from r2s.study import results as frame
from r2s.study.conclusions import learned
from r2s.study.configuration import PAPER_CONFIGURATIONS, REFERENCES, Configuration
from r2s.study.results import as_frame, labelled, means, skills, undecided, with_floor, with_skill

LIFTING = Configuration("diffcloud", "cloth", "lifting")
PINN = Configuration("pinn", "cloth", "stretching")
NOBODY = Configuration("", "cloth", "")
TRUE, MIDDLE = (f"{REFERENCES[name]} cloth" for name in ("true", "middle"))
DEFAULT = "default cloth"
FABRICS = "denim", "knit", "satin"
FLOOR = {"denim": 1e-3, "knit": 2e-3, "satin": 3e-3}
DRAWS = (16e-3, 24e-3)
MIDDLES, METRIC = 15e-3, "surface"


def row(value, baseline="", whose=LIFTING, repeat="0", **more):
    """A row of results, of a fold of a knit unless `more` says otherwise."""
    place = {"fabric": "knit", "repeat": repeat, "recording": "knit_1", "evaluated_on": "folding"}
    metric = {"baseline": baseline, "metric": METRIC, "unit": "m", "value": value}
    return whose._asdict() | place | metric | more


def test_results_are_read_back_as_written(tmp_path):
    path = tmp_path / "results.csv"
    values = (0.1 + 0.2, 1e-300, math.nan, math.inf)
    rows = [row(v, recording=f'a, "{i}"\nb', skill=-math.inf) for i, v in enumerate(values)]
    written = as_frame([*rows, row(1 / 3, floor=2e-3, horizon=math.inf)])
    written.to_csv(path, index=False)
    read = pd.read_csv(path)
    for name in ("value", "floor", "horizon", "skill"):
        np.testing.assert_array_equal(read[name], written[name])
    assert list(read.recording) == list(written.recording)
    assert path.read_text().splitlines()[0] == (
        "approach,solver,estimated_from,fabric,repeat,recording,evaluated_on,baseline,metric,unit,"
        "value,floor,horizon,skill"
    )
    assert [entry.name for entry in tmp_path.iterdir()] == ["results.csv"]


@pytest.mark.parametrize(
    ("rows", "kept"),
    [
        ([("chamfer", 0.1, {}), ("cropped", math.nan, {})], ["chamfer"]),
        ([("chamfer", math.nan, {}), ("cropped", math.nan, {})], ["chamfer", "cropped"]),
        # a value before a horizon does not hide that the run diverged after it
        ([("surface", 0.1, {"horizon": 0.5}), ("chamfer", math.nan, {})], ["surface", "chamfer"]),
        ([("surface", 0.1, {"horizon": math.inf}), ("chamfer", math.nan, {})], ["surface"]),
        # a distance beside a floor depends on every frame: without a value the run diverged
        ([("chamfer", 0.1, {}), ("surface", math.nan, {"floor": 1e-3})], ["chamfer", "surface"]),
    ],
)
def test_a_metric_without_a_value_is_not_a_run_that_diverged(rows, kept):
    table = as_frame([row(value, metric=metric, **more) for metric, value, more in rows])
    assert list(frame.without_undefined(table).metric) == kept


def test_means_are_over_fabrics_that_every_configuration_has():
    results = made_up_results(configurations=PAPER_CONFIGURATIONS[:2])
    lacking = results[(results.fabric != "pink_solid") | (results.estimated_from != "wind")]
    assert frame.fabrics_in_common(lacking) == ["black_denim", "grey_interlock"]
    assert len(frame.fabrics_in_common(results)) == 3
    apart = lacking[(lacking.fabric == "pink_solid") | (lacking.estimated_from != "lifting")]
    assert len(frame.fabrics_in_common(apart)) == 3  # no fabric has both: all count


def errors_of(configuration: Configuration, fabric: str, trial: int, repeat: int) -> float:
    """In metres, all different."""
    start = {LIFTING: 7, PINN: 13}[configuration]
    return 1e-3 * (start + FABRICS.index(fabric) + 0.5 * trial + 0.2 * repeat)


def made_up(fabrics=FABRICS, motion="fling") -> list[dict]:
    """Two recordings of each fabric, and on them two estimates, the references and two draws."""
    rows = []
    for fabric in fabrics:
        for trial in range(2):
            place = {"fabric": fabric, "recording": f"{motion}_{fabric}_{trial}"}
            of = partial(row, evaluated_on=motion, floor=FLOOR[fabric], horizon=3.0, **place)
            for whose in (LIFTING, PINN):
                for repeat in range(2):
                    error = errors_of(whose, fabric, trial, repeat)
                    rows.append(of(error, whose=whose, repeat=str(repeat)))
            rows.append(of(2 * FLOOR[fabric], "true", NOBODY, ""))
            rows.append(of(MIDDLES, "middle", NOBODY, ""))
            rows += [of(value, "default", NOBODY, str(i)) for i, value in enumerate(DRAWS)]
    return rows


def analysed(rows: list[dict]) -> pd.DataFrame:
    return labelled(with_skill(as_frame(rows), METRIC))


def known(rows: list[dict]) -> pd.DataFrame:
    return with_floor(analysed(rows), METRIC)


def diverged(rows: list[dict], place: int) -> list[dict]:
    """With one run that diverged."""
    return [row | {"value": math.nan} if i == place else row for i, row in enumerate(rows)]


def test_numbers_are_those_of_the_definition():
    found, default = skills(known(made_up())), np.mean(DRAWS)
    cells = [(fabric, i, j) for fabric in FABRICS for i in range(2) for j in range(2)]
    errors = [errors_of(LIFTING, *cell) for cell in cells]
    own = [(default - e) / (default - FLOOR[f]) for e, (f, *_) in zip(errors, cells, strict=True)]
    expected = {
        LIFTING.label: np.mean(own),
        TRUE: np.mean([(default - 2 * f) / (default - f) for f in FLOOR.values()]),
        MIDDLE: np.mean([(default - MIDDLES) / (default - f) for f in FLOOR.values()]),
    }
    for label, value in expected.items():
        assert found.loc[(label, "fling"), "mean"] == pytest.approx(value)
    assert found.floor.to_numpy() == pytest.approx(2e-3)
    table = means(known(made_up()))
    assert table.loc[(LIFTING.label, "fling"), "mean"] == pytest.approx(np.mean(errors))
    shown = tables.skill_table(table, found)
    assert list(shown.columns[1:]) == ["fling: error [mm]", "fling: floor [mm]", "fling: skill"]
    assert list(shown.configuration) == [LIFTING.label, PINN.label, MIDDLE, TRUE, DEFAULT]
    assert shown["fling: skill"][0].startswith(f"{np.mean(own):.2f} [")


def test_the_default_of_a_skill_is_the_mean_of_the_draws_that_did_not_diverge():
    of = partial(row, floor=2e-3)
    own = [of(7e-3), of(2e-3, "true", NOBODY, ""), of(math.nan, repeat="1")]
    drawn = [of(value, "default", NOBODY, str(i)) for i, value in enumerate((10e-3, 14e-3))]
    gone = of(math.nan, "default", NOBODY, "2")

    def skills_of(rows):
        return with_skill(as_frame(rows), METRIC).skill.tolist()

    for rows in ([*own, *drawn], [*own, *drawn, gone]):
        assert skills_of(rows)[:3] == [pytest.approx(0.5), pytest.approx(1), -math.inf]
        assert np.isnan(skills_of(rows)[3:]).all()
    assert np.isnan(skills_of([*own[:2], gone])).all()  # all draws diverged
    assert np.isnan(skills_of(own)).all()  # no default
    near = [draw | {"value": 2.5e-3} for draw in drawn]
    assert math.isnan(skills_of([*own, *near])[0])  # not clearly above the floor
    without = [each | {"floor": math.nan} for each in (*own, *drawn)]
    assert np.isnan(skills_of(without)).all()


def test_the_interval_of_one_recording_and_repeat_is_students_over_fabrics():
    rows = [r for r in made_up() if r["recording"].endswith("_0")]
    alone = known([r for r in rows if r["baseline"] == "default" or r["repeat"] in ("0", "")])
    found = skills(alone).loc[(PINN.label, "fling")]
    own = np.array([skill(errors_of(PINN, f, 0, 0), 20e-3, FLOOR[f]) for f in FABRICS])
    reach = stats.t.ppf(0.95, 2) * own.std(ddof=1) / math.sqrt(3)
    assert (found.low, found.high) == pytest.approx((own.mean() - reach, own.mean() + reach))
    whole = skills(known(made_up())).loc[(PINN.label, "fling")]
    assert whole.high - whole.low != pytest.approx(2 * reach)  # motions and repeats add to it


@pytest.mark.parametrize("place", [0, 3, 4, 5, 6, 21])
def test_a_run_that_diverged_improves_nothing(place):
    before, after = known(made_up()), known(diverged(made_up(), place))
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
    first = next(i for i, r in enumerate(level) if r["fabric"] == "satin")
    for rows in (level, diverged(level, first)):
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
        assert found.answer[LIFTING.label] == "holds"  # 7 to 10 mm in each, for 15
    assert found.answer[PINN.label] == "undecided"  # 13 to 16


def test_nothing_is_learned_where_runs_diverged_or_no_skill_is_known():
    found = learned(analysed(diverged(made_up(), 0)), METRIC).set_index("conclusion")
    assert found.answer[LIFTING.label] == "undecided"
    assert found.diverged_smaller[LIFTING.label] == 1
    without = [r for r in made_up() if r["baseline"] != "middle"]
    assert learned(analysed(without), METRIC).empty
    unknown = [r | {"floor": 1.01 * np.mean(DRAWS) / CLEAR} for r in made_up()]
    assert learned(analysed(unknown), METRIC).empty
    shown = tables.skill_table(means(known(unknown)), skills(known(unknown)))
    assert set(shown["fling: skill"][:-1]) == {"not known"}
