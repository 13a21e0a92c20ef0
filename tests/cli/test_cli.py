"""The command line: what it does, its help, and its exit codes."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from folders import ROOT

pytest.importorskip("tyro")

from recorded_lift import cloth, lab, recorded  # noqa: E402

from r2s.cli.main import main  # noqa: E402
from r2s.recordings.open import save_trajectory  # noqa: E402
from r2s.recordings.recording import save  # noqa: E402


def stopped(*arguments: str) -> int | str | None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    return stop.value.code


@pytest.mark.parametrize(
    "command, words",
    [
        ("", ["data", "show", "estimate"]),
        ("data", ["fetch", "list", "convert"]),
        ("data convert", ["FOLDER", "--to OUT", "--only REGEX", "--force"]),
        ("data fetch", ["NAME", "--to FOLDER"]),
        ("data list", ["--manifests FOLDER"]),
        ("show", ["RECORDING", "--trajectory FILE", "--out FOLDER", "gif"]),
        ("estimate", ["RECORDING", "--density KG/M^2", "--out FILE", "--method", "--json"]),
    ],
)
def test_help_names_commands_and_options(capsys: pytest.CaptureFixture, command, words) -> None:
    assert stopped(*command.split(), "--help") == 0
    text = capsys.readouterr().out
    assert all(word in text for word in words)


@pytest.mark.parametrize(
    "command, word",
    [
        ("", "command"),
        ("shov", "shov"),
        ("data fetch rgbench", "--to"),
        ("data convert recordings", "--to"),
        ("show a.npz --out b --video avi", "avi"),
        ("show a.npz --out b --colour red", "--colour"),
        ("simulate lifting", "--out"),
        ("simulate hovering --out x.npz", "hovering"),
        ("estimate a.npz --out x.json", "--density"),
        ("export black_denim --to felt --out x", "felt"),
        ("export --fabric black_denim --to mujoco --out x", "PRESET|CARD, --help, --to, --out"),
        ("shov", "did you mean show?"),
        ("data convrt", "did you mean convert?"),
        ("estimate a.npz --densty 0.3 --out x.json", "did you mean --density?"),
        ("estimate a.npz -density 0.3 --out x.json", "did you mean --density?"),
        ("estimate a.npz --density 0.3", "needs --out FILE (see"),
        ("estimate a.npz --density light --out x.json", "--density expects a number in kg/m^2"),
        ("simulate wind --out x.npz --shape 9x9", "--shape expects two whole numbers, got '9x9'"),
        ("check a.npz b.npz", "too many arguments: b.npz"),
    ],
)
def test_wrong_usage_is_one_line_and_2(capsys: pytest.CaptureFixture, command, word) -> None:
    assert stopped(*command.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("r2s: error: ") and word in line


def test_the_data_sets_are_listed(capsys: pytest.CaptureFixture) -> None:
    assert main(["data", "list"]) == 0
    text = capsys.readouterr().out
    assert "rgbench: RGBench" in text and "licence: CC-BY-4.0" in text
    assert main(["data", "list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rgbench"]["licence"] == "CC-BY-4.0"


@pytest.mark.parametrize(
    "command, words",
    [
        ("data fetch blanco_mulero --to HERE", "10.5281/zenodo.13823986"),
        ("data fetch none --to HERE", "no data set 'none'; there are"),
        ("data convert HERE --to HERE/out", "no manifest.json"),
        ("show HERE/no.npz --out HERE", "no.npz: no such recording"),
        ("simulate lifting --fabric felt --out HERE/out", "felt: no such card, and no preset"),
        (
            "simulate lifting --fabric HERE/broken.json --out HERE/out",
            "broken.json: no fabric",
        ),
        ("simulate lifting --out HERE/no/x.npz", "there is no folder"),
        ("estimate x.npz --density 1 --out HERE/no/x.json", "there is no folder"),
        ("simulate lifting --motion heigt=1 --out HERE/out", "lifting has no heigt; it takes he"),
        ("simulate lifting --motion height --out HERE/out", "expects NAME=NUMBER"),
        (
            "simulate wind --self-contact --solver mpm --out HERE/out",
            "--self-contact is of the implicit cloth",
        ),
        ("estimate HERE/no.npz --density 0.2 --out HERE/out", "no.npz: no such"),
        ("evaluate black_denim HERE/no.npz", "no.npz: no such recording"),
        ("check-grad wind --solver mpm --forward", "are of the cloth"),
        ("doctor --mesh HERE/no.obj", "no.obj: no such mesh"),
        ("view felt", "felt: no such card, and no preset"),
        ("view --recording HERE/no.npz", "no.npz: no such recording"),
        ("view --recording x.npz --motion height=1", "--motion is of a scenario"),
    ],
)
def test_an_error_is_one_line_and_1(
    tmp_path: Path, capsys: pytest.CaptureFixture, command: str, words: str
) -> None:
    (tmp_path / "broken.json").write_text('{"format": "r2s-card/9"}')
    assert main(command.replace("HERE", str(tmp_path)).split()) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("r2s: error: ") and words in lines[0]
    assert not (tmp_path / "out").exists()


def test_a_recording_is_shown_with_its_simulation(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    save(recorded(2), tmp_path / "made.npz")
    save_trajectory(tmp_path / "t.npz", cloth(2).x, cloth(2).faces)
    made, out = str(tmp_path / "made.npz"), str(tmp_path / "out")
    command = ["show", made, "--trajectory", str(tmp_path / "t.npz"), "--out", out]
    assert main([*command, "--video", "gif"]) == 0
    printed = capsys.readouterr().out.split()
    assert [Path(line).name for line in printed] == ["lift_made.png", "lift_made.gif"]
    np.savez(tmp_path / "t.npz", x=cloth(3).x, faces=cloth(3).faces)
    assert main(command) == 1
    assert "t.npz" not in (text := capsys.readouterr().err) and "has 3 frames" in text


def test_recordings_are_converted_once(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "in").mkdir()
    folder = str(lab(tmp_path / "in", "lift_camel_1", "lift_denim_1"))
    command = ["data", "convert", folder, "--only", "camel", "--to", str(tmp_path / "out")]
    for words in ("3 frames, 12 points", "up to date"):
        assert main(command) == 0
        assert words in (text := capsys.readouterr().out) and "denim" not in text
    assert main([*command, "--force"]) == 0
    assert "3 frames" in capsys.readouterr().out


WATCHED = """
import os, sys

class Watch:
    def find_spec(self, name, path=None, target=None):
        if name in ("numpy", "jax"):
            print(name, os.environ["TF_CPP_MIN_LOG_LEVEL"], os.environ["OPENBLAS_NUM_THREADS"])

sys.meta_path.insert(0, Watch())
import r2s.__main__
print("imported")
sys.argv = ["r2s", "--help"]
r2s.__main__.command()
"""


def test_the_console_script_sets_the_environment_before_numpy_and_jax_load() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["scripts"] == {"r2s": "r2s.__main__:command"}
    names = ("TF_CPP_MIN_LOG_LEVEL", "OPENBLAS_NUM_THREADS")
    unset = {name: value for name, value in os.environ.items() if name not in names}
    run = subprocess.run([sys.executable, "-c", WATCHED], capture_output=True, text=True, env=unset)
    assert run.returncode == 0, run.stderr
    first, *loaded = run.stdout.splitlines()
    assert first == "imported" and {"numpy 3 1", "jax 3 1"} == set(loaded[:2])
    assert "usage: r2s" in run.stdout
