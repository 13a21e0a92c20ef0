"""The drivers of experiments and benchmarks start, and keep what made their tables."""

import importlib
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from folders import ROOT

EXPERIMENTS = ROOT / "experiments"
DRIVERS = [*EXPERIMENTS.glob("[a-z]*.py"), *(ROOT / "benchmarks").glob("s*.py")]
LINES = [{"fabric": "denim", "error": "1.5 mm"}, {"fabric": "knit", "error": "-"}]


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch):
    """Import a module of the folder, as Python does for a driver that is run."""
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    return importlib.import_module


@pytest.fixture
def tables(module) -> ModuleType:
    return module("_tables")


@pytest.mark.slow(group="documents")
@pytest.mark.parametrize("driver", sorted(DRIVERS), ids=lambda path: path.stem)
def test_a_driver_starts(driver: Path) -> None:
    pytest.importorskip("psutil", reason="needs r2s[study]")
    command, here = [sys.executable, driver, "--help"], os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, env=here)
    assert done.returncode == 0, done.stderr[-2000:]


def test_a_table_says_what_made_it_and_is_read_back(tables, tmp_path: Path) -> None:
    path = tmp_path / "deep" / "table.csv"
    tables.write(path, LINES, "Errors.", {"machine": "a clock"})
    lines, facts = tables.read(path)
    assert lines == LINES
    assert {"command", "version", "date"} < set(facts)
    assert facts["table"] == "Errors." and facts["machine"] == "a clock"
    shown = tables.shown(path)
    assert "| denim | 1.5 mm |" in shown and "a clock" in shown


def test_a_table_goes_between_its_marks_or_is_refused(tables, tmp_path: Path) -> None:
    document = tmp_path / "guide.md"
    document.write_text("before\n<!-- one -->\nold\n<!-- end of one -->\nafter\n")
    tables.insert(document, "one", "new\n")
    expected = "before\n<!-- one -->\nnew\n<!-- end of one -->\nafter\n"
    assert document.read_text() == expected
    with pytest.raises(ValueError, match="end of two"):
        tables.insert(document, "two", "new\n")
    assert document.read_text() == expected


def test_jobs_that_are_done_are_not_done_again(tables, tmp_path: Path) -> None:
    made = []

    def make(fabric: str) -> dict[str, str]:
        made.append(fabric)
        return {"error": fabric.upper()}

    path, jobs = tmp_path / "runs.csv", [{"fabric": "denim"}, {"fabric": "knit"}]
    tables.resumed(path, "Errors.", jobs[:1], make)
    lines = tables.resumed(path, "Errors.", jobs, make)
    assert made == ["denim", "knit"]
    assert lines == tables.read(path)[0] == [job | {"error": job["fabric"].upper()} for job in jobs]
    for other in ({"version": "r2s 0.0.1"}, {"source": "0123456789abcdef"}):
        tables.write(path, lines, "Errors.", other)
        with pytest.raises(ValueError, match=f"begun by .*{next(iter(other.values()))}"):
            tables.resumed(path, "Errors.", jobs, make)


def test_a_folder_without_the_scenario_is_named(module, tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"format": "none"}')
    with pytest.raises(ValueError, match=str(tmp_path)):
        module("_real").recordings_in(tmp_path, "lift")


@pytest.mark.parametrize(
    "whose, tests",
    [
        ([("denim", "1")], ["prior"]),
        ([("denim", "1"), ("knit", "1")], ["prior", "other fabrics' lifts"]),
        ([("denim", "1"), ("denim", "2"), ("knit", "1")], None),
        ([("denim", "1"), ("denim", "2")], ["prior", "other trial"]),
    ],
    ids=["one", "one a fabric", "uneven", "one fabric"],
)
def test_folds_of_any_number_of_trials_are_compared(
    module, tables, tmp_path: Path, monkeypatch, whose, tests
) -> None:
    driver = module("real_recordings")

    def recording(kind: str, fabric: str, trial: str) -> SimpleNamespace:
        name = f"{kind}_{fabric}_{trial}"
        info = SimpleNamespace(name=name, scenario=kind, fabric=fabric, trial=trial)
        return SimpleNamespace(info=info)

    clouds = [np.zeros((2, 3))]
    replaced = {
        "recordings_in": lambda folder, kind: [recording(kind, *each) for each in whose],
        "estimated": lambda *_: SimpleNamespace(fabric=None, nuisances=()),
        "frames_of": lambda fold: range(1),
        "cloud": lambda *_: clouds[0],
        "errors": lambda real, others: (1.0 * len(others), 0.5),
    }
    for name, value in replaced.items():
        monkeypatch.setattr(driver, name, value)
    monkeypatch.setattr(module("_real"), "observed_of", lambda *_: clouds)
    options = SimpleNamespace(
        shape=(3, 3), recordings=tmp_path, kept=tmp_path, lifts_alone=False, out=tmp_path / "a.csv"
    )
    driver.predict_folds(options, None, [None])
    lines, _ = tables.read(tmp_path / "a.csv")
    assert len(lines) == len(whose) + 1
    compared = {line["compared"] for line in tables.read(tmp_path / "a_tests.csv")[0]}
    expected = tests or ["prior", "other fabrics' lifts", "other trial"]
    assert {f"own lift less {other}" for other in expected} <= compared
    assert len(compared) == 2 * len(expected)


@pytest.mark.parametrize("name", ["diffcp-mpm-lifting", "pinn-cloth-stretching"])
def test_what_a_table_of_skills_compares_is_all_predicted_on_the_cloth(module, name: str) -> None:
    pytest.importorskip("psutil", reason="needs r2s[study]")
    cells, estimate = module("_skills")._tasks(name, "grey_interlock", motions=("fling",))
    assert {cell.solver for cell in cells} == {"cloth"}
    whose = [cell.baseline for cell in cells]
    assert len(whose) == 7 and whose.count("default") == 4  # samples, middle, truth, estimate
    assert "-".join(estimate.name.split("_")[:3]) == name


def test_a_line_of_several_sources_is_refused(tables, tmp_path: Path, monkeypatch) -> None:
    words = "r2s 0.3.0; source {}; a processor"
    found = dict.fromkeys([words.format("a" * 16)], 3)
    monkeypatch.setattr(tables, "provenance", lambda cells, folder: found)
    assert tables.made_by([], tmp_path) == {"made by source": "a" * 8}
    found[words.format("b" * 16)] = 1
    with pytest.raises(ValueError, match="several sources"):
        tables.made_by([], tmp_path)


def test_what_is_not_narrowed_or_diverged_is_no_interval_that_holds(module) -> None:
    by_parameter = module("coverage").by_parameter
    line = {"fabric": "knit", "repeat": "1", "warp": "+0.50", "damping": "(-2.00)"}
    lines = [line | {"narrowed off at most": "0.1"}, {"repeat": "2", "converged": "diverged"}]
    warp, damping, every = by_parameter(lines)
    assert (warp["held"], warp["narrowed"], warp["held of these"]) == ("1 of 2", "1", "1")
    assert (damping["held"], damping["errors off at most"]) == ("0 of 2", "-")
    assert every["held"] == "1 of 4" and every["errors off at most"] == "0.5"
    # as a table that begins with the one that diverged is read back
    lost = {"converged": "diverged", "warp": "", "damping": "", "narrowed off at most": ""}
    again = {"converged": "yes"} | lines[0]
    read_back = [
        {"fabric": "knit", "repeat": n} | each for n, each in zip("21", (lost, again), strict=True)
    ]
    assert by_parameter(read_back) == [warp, damping, every]
    assert by_parameter(lines[1:]) == []
