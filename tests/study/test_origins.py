"""A study whose cells were made by several versions says so, and its tables are refused."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from folders import ROOT

from r2s.study import cells
from r2s.study.cells import Cell, execute
from r2s.study.origins import origins

DRIVER = ROOT / "experiments" / "_documents.py"


@dataclass(frozen=True)
class Nothing(Cell):
    kind: ClassVar[str] = "nothing"

    number: int

    @property
    def name(self) -> str:
        return f"nothing_{self.number}"

    def make(self, folder: Path, out: Path) -> dict[str, Any]:
        return {}


def test_every_version_that_made_cells_is_counted(tmp_path, monkeypatch):
    made = [Nothing(i) for i in range(4)]
    for cell in made[:2]:
        execute(cell, tmp_path)
    (only,) = origins(made, tmp_path)
    assert "jaxlib" in only and origins(made, tmp_path)[only] == 2
    monkeypatch.setitem(cells.VERSIONS, "jax", "0.0.1")
    execute(made[2], tmp_path)
    assert list(origins(made, tmp_path).values()) == [2, 1]


def test_a_change_of_the_source_is_another_origin_of_the_same_version(tmp_path, monkeypatch):
    made = [Nothing(i) for i in range(2)]
    execute(made[0], tmp_path)
    monkeypatch.setattr(cells, "source_hash", lambda: "another")
    execute(made[1], tmp_path)
    first, second = origins(made, tmp_path)
    assert first != second and "source another" in first + second


def test_the_tables_of_a_study_of_mixed_origin_are_refused(tmp_path):
    (tmp_path / "tables").mkdir()
    lines = ["setting,value", "version of r2s,1", "cells made by a,2", "cells made by b,1"]
    (tmp_path / "tables" / "settings.csv").write_text("\n".join(lines))
    done = subprocess.run(
        [sys.executable, DRIVER, "--study", tmp_path], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 1 and "mixed" in done.stderr
    assert "cells made by a; cells made by b" in done.stderr
