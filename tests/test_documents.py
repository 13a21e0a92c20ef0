"""What the documents and docstrings say runs, and what they name is there."""

import doctest
import importlib
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
NAME = re.compile(r"`(r2s(?:\.[A-Za-z_]+)+)`")


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
    for name in NAME.findall(text):
        assert pydoc.locate(name) is not None, f"{document.name} names {name}"
    for name in re.findall(r"(?:experiments|benchmarks|examples)/[a-z_]+\.py", text):
        assert (ROOT / name).exists(), f"{document.name} names {name}"


def test_the_makefile_lists_public_modules_that_are_there():
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    listed = re.search(r"^PUBLIC := (.*?)\n\n", text, re.MULTILINE | re.DOTALL)
    assert listed is not None
    for name in listed[1].replace("\\", " ").split():
        path = ROOT.joinpath(*name.split("."))
        assert path.is_dir() or path.with_suffix(".py").exists(), name


def with_examples():
    modules = sorted((ROOT / "r2s").rglob("*.py"))
    return [path for path in modules if ">>> " in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", with_examples(), ids=lambda path: path.stem)
def test_the_examples_of_docstrings_are_right(path):
    module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    found = doctest.testmod(module)
    assert found.attempted > 0
    assert found.failed == 0
