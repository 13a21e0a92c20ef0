"""Error, floor and skill by approach: what tables say of made-up rows follows from the definitions,
and a run that diverged improves nothing."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import stats

from r2s.evaluation.horizon import CLEAR, skill
from r2s.study.configuration import REFERENCES, Configuration
from r2s.study.report import full
from r2s.study.report.figures import looks_of
from r2s.study.report.page import PNG
from r2s.study.report.skill_chart import skill_chart
from r2s.study.report.skill_table import (
    beyond_tables,
    learned_table,
    needed_table,
    skill_table,
    skill_words,
)
from r2s.study.rows import Row
from r2s.study.statistics.distances import in_common, means
from r2s.study.statistics.learned import learned
from r2s.study.statistics.result_array import result_array
from r2s.study.statistics.skills import deciding, draws, mean_floor, skills, with_floor

LIFTING = Configuration("diffcloud", "cloth", "lifting")
PINN = Configuration("pinn", "cloth", "stretching")
TRUE = Configuration(REFERENCES["true"], "cloth", "")
MIDDLE = Configuration(REFERENCES["middle"], "cloth", "")
DEFAULT = Configuration("", "cloth", "")
FABRICS = "denim", "knit", "satin"
FLOOR = {"denim": 1e-3, "knit": 2e-3, "satin": 3e-3}
DRAWS = (16e-3, 24e-3)
MIDDLES = 15e-3
METRIC = "surface"


def errors_of(configuration: Configuration, fabric: str, trial: int, repeat: int) -> float:
    """In metres, all different."""
    start = {LIFTING: 7, PINN: 13}[configuration]
    return 1e-3 * (start + FABRICS.index(fabric) + 0.5 * trial + 0.2 * repeat)


def _row(
    whose: Configuration, repeat: str, baseline: str, value: float, *, fabric: str, recording: str,
    motion: str, floor: float,
) -> Row:  # fmt: skip
    told = None if baseline == "default" else skill(value, sum(DRAWS) / len(DRAWS), floor)
    return Row(
        *whose,
        fabric=fabric,
        repeat=repeat,
        recording=recording,
        evaluated_on=motion,
        baseline=baseline,
        metric=METRIC,
        unit="m",
        value=value,
        floor=floor,
        horizon=3.0,
        skill=told,
    )


def made_up(fabrics: Sequence[str] = FABRICS, motion: str = "fling") -> list[Row]:
    """Two recordings of each fabric, judged by two estimates, the true fabric and two draws."""
    rows = []
    for fabric in fabrics:
        for trial in range(2):
            recording, floor = f"{motion}_{fabric}_{trial}", FLOOR[fabric]
            row = partial(_row, fabric=fabric, recording=recording, motion=motion, floor=floor)
            for each in (LIFTING, PINN):
                for repeat in range(2):
                    value = errors_of(each, fabric, trial, repeat)
                    rows.append(row(each, str(repeat), "", value))
            rows.append(row(DEFAULT, "", "true", 2 * floor))
            rows.append(row(DEFAULT, "", "middle", MIDDLES))
            rows += [row(DEFAULT, str(i), "default", value) for i, value in enumerate(DRAWS)]
    return rows


def diverged(rows: Sequence[Row], place: int) -> list[Row]:
    """With one run lost."""
    lost = replace(rows[place], value=math.nan, skill=-math.inf)
    return [lost if i == place else row for i, row in enumerate(rows)]


def line(table, label: str) -> dict[str, str]:
    (found,) = (row for row in table.rows if row[0] == label)
    return dict(zip(table.header, found, strict=True))


def test_numbers_are_those_of_the_definition():
    rows = with_floor(made_up(), METRIC)
    table = skill_table(rows, METRIC)
    assert table.header[1:] == ("fling: error [mm]", "fling: floor [mm]", "fling: skill")
    assert [each[0] for each in table.rows] == [
        "DIFFCLOUD cloth lifting", "PINN cloth stretching", "middle of the prior on cloth",
        "true fabric on cloth", "default cloth",
    ]  # fmt: skip
    default, own, found = np.mean(DRAWS), [], line(table, LIFTING.label)
    for fabric in FABRICS:
        errors = [errors_of(LIFTING, fabric, i, j) for i in range(2) for j in range(2)]
        own.append(np.mean([(default - e) / (default - FLOOR[fabric]) for e in errors]))
    told = skills(rows, "fling")[LIFTING]
    assert told.mean == pytest.approx(np.mean(own))
    assert found["fling: skill"].startswith(f"{np.mean(own):.2f} [")
    errors = [errors_of(LIFTING, f, i, j) for f in FABRICS for i in range(2) for j in range(2)]
    assert found["fling: error [mm]"].startswith(f"{1e3 * np.mean(errors):.1f} [")
    assert all(each[2] == "2.00" for each in table.rows)  # the floor's mean over fabrics
    true = np.mean([(default - 2 * f) / (default - f) for f in FLOOR.values()])
    assert line(table, TRUE.label)["fling: skill"].startswith(f"{true:.2f}")
    middle = np.mean([(default - MIDDLES) / (default - f) for f in FLOOR.values()])
    assert line(table, MIDDLE.label)["fling: skill"].startswith(f"{middle:.2f}")


def test_what_is_estimated_on_points_has_a_line_of_its_own_on_the_cloth():
    rows = made_up()
    moved = [replace(row, approach="diffcp") for row in rows if row.approach == "pinn"]
    on_cloth = [replace(row, baseline="on_cloth") for row in moved]
    table = skill_table(with_floor([*rows, *on_cloth], METRIC), METRIC)
    found = line(table, "DiffCP (found on points) cloth stretching")
    assert list(found.values())[1:] == list(line(table, PINN.label).values())[1:]


def test_the_interval_of_one_recording_and_repeat_is_students_over_fabrics():
    every = with_floor(made_up(), METRIC)
    rows = [row for row in every if row.recording.endswith("_0") and row.repeat in ("0", "")]
    found = skills(rows, "fling")[PINN]
    own = np.array([skill(errors_of(PINN, f, 0, 0), 20e-3, FLOOR[f]) for f in FABRICS])
    reach = stats.t.ppf(0.95, 2) * own.std(ddof=1) / math.sqrt(3)
    assert (found.low, found.high) == pytest.approx((own.mean() - reach, own.mean() + reach))
    whole = skills(every, "fling")[PINN]  # motions and repeats add what they have in common
    assert whole.high - whole.low != pytest.approx(2 * reach)


def test_the_default_has_skill_zero_and_shows_the_spread_of_its_draws():
    rows = with_floor(made_up(), METRIC)
    spread = draws(rows, "fling", DEFAULT)
    assert spread.errors == pytest.approx(DRAWS)
    worse = [np.mean([(20e-3 - d) / (20e-3 - f) for f in FLOOR.values()]) for d in DRAWS]
    assert spread.skills == pytest.approx(sorted(worse))
    found = line(skill_table(rows, METRIC), DEFAULT.label)
    assert found["fling: error [mm]"].endswith("draws 16.0 to 24.0")
    assert found["fling: skill"] == f"0; draws {min(worse):.2f} to {max(worse):.2f}"


def test_draws_of_unlike_fabrics_do_not_average_away():
    """Each fabric has draws of its own: which of them has which number says nothing."""
    turned = [
        replace(row, repeat=str(1 - int(row.repeat)))
        if row.baseline == "default" and row.fabric == FABRICS[0]
        else row
        for row in made_up()
    ]
    before, after = (
        draws(with_floor(rows, METRIC), "fling", DEFAULT) for rows in (made_up(), turned)
    )
    assert after.errors == pytest.approx(before.errors)
    assert after.skills == pytest.approx(before.skills)


@pytest.mark.parametrize("place", range(len(made_up())))
def test_a_run_that_diverged_improves_nothing(place):
    whole, lost = made_up(), diverged(made_up(), place)
    row = whole[place]
    whose = row.configuration or {"true": TRUE, "middle": MIDDLE}[row.baseline]
    before, after = with_floor(whole, METRIC), with_floor(lost, METRIC)
    first, second = (means(result_array(rows, METRIC)) for rows in (before, after))
    i = result_array(before, METRIC).configurations.index(whose)
    assert second.diverged[i] == 1 and math.isnan(second.mean[i])
    assert second.median[i] >= first.median[i]
    found = line(skill_table(after, METRIC), whose.label)
    assert "diverged" in found["fling: error [mm]"]
    if whose == DEFAULT:
        spread = draws(after, "fling", DEFAULT)
        assert spread.errors[1] == math.inf and spread.skills[0] == -math.inf
        assert math.isfinite(spread.skills[1])  # beside the mean of those that did not diverge
        return
    good, bad = (skills(rows, "fling")[whose] for rows in (before, after))
    assert bad.mean == -math.inf and bad.median <= good.median and math.isnan(bad.high)
    assert found["fling: skill"].startswith("-inf (1 of ")
    assert line(needed_table(after), whose.label)["fling"].endswith("diverged")
    others = [each for each in skills(before, "fling") if each != whose]
    for each in others:
        assert skill_words(skills(after, "fling")[each]) == skill_words(
            skills(before, "fling")[each]
        )


def test_recordings_that_tell_no_fabrics_apart_decide_nothing(tmp_path):
    """Of one fabric the floor is as large as the default's error: less error is no better one."""
    rows = made_up()
    alike = {row.recording for row in rows if row.fabric == "satin"}
    level = [
        replace(row, floor=19e-3, skill=None, value=1e-3 * row.value) if row.recording in alike
        else row for row in rows
    ]  # fmt: skip
    lost = level.index(next(row for row in level if row.recording in alike))
    for changed in (level, diverged(level, lost)):
        kept, untold = deciding(changed, METRIC)
        assert set(untold) == alike and not alike & {row.recording for row in kept}
        assert kept == [row for row in rows if row.recording not in alike]
    assert deciding(rows, METRIC) == (rows, [])
    without = [replace(row, floor=None, skill=None) for row in rows]  # of no ensemble
    assert deciding(without, METRIC) == (without, [])
    full.publish(tmp_path, level)
    found = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert f"Not these 2, which tell no fabrics apart: {', '.join(sorted(alike))}." in found


