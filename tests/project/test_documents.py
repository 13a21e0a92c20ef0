"""What documents say runs, what they name is there, and their figures are those of files."""

import doctest
import importlib
import pydoc
import re
import subprocess
import sys

import pytest
from folders import ROOT

import r2s

README = ROOT / "README.md"
DOCUMENTS = [README, *sorted((ROOT / "docs").rglob("*.md"))]
SOURCES = [
    path for name in ("r2s", "experiments", "benchmarks") for path in (ROOT / name).rglob("*.py")
]
RESULTS = sorted((ROOT / "docs" / "results").glob("*.csv"))
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
NAME = re.compile(r"`(r2s(?:\.[A-Za-z_]\w*)+)")
IMPORT = re.compile(r"^ *from (r2s[\w.]*) import ([\w, ]+)$", re.MULTILINE)
TABLE = re.compile(r"<!-- (\w+) -->\n(.*?)<!-- end of \1 -->\n", re.DOTALL)


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
    for name in re.findall(r"\]\(([\w./]+\.(?:md|jpg|csv))\)", text):
        assert (document.parent / name).exists(), f"{document.name} links to {name}"
    wide = [line for line in text.splitlines() if len(line) > 120]
    assert not wide, f"{document.name}: longer than 120 characters: {wide[0][:80]}"


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
    shown = f"<!-- {path.stem} -->", f"({path.name})"
    texts = [document.read_text(encoding="utf-8") for document in DOCUMENTS]
    assert any(words in text for words in shown for text in texts)


def with_examples():
    modules = sorted((ROOT / "r2s").rglob("*.py"))
    return [path for path in modules if ">>> " in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", with_examples(), ids=lambda path: path.stem)
def test_the_examples_of_docstrings_are_right(path):
    module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    found = doctest.testmod(module)
    assert found.attempted > 0
    assert found.failed == 0
