"""What is installed finds the descriptions of the data sets, which lie beside the package."""

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import r2s
from r2s.manifest import default_manifest

ROOT = Path(__file__).parents[1]
MANIFESTS = ROOT / "data_manifests"
PACKAGE = Path(r2s.__file__).parent


def test_every_manifest_is_package_data() -> None:
    """A link in the package leads to the folder, and what is listed covers its files."""
    assert (PACKAGE / "data_manifests").resolve() == MANIFESTS
    assert default_manifest().parent == PACKAGE / "data_manifests"
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    patterns = settings["package-data"]["r2s"]
    listed = {path.resolve() for pattern in patterns for path in PACKAGE.glob(pattern)}
    assert listed == set(MANIFESTS.rglob("*.json")) != set()


@pytest.mark.slow
def test_a_wheel_knows_the_data_sets(tmp_path: Path) -> None:
    """Built and unpacked elsewhere; that folder comes before the one that the tests import."""
    source = tmp_path / "source"  # a copy: building leaves files behind
    for folder in ("r2s", "data_manifests"):
        shutil.copytree(ROOT / folder, source / folder, symlinks=True)
    for file in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / file, source)
    pip = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        str(source),
        "--no-deps",
        "-q",
        "-w",
        str(tmp_path),
    ]
    subprocess.run([*pip, "-c", str(ROOT / "constraints.txt")], check=True, cwd=tmp_path)
    (wheel,) = tmp_path.glob("r2s-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    code = "import r2s, r2s.cli; print(r2s.__file__); r2s.cli.main(['data', 'list'])"
    ours = os.environ | {"PYTHONPATH": str(tmp_path / "site"), "JAX_PLATFORMS": "cpu"}
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=ours, text=True, capture_output=True
    )
    assert run.returncode == 0, run.stderr
    where, *lines = run.stdout.splitlines()
    assert Path(where) == tmp_path / "site" / "r2s" / "__init__.py"
    named = {line.partition(":")[0] for line in lines if not line.startswith(" ")}
    assert named == {"blanco_mulero", "diffcloud", "rgbench", "study"}