def test_what_is_learned_is_the_error_over_that_of_the_middle_of_the_prior():
    rows = with_floor(made_up(), METRIC)
    found, table = learned(rows, METRIC), learned_table(rows, METRIC)
    assert table is not None and table.header == ("configuration", "fling")
    assert set(found) == {LIFTING, PINN, TRUE}
    for whose in (LIFTING, PINN):
        logs = [
            np.mean(
                [
                    np.log(errors_of(whose, fabric, t, r) / MIDDLES)
                    for t in range(2)
                    for r in range(2)
                ]
            )
            for fabric in FABRICS
        ]
        (comparison,) = found[whose]["fling"].claim.comparisons
        assert comparison.ratio == pytest.approx(1 / np.exp(np.mean(logs)))
        own = line(table, whose.label)["fling"]
        assert own.startswith(f"{np.exp(np.mean(logs)):.2f} [")
        assert own.endswith(f"; {sum(log < 0 for log in logs)} of 3")
    assert found[LIFTING]["fling"].answer == "holds"  # 7 to 10 mm in each, for 15
    assert found[PINN]["fling"].answer == "cannot be told"  # 13 to 16


def test_an_estimate_that_is_as_good_as_the_middle_has_learned_nothing():
    """It may have skill all the same: the middle has."""
    alike = [
        replace(row, value=MIDDLES * (1 + 0.01 * i), skill=0.4)
        if row.approach == "diffcloud"
        else row
        for i, row in enumerate(made_up())
    ]
    rows = with_floor(alike, METRIC)
    assert learned(rows, METRIC)[LIFTING]["fling"].answer != "holds"
    assert skills(rows, "fling")[LIFTING].mean == pytest.approx(0.4)


