"""The engine: nothing finished is lost, what fails stops nothing else, keys say all."""

import os
import signal
import subprocess
import sys
import threading
import time
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pytest
from folders import TESTS

from r2s.study import engine, tasks
from r2s.study.engine import environment
from r2s.study.tasks import Task


@dataclass(frozen=True)
class Number(Task):
    """Writes a number; a negative one fails."""

    kind: ClassVar[str] = "numbers"

    value: int
    pause: float = 0.0

    @property
    def name(self) -> str:
        return f"n{self.value}"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        time.sleep(self.pause)
        if self.value < 0:
            raise ValueError("is below zero")
        (out / "value.txt").write_text(str(self.value))
        return {"seed": self.value}


@dataclass(frozen=True)
class Sum(Task):
    """The sum of others."""

    kind: ClassVar[str] = "sums"

    parts: tuple[Task, ...]
    label: str = "sum"

    @property
    def name(self) -> str:
        return self.label

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        total = sum(value_of(part, folder) for part in self.parts)
        (out / "value.txt").write_text(str(total))
        return {}


def value_of(cell: Task, folder: Path) -> int:
    with tasks.result_files(cell, folder) as files:
        return int((files / "value.txt").read_text())


def pairs(count: int, pause: float) -> list[Sum]:
    return [Sum((Number(i, pause), Number(i + 1, pause)), f"s{i}") for i in range(count)]


def tree() -> Sum:
    return Sum((Sum((Number(1), Number(2)), "a"), Sum((Number(2), Number(3)), "b")), "whole")


def test_needs_come_first_and_once(tmp_path):
    order = [cell.name for cell in tasks.with_dependencies([tree()])]
    assert order == ["n1", "n2", "a", "n3", "b", "whole"]
    assert engine.run([tree()], tmp_path, engine.Runner()) == {}
    assert value_of(tree(), tmp_path) == 8


def test_what_fails_stops_only_what_needs_it(tmp_path):
    sums = [Sum((Number(value), Number(5)), f"s{value}") for value in (1, -2, 3)]
    failed = engine.run(sums, tmp_path, engine.Runner())
    assert [cell.is_made(tmp_path) for cell in sums] == [True, False, True]
    assert failed == {
        Number(-2): "ValueError: is below zero",
        sums[1]: "needs numbers n-2, which is missing",
    }


def test_what_is_made_is_not_made_again_and_says_how_it_was_made(tmp_path):
    engine.run([tree()], tmp_path, engine.Runner())
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.zip")}
    engine.run([tree()], tmp_path, engine.Runner())
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.zip")} == times
    noted = tasks.read_metadata(Number(3), tmp_path)
    assert noted["config"] == "Number(value=3, pause=0.0)" and noted["seed"] == 3
    assert {"r2s", "jax"} <= noted["versions"].keys() and noted["peak_memory_MB"] > 10


def test_the_key_depends_on_all_that_results_do(monkeypatch):
    before, sum_before = Number(1).key, Sum((Number(1),)).key
    assert len({before, Number(2).key, sum_before, Sum((Number(1, 0.5),)).key}) == 4
    monkeypatch.setattr(Number, "settings", ((33, 33),))
    assert Number(1).key != before and Sum((Number(1),)).key != sum_before


def test_a_damaged_result_is_made_again(tmp_path):
    engine.run([Number(4)], tmp_path, engine.Runner())
    path = Number(4).path(tmp_path)
    path.write_bytes(path.read_bytes()[:20])
    engine.run([Number(4)], tmp_path, engine.Runner())
    assert zipfile.is_zipfile(path) and value_of(Number(4), tmp_path) == 4


STUDY = """
import sys
sys.path[:0] = {tests!r}
from pathlib import Path
from test_engine import pairs
from r2s.study import engine
engine.run(pairs(8, 0.05), Path({folder!r}), engine.Runner())
"""


def test_a_run_that_was_killed_continues(tmp_path):
    code = STUDY.format(tests=[str(Path(__file__).parent), str(TESTS)], folder=str(tmp_path))
    killed = subprocess.Popen([sys.executable, "-c", code])
    deadline = time.time() + 60
    while time.time() < deadline and not list(tmp_path.rglob("*.zip")):
        time.sleep(0.01)
    time.sleep(0.25)
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    made = set(tmp_path.rglob("*.zip"))
    assert 0 < len(made) < 17
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert made <= set(tmp_path.rglob("*.zip"))
    assert [value_of(cell, tmp_path) for cell in pairs(8, 0.05)] == [2 * i + 1 for i in range(8)]


@dataclass(frozen=True)
class Dying(Task):
    """Ends its process."""

    kind: ClassVar[str] = "deaths"

    @property
    def name(self) -> str:
        return "dying"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        os.kill(os.getpid(), signal.SIGKILL)
        return {}


