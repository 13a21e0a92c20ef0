"""By what the numbers of a study were made: versions, source and processors of its cells."""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from r2s.study.cells import Cell, read_metadata, with_dependencies
from r2s.study.evaluations import EvaluationCell
from r2s.study.verdicts import ensembles


def origins(cells: Iterable[Cell], folder: Path) -> dict[str, int]:
    """Of a study's cells, what they need, and their ensembles: how many were made by which versions
    on which processor, in words; the most first. More than one line is a study of mixed origin."""
    cells = list(cells)
    judges = [cell for cell in cells if isinstance(cell, EvaluationCell)]
    every = with_dependencies([*ensembles(judges), *cells])
    noted = [read_metadata(cell, folder) for cell in every if cell.is_made(folder)]
    found = Counter(_words(each) for each in noted)
    return dict(found.most_common())


def _words(noted: dict) -> str:
    versions = ", ".join(f"{name} {number}" for name, number in noted["versions"].items())
    source = f"source {noted['source']}" if "source" in noted else "source not noted"
    return f"{versions}; {source}; {noted.get('processor', 'processor not noted')}"