def test_nothing_is_learned_where_runs_diverged_or_nothing_is_told():
    rows = made_up()
    own = next(i for i, row in enumerate(rows) if row.approach == "diffcloud")
    lost = with_floor(diverged(rows, own), METRIC)
    assert learned(lost, METRIC)[LIFTING]["fling"].answer == "cannot be told"
    table = learned_table(lost, METRIC)
    assert table is not None and line(table, LIFTING.label)["fling"].endswith("diverged: 1 and 0")
    untold = [replace(row, skill=None) for row in rows]
    assert learned_table(with_floor(untold, METRIC), METRIC) is None
    without = [row for row in rows if row.baseline != "middle"]
    assert learned_table(with_floor(without, METRIC), METRIC) is None


def test_means_are_over_fabrics_that_every_configuration_has():
    rows = made_up()
    lacking = [r for r in rows if not (r.fabric == "satin" and r.approach == "pinn")]
    shared, others = in_common(lacking)
    assert {row.fabric for row in shared} == {"denim", "knit"} and set(others) == {"satin"}
    assert len(shared) + len(others["satin"]) == len(lacking)
    assert in_common(rows) == (rows, {})
    apart = [r for r in lacking if r.fabric == "satin" or r.approach != "diffcloud"]
    assert in_common(apart) == (apart, {})  # no fabric has both


