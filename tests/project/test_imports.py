"""Each package of r2s imports only those below it, so that each can be read by itself."""

import ast

import pytest
from folders import ROOT

PACKAGES = (
    "_util",
    "compilation",
    "mesh",
    "environment",
    "materials",
    "solvers",
    "recordings",
    "scenarios",
    "metrics",
    "estimation",
    "laboratory",
    "export",
    "viewer",
    "study",
    "cli",
)
ABOVE_ALL = {"__init__", "__main__"}


def imported(source: str) -> set[str]:
    """The packages of r2s that a source imports, within functions, too."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.split(".")[1] for name in names if name.startswith("r2s.")}


def test_every_package_has_its_place():
    found = {path.stem for path in (ROOT / "r2s").glob("*.py")}
    found |= {path.parent.name for path in (ROOT / "r2s").glob("*/__init__.py")}
    assert found - ABOVE_ALL - {"data_manifests"} == set(PACKAGES)


@pytest.mark.parametrize("package", PACKAGES)
def test_it_imports_only_packages_below_it(package):
    folder = ROOT / "r2s" / package
    files = folder.rglob("*.py") if folder.is_dir() else [folder.with_suffix(".py")]
    below = set(PACKAGES[: PACKAGES.index(package) + 1])
    for file in files:
        above = (imported(file.read_text(encoding="utf-8")) & set(PACKAGES)) - below
        assert not above, f"{file.relative_to(ROOT)} imports {', '.join(sorted(above))}"
