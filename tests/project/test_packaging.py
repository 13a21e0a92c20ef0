"""What is installed finds the descriptions of the data sets, which lie beside the package."""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
import urllib.request
import zipfile
from pathlib import Path

import pytest
from folders import ROOT

import r2s
from r2s.cli.study import Study
from r2s.recordings.manifest import default_manifest
from r2s.study import plan as plans

MANIFESTS = ROOT / "data_manifests"
PACKAGE = Path(r2s.__file__).parent


def test_every_manifest_and_the_public_names_are_package_data() -> None:
    """A link in the package leads to the folder, and what is listed covers its files."""
    assert (PACKAGE / "data_manifests").resolve() == MANIFESTS
    assert default_manifest().parent == PACKAGE / "data_manifests"
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    patterns = settings["package-data"]["r2s"]
    listed = {path.resolve() for pattern in patterns for path in PACKAGE.glob(pattern)}
    others = {
        PACKAGE / "__init__.pyi",
        PACKAGE / "py.typed",
        PACKAGE / "study" / "report.html.j2",
    }
    assert listed == {*others, *MANIFESTS.rglob("*.json")}


# where a library is imported by another name than it is installed by
IMPORTED_AS = {
    "dask-jobqueue": "dask_jobqueue",
    "opencv-python-headless": "cv2",
    "scikit-learn": "sklearn",
    "scikit-optimize": "skopt",
    "warp-lang": "warp",
}


def test_every_library_that_is_declared_is_imported() -> None:
    """All but the tools of development, which are run as commands."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    others = "dev", "all"
    extras = {k: v for k, v in project["optional-dependencies"].items() if k not in others}
    listed = [text for group in (project["dependencies"], *extras.values()) for text in group]
    names = {re.split(r"[<>=!]", text)[0] for text in listed}
    folders = (ROOT / each for each in ("r2s", "experiments", "benchmarks"))
    source = "\n".join(p.read_text() for folder in folders for p in folder.rglob("*.py"))
    for name in names:
        module = IMPORTED_AS.get(name, name)
        used = rf"(import|from) {module}\b|require\(\s*\"{module}[\".]|import_module\(\"{module}"
        assert re.search(used, source), f"{name} is declared and not imported"


def build_wheel(folder: Path) -> Path:
    """From a copy, since building leaves files behind."""
    source = folder / "source"
    for name in ("r2s", "data_manifests"):
        shutil.copytree(ROOT / name, source / name, symlinks=True)
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "wheel", str(source), "--no-deps", "-q", "-w", str(folder)]
    subprocess.run([*pip, "-c", str(ROOT / "constraints.txt")], check=True, cwd=folder)
    (wheel,) = folder.glob("r2s-*.whl")
    return wheel


def quickstart() -> list[str]:
    """The commands that the quickstart tells to type, and one that shows what they made."""
    text = (ROOT / "docs" / "quickstart.md").read_text(encoding="utf-8")
    typed = re.findall(r"^ {4}(r2s .*?)(?:  +#.*)?$", text, re.M)
    return [*typed, "r2s view denim.json --recording lift.npz"]


# what runs in a shell's background inherits that interrupts are ignored
HEED = "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL); " + (
    "os.execvp(sys.argv[1], sys.argv[1:])"
)


def run_until_shown(command: str, **about) -> None:
    """A command that shows a page until it is interrupted."""
    heeding = [sys.executable, "-c", HEED, *shlex.split(command)]
    process = subprocess.Popen(heeding, stdout=subprocess.PIPE, text=True, **about)
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if line.startswith("http://"):
                urllib.request.urlopen(line.split()[0]).close()
                process.send_signal(signal.SIGINT)
    finally:
        process.stdout.close()
        assert process.wait(60) == 0


@pytest.mark.slow(group="documents")
def test_what_the_readme_says_runs_where_only_a_wheel_is_installed(tmp_path: Path) -> None:
    """In an environment of its own, away from the checkout: the commands of the quickstart, one
    after the other, and all Python of the README."""
    wheel = build_wheel(tmp_path)
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", environment], check=True)
    binaries = environment / "bin"
    python = binaries / "python"
    extras = f"{wheel}[study,camera,cli,viz]"
    install = [python, "-m", "pip", "install", "-q", extras, "-c", ROOT / "constraints.txt"]
    subprocess.run(install, check=True, cwd=tmp_path)
    ours = os.environ | {"PATH": f"{binaries}:{os.environ['PATH']}", "JAX_PLATFORMS": "cpu"}
    about = {"cwd": tmp_path, "env": ours}
    for command in quickstart():
        if command.startswith("r2s view"):
            run_until_shown(command, **about)
            continue
        run = subprocess.run(command, shell=True, capture_output=True, **about)
        assert run.returncode == 0, (command, run.stderr[-2000:])
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (tmp_path / "blocks.py").write_text(
        "\n".join(re.findall(r"^```python\n(.*?)^```", readme, re.M | re.S))
    )
    run = subprocess.run([python, "blocks.py"], capture_output=True, **about)
    assert run.returncode == 0, run.stderr[-2000:]


@pytest.mark.slow(group="documents")
def test_a_wheel_knows_the_data_sets(tmp_path: Path) -> None:
    """Built and unpacked elsewhere; that folder comes before the one that the tests import."""
    wheel = build_wheel(tmp_path)
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    code = "import r2s, r2s.cli.main; print(r2s.__file__); r2s.cli.main.main(['data', 'list'])"
    ours = os.environ | {"PYTHONPATH": str(tmp_path / "site"), "JAX_PLATFORMS": "cpu"}
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=ours, text=True, capture_output=True
    )
    assert run.returncode == 0, run.stderr
    where, *lines = run.stdout.splitlines()
    assert Path(where) == tmp_path / "site" / "r2s" / "__init__.py"
    named = {line.partition(":")[0] for line in lines if not line.startswith(" ")}
    assert named == {"blanco_mulero", "diffcloud", "rgbench", "study", "swings"}


def test_make_study_runs_a_preset_that_there_is():
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    (default,) = re.findall(r"^PRESET \?= (\w+)$", text, re.MULTILINE)
    assert default in plans.PRESETS and Study(out=ROOT).preset == default
