"""What documents say runs, what they name is there, and their figures are those of files."""

import doctest
import importlib
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import pytest

import r2s

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCUMENTS = [README, *sorted((ROOT / "docs").glob("*.md"))]
SOURCES = [*sorted((ROOT / "r2s").rglob("*.py")), *sorted((ROOT / "experiments").glob("*.py"))]
RESULTS = sorted((ROOT / "docs" / "results").glob("*.csv"))
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
NAME = re.compile(r"`(r2s(?:\.[A-Za-z_]\w*)+)")
IMPORT = re.compile(r"^ *from (r2s[\w.]*) import ([\w, ]+)$", re.MULTILINE)
TABLE = re.compile(r"<!-- (\w+) -->\n(.*?)<!-- end of \1 -->\n", re.DOTALL)
FIGURE = re.compile(r"(?<!\w)\d[\d.,]* ?(?:%|mm\b|ms\b|s\b|min\b|hours?\b|CPU\b|GB\b|MB\b|times\b)")


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch):
    """The module with which experiments keep their tables."""
    monkeypatch.syspath_prepend(str(ROOT / "experiments"))
    return importlib.import_module("_tables")


@pytest.mark.slow(group="documents")
@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_the_code_of_a_document_runs(document, tmp_path):
    """All of its blocks, one after the other as a reader would type them."""
    blocks = BLOCK.findall(document.read_text(encoding="utf-8"))
    if not blocks:
        pytest.skip(f"{document.name} has no Python")
    script = tmp_path / "blocks.py"
    script.write_text("\n".join(blocks))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_the_files_and_modules_that_a_document_names_are_there(document):
    text = document.read_text(encoding="utf-8")
    for module, names in IMPORT.findall(text):
        for name in names.split(","):
            where = f"{module}.{name.strip()}"
            assert pydoc.locate(where) is not None, f"{document.name} imports {where}"
    for name in re.findall(r"(?:experiments|benchmarks|examples|tests)/\w+\.py", text):
        assert (ROOT / name).exists(), f"{document.name} names {name}"
    for name in re.findall(r"\]\(([\w./]+\.(?:md|jpg))\)", text):
        assert (document.parent / name).exists(), f"{document.name} links to {name}"


@pytest.mark.parametrize("source", [*DOCUMENTS, *SOURCES], ids=lambda path: path.name)
def test_every_dotted_name_in_backticks_is_there(source):
    for name in NAME.findall(source.read_text(encoding="utf-8")):
        assert pydoc.locate(name) is not None, f"{source.relative_to(ROOT)} names {name}"


def test_what_r2s_exposes_has_a_docstring():
    """The API reference is made from it."""
    assert len(r2s.__all__) == len(set(r2s.__all__)) > 10
    for name in r2s.__all__:
        value = getattr(r2s, name)
        if not isinstance(value, dict):
            assert pydoc.getdoc(value), name


def test_the_readme_is_short_and_begins_with_a_picture():
    lines = README.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    assert any(line.startswith("![") for line in lines[:5])


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_the_tables_of_a_document_are_those_of_its_files(document, tables):
    text = document.read_text(encoding="utf-8")
    assert text.count("<!-- ") == 2 * len(TABLE.findall(text))
    for name, table in TABLE.findall(text):
        assert table == tables.shown(ROOT / "docs" / "results" / f"{name}.csv"), name


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_a_file_of_results_says_what_made_it_and_is_shown(path, tables):
    lines, facts = tables.read(path)
    assert lines and {"table", "command", "version", "machine", "date"} <= set(facts)
    assert any(f"<!-- {path.stem} -->" in d.read_text(encoding="utf-8") for d in DOCUMENTS)


def test_the_readme_has_no_measured_figure_but_those_of_its_tables():
    text = TABLE.sub("", BLOCK.sub("", README.read_text(encoding="utf-8")))
    assert FIGURE.findall(text) == []
    assert FIGURE.findall("in 11 min 28 s, 17 % below") == ["11 min", "28 s", "17 %"]


@pytest.mark.parametrize("document", DOCUMENTS[1:], ids=lambda path: path.name)
def test_a_guide_that_states_times_says_which_version_was_measured(document):
    text = TABLE.sub("", BLOCK.sub("", document.read_text(encoding="utf-8")))
    if re.search(r"\d CPU seconds|\d s on one core|\d s\b.*\d s\b", text):
        assert re.search(r"version 0\.\d+\.0", text), f"{document.name} names no version"


def with_examples():
    modules = sorted((ROOT / "r2s").rglob("*.py"))
    return [path for path in modules if ">>> " in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", with_examples(), ids=lambda path: path.stem)
def test_the_examples_of_docstrings_are_right(path):
    module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    found = doctest.testmod(module)
    assert found.attempted > 0
    assert found.failed == 0