@pytest.mark.slow(group="study")
def test_a_process_apart_has_a_workers_environment_and_may_die(tmp_path, monkeypatch):
    for name in environment(1):
        monkeypatch.setenv(name, os.environ.get(name, ""))  # put back at the end
    runner = engine.OneProcess()
    try:
        failed = engine.run([Dying(), tree()], tmp_path, runner)
    finally:
        runner.close()
    assert list(failed) == [Dying()] and "Broken" in failed[Dying()]
    assert value_of(tree(), tmp_path) == 8
    assert os.environ["OPENBLAS_NUM_THREADS"] == "1"


@pytest.mark.slow(group="study")
def test_workers_of_dask_make_the_same_and_survive_a_kill(tmp_path):
    pytest.importorskip("distributed", reason="needs the extra cluster")
    sums = [*pairs(6, 0.2), Sum((Number(-1), Number(0, 0.2)), "bad")]
    runner = engine.local(2)
    try:
        client = runner.client
        pools = set(client.run(os.getenv, "NPROC").values())
        pid = next(iter(client.run(os.getpid).values()))  # dies in the middle of a cell
        threading.Timer(0.5, os.kill, (pid, signal.SIGKILL)).start()
        failed = engine.run(sums, tmp_path, runner)
    finally:
        runner.close()
    assert {cell.name for cell in failed} == {"n-1", "bad"}
    assert [value_of(cell, tmp_path) for cell in sums[:6]] == [2 * i + 1 for i in range(6)]
    assert pools == {"1"}


SBATCH = """#!/bin/sh
for script; do :; done
cp "$script" "$0.$$"
setsid sh "$0.$$" > "$0.$$.log" 2>&1 &
echo "Submitted batch job $!"
"""


@pytest.mark.slow(group="study")
def test_jobs_of_slurm_make_the_same_with_a_stand_in_for_sbatch(tmp_path, monkeypatch):
    """The stand-in runs a job's script at once, as Slurm would on a node that is free."""
    pytest.importorskip("distributed", reason="needs the extra cluster")
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    with pytest.raises(OSError, match="sbatch"):
        engine.slurm(1)
    for name, script in (("sbatch", SBATCH), ("scancel", '#!/bin/sh\nkill -- "-$1"\n')):
        (tmp_path / name).write_text(script)
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setenv("PYTHONPATH", f"{Path(__file__).parent}{os.pathsep}{TESTS}")
    sums = pairs(4, 0.1)
    runner = engine.slurm(2)
    try:
        assert not engine.run(sums, tmp_path / "out", runner)
        settings = runner.client.run(os.getenv, "OPENBLAS_NUM_THREADS")
    finally:
        runner.close()
    assert [value_of(cell, tmp_path / "out") for cell in sums] == [1, 3, 5, 7]
    assert settings and set(settings.values()) == {"1"}
    assert len(list(tmp_path.glob("sbatch.*.log"))) >= 1


def test_a_file_gets_a_line_in_time_while_a_cell_is_running(tmp_path, capfd, monkeypatch):
    """Half a minute as delivered; a tenth of a second here."""
    monkeypatch.setattr(engine, "LINES", 0.1)
    engine.run([Number(1, pause=0.55)], tmp_path, engine.Runner())
    lines = capfd.readouterr().err.splitlines()
    assert len([line for line in lines if line.startswith("study of 1 cells:   0 %")]) >= 3


def test_a_study_says_beforehand_how_long_it_takes(tmp_path, capfd, monkeypatch):
    monkeypatch.setitem(engine.SECONDS, "numbers", (150.0, 30.0))
    engine.run([Number(1), Number(2)], tmp_path, engine.Runner())
    forecast = "study: 2 cells, about 3 min on 1 process"
    assert capfd.readouterr().err.splitlines()[0] == forecast
    engine.run([Number(1), Number(2)], tmp_path, engine.Runner())
    assert "study:" not in capfd.readouterr().err


def test_every_version_and_source_that_made_results_is_counted(tmp_path, monkeypatch):
    made = [Number(i) for i in range(5)]
    for task in made[:2]:
        tasks.execute(task, tmp_path)
    assert list(tasks.provenance(made, tmp_path).values()) == [2]
    monkeypatch.setitem(tasks.VERSIONS, "jax", "0.0.1")
    tasks.execute(made[2], tmp_path)
    monkeypatch.setattr(tasks, "source_hash", lambda: "another")
    tasks.execute(made[3], tmp_path)
    found = tasks.provenance(made, tmp_path)
    assert list(found.values()) == [2, 1, 1] and "source another" in "".join(found)
