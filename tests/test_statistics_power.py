"""Statistics keep their promise in made-up studies of the sizes of the presets.

At most 6 % false findings at a nominal 5 %, and intervals of 90 % that hold the truth in 85 to 95 %
of cases, through the functions that make the report. The slow ones have as many studies as it takes
to tell 5 % from 8 %; the study's table of them is in `docs/results/statistics_power.csv`.
"""

import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def experiments(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(ROOT / "experiments"))


def measured(preset, words, ratio, studies, seed):
    driver = importlib.import_module("statistics_power")
    spread = driver.SPREADS[words]
    return driver.measure(driver.SIZES[preset], spread, ratio, studies, seed)


def test_the_sizes_are_those_of_the_presets_with_the_fabrics_that_are_compared():
    driver = importlib.import_module("statistics_power")
    sizes = {name: driver.size_of(name) for name in ("small", "paper")}
    assert (sizes["small"].fabrics, sizes["small"].repeats, sizes["small"].judged) == (2, 1, 2)
    assert (sizes["paper"].fabrics, sizes["paper"].repeats, sizes["paper"].judged) == (5, 40, 40)


def test_small_studies_find_no_more_than_chance_does():
    found = measured("small", "30 %", 1.0, 150, 1)
    assert found.any_false <= 0.06 and found.false <= 0.06, found
    assert 0.85 <= found.held <= 0.95 and 0.85 <= found.means_held <= 0.95, found
    assert 0.85 <= found.skills_held <= 0.95, found


def test_the_paper_s_size_tells_what_is_three_times_as_far():
    found = measured("paper", "15 %", 3.0, 8, 1)
    assert found.told > 0.6 and found.false <= 0.1, found


@pytest.mark.slow(group="study")
@pytest.mark.usefixtures("unchecked")  # checks of shapes take four fifths of the time
@pytest.mark.parametrize("words", ["15 %", "30 %", "15 %, between motions as much"])
@pytest.mark.parametrize(
    ("preset", "studies"), [("small", 2000), ("paper", 1000), ("paper, without folds", 1000)]
)
def test_studies_with_nothing_to_find(preset, studies, words):
    found = measured(preset, words, 1.0, studies, 10_000)
    assert found.any_false <= 0.06 and found.false <= 0.06, found
    assert 0.85 <= found.held <= 0.95 and 0.85 <= found.means_held <= 0.95, found
    assert 0.85 <= found.skills_held <= 0.95, found


@pytest.mark.slow(group="study")
@pytest.mark.usefixtures("unchecked")
def test_power_at_the_size_of_the_paper():
    told, alone = zip(
        *(measured("paper", "15 %", ratio, 150, 20_000)[3:5] for ratio in (1.2, 1.5, 3.0)),
        strict=True,
    )
    assert told[0] < told[1] < told[2] and told[2] > 0.8, (told, alone)
    assert alone[1] > 0.7 and alone[2] > 0.95, (told, alone)
