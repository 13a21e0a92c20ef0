"""Searches arrive: on thirty recordings of known sheets no estimate fits worse than the truth.

`experiments/arrival.py` makes the recordings and the table in `docs/results/arrival.csv`.
"""

import importlib
import re

import numpy as np
import pytest
from folders import ROOT

TABLE = ROOT / "docs" / "results" / "arrival.csv"
FOLDER = ROOT / "results" / "arrival"
NUMBERS = ("warp", "weft", "shear", "coupling", "bending", "damping", "friction")
ENOUGH = 1.02  # of the loss of the true numbers


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(ROOT / "experiments"))
    return importlib.import_module


def cases() -> list[str]:
    text = (ROOT / "experiments" / "_arrival.py").read_text(encoding="utf-8")
    return re.findall(r'^    "((?:lift|wind|pull) [a-z0-9 ]+)": ', text, re.MULTILINE)


def arrives(line: dict[str, str]) -> bool:
    """Whether the end fits as well as the true numbers, or the estimate is not sure of it."""
    fits = float(line["loss of end"]) <= ENOUGH * float(line["loss of true"])
    return fits or line["converged"] != "yes"


def leaves_in(line: dict[str, str]) -> bool:
    """Whether at most 1 % are left out, or nobody could say so: the true numbers leave out more."""
    is_told = float(line["% beyond 3 mm of true"]) <= 1
    return not is_told or float(line["left out"].removesuffix(" %")) <= 1


@pytest.mark.slow(group="arrival")
@pytest.mark.parametrize("case", cases())
def test_an_estimate_fits_no_worse_than_the_true_numbers(case, module) -> None:
    pytest.importorskip("mujoco", reason="needs r2s[mujoco]")
    line = module("_arrival").arrived(FOLDER, case, "0")
    assert arrives(line), line
    assert leaves_in(line), line
    assert float(line["loss of end"]) < float(line["loss of prior"])


@pytest.mark.skipif(not TABLE.exists(), reason="no table: python experiments/arrival.py")
def test_of_thirty_searches_all_but_one_arrive(module) -> None:
    """As they were last measured."""
    lines, _ = module("_tables").read(TABLE)
    assert {line["case"] for line in lines} == set(cases()) and len(lines) == 30
    ends, true = (
        np.array([float(line[f"loss of {at}"]) for line in lines]) for at in ("end", "true")
    )
    assert np.sum(ends <= ENOUGH * true) >= 29
    assert all(map(arrives, lines))
    errors = np.array([[float(line[name].split()[0]) for name in NUMBERS] for line in lines])
    assert 0.8 <= np.mean(np.abs(errors) < 1.645) <= 0.97