def test_what_is_not_told_is_said():
    default = sum(DRAWS) / len(DRAWS)
    clear, near = 0.99 * default / CLEAR, 1.01 * default / CLEAR
    rows = made_up()
    told = [replace(r, skill=None) if r.fabric == "satin" else r for r in rows]
    part = skill_words(skills(with_floor(told, METRIC), "fling")[PINN])
    assert part.endswith("told in 4 of 6")
    nothing = [replace(row, skill=None, floor=near) for row in rows]
    found = skill_table(with_floor(nothing, METRIC), METRIC)
    assert {each[3] for each in found.rows} == {"not told"}
    assert math.isnan(skill(1e-3, default, near)) and skill(1e-3, default, clear) > 0
    assert {each[1] for each in needed_table(with_floor(nothing, METRIC)).rows} == {"not told"}


def test_one_fabric_has_no_interval():
    rows = with_floor(made_up(FABRICS[:1]), METRIC)
    found = skills(rows, "fling")[PINN]
    assert math.isnan(found.low) and "[" not in skill_words(found)
    assert "two fabrics or more" in line(needed_table(rows), PINN.label)["fling"]
    assert mean_floor(rows, "fling", PINN) == FLOOR["denim"]


def test_fewer_fabrics_are_needed_for_a_larger_skill():
    rows = with_floor(made_up(), METRIC)
    best, worse = (skills(rows, "fling")[each].needed for each in (LIFTING, PINN))
    assert best[1] <= best[0] <= best[2] and best[0] <= worse[0]


def test_motions_without_rows_have_no_column_and_rows_without_floor_do_not_count():
    rows = made_up() + made_up(FABRICS[:2], "shaking")
    without = [replace(row, floor=None, recording="other") for row in made_up(FABRICS[:1])]
    table = skill_table(with_floor(rows + without, METRIC), METRIC)
    assert [name.split(":")[0] for name in table.header[1:]] == 3 * ["fling"] + 3 * ["shaking"]
    assert table.rows == skill_table(with_floor(rows, METRIC), METRIC).rows
    assert with_floor(without, METRIC) == []


def test_beyond_the_horizon_what_diverged_has_no_mean():
    rows = [replace(row, metric="beyond sag", floor=None, skill=None) for row in made_up()]
    rows += [replace(row, metric="beyond speed", unit="m/s") for row in rows]
    (table,) = beyond_tables(rows, "beyond ").values()
    assert table.header == ("configuration", "sag [mm]", "speed [m/s]")
    assert {each[0] for each in table.rows} >= {LIFTING.label, TRUE.label, DEFAULT.label}
    expected = 1e3 * np.mean([errors_of(PINN, f, i, j) for f in FABRICS for i in (0, 1)
                              for j in (0, 1)])  # fmt: skip
    assert line(table, PINN.label)["sag [mm]"].startswith(f"{expected:.1f} [")
    lost = beyond_tables(diverged(rows, 0), "beyond ")["beyond_fling"]
    assert "1 of 12 diverged" in line(lost, LIFTING.label)["sag [mm]"]


def test_a_chart_of_skills_is_written_whatever_diverged(tmp_path):
    rows = with_floor(diverged(made_up(), 0), METRIC)
    looks = looks_of(each.label for each in skills(rows, "fling"))
    path = skill_chart(tmp_path / "skill.png", {"fling": skills(rows, "fling")}, looks)
    assert path.read_bytes().startswith(PNG)
