"""The examples run, are short, and do what they say."""

import os
import re
import subprocess
import sys

import pytest
from folders import ROOT

EXAMPLES = ROOT / "examples"
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))


def run(name: str) -> str:
    """What an example prints, in a process of its own."""
    ours = os.environ | {"PYTHONPATH": str(EXAMPLES.parent), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, str(EXAMPLES / f"{name}.py")]
    done = subprocess.run(command, capture_output=True, text=True, env=ours, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


def millimetres(line: str) -> float:
    return float(re.findall(r"(-?[\d.]+) mm", line)[0])


@pytest.mark.parametrize("name", NAMES)
def test_an_example_is_short_and_says_how_it_is_run(name: str) -> None:
    lines = (EXAMPLES / f"{name}.py").read_text().splitlines()
    assert len(lines) <= 60
    assert any(f"python examples/{name}.py" in line for line in lines[:5])


def test_every_example_has_a_test() -> None:
    tested = {name.removeprefix("test_") for name in globals() if name.startswith("test_")}
    assert set(NAMES) <= tested


@pytest.mark.slow(group="documents")
def test_optimise_policy() -> None:
    lines = run("optimise_policy").splitlines()
    assert millimetres(lines[-1]) < millimetres(lines[0]) / 3


@pytest.mark.slow(group="documents")
def test_fit_own_loss() -> None:
    off, stiffness = run("fit_own_loss").splitlines()
    assert float(re.findall(r"off by ([\d.]+) mm", off)[0]) < 0.1
    found, truth = (float(number) for number in re.findall(r"(\S+) N m", stiffness))
    assert found == pytest.approx(truth, rel=0.1)


@pytest.mark.slow(group="documents")
def test_network_in_the_loop() -> None:
    lines = run("network_in_the_loop").splitlines()
    assert millimetres(lines[-1]) < 0.7 * millimetres(lines[0])


@pytest.mark.slow(group="documents")
def test_sweep_fabrics() -> None:
    text = run("sweep_fabrics")
    assert float(re.findall(r"1000 fabrics in ([\d.]+) CPU s", text)[0]) < 60
    assert float(re.findall(r"bending +([+-][\d.]+)", text)[0]) > 0.3


@pytest.mark.slow(group="documents")
def test_shard_over_devices() -> None:
    text = run("shard_over_devices")
    assert text.startswith("2 devices") and millimetres(text) < 0.1


@pytest.mark.slow(group="documents")
def test_own_law() -> None:
    heights = [millimetres(line.split(":")[1]) for line in run("own_law").splitlines()]
    assert heights == sorted(heights)  # stiffer sags less


@pytest.mark.slow(group="documents")
def test_own_mesh() -> None:
    pytest.importorskip("trimesh")
    assert 20 < millimetres(run("own_mesh")) < 150


@pytest.mark.slow(group="documents")
def test_rgbd_folder() -> None:
    pytest.importorskip("cv2")
    text = run("rgbd_folder")
    cloth, gripper = (float(number) for number in re.findall(r"([\d.]+) m\b", text)[-2:])
    assert abs(cloth - gripper) < 0.04 and "16 frames" in text
