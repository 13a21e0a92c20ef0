"""What is wrong with recordings is said by `r2s estimate`, and nothing where nothing is."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r2s import scenarios
from r2s.cli.main import main
from r2s.materials import presets
from r2s.recordings.recording import save
from r2s.scenarios import synthetic

SHAPE, KNIT = (5, 5), presets.grey_interlock()
DENSITY = float(KNIT.density)  # [kg/m^2]

pytest.importorskip("tyro")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A lift and a pull of one fabric, and a pull with a marker that stays behind."""
    folder = tmp_path_factory.mktemp("recordings")
    lift, pull = scenarios.lifting(num_frames=16, interval=0.18), scenarios.stretching()
    for name, experiment in (("lift", lift), ("pull", pull)):
        made = synthetic.record(experiment, KNIT, name, shape=SHAPE, key=jax.random.key(0))
        save(made, folder / f"{name}.npz")
    markers = np.array(made.markers)
    far = int(np.argmax(np.linalg.norm(markers[-1] - markers[0], axis=1)))
    markers[:, far] = markers[:1, far]
    save(dataclasses.replace(made, markers=jnp.asarray(markers)), folder / "stray.npz")
    return folder, far


def said(folder, capsys, *names, density=DENSITY):
    """What the command prints."""
    files = [str(folder / f"{name}.npz") for name in names]
    budget = ["--num-samples", "4", "--num-starts", "1", "--law", "linear", "--shape", "5", "5"]
    out = ["--out", str(folder / "card.json"), "--density", str(density)]
    assert main(["estimate", *files, *out, *budget]) == 0
    return capsys.readouterr().out


@pytest.mark.slow(group="estimates")
@pytest.mark.parametrize(
    ("names", "density", "words"),
    [
        (["lift", "pull"], DENSITY, ["recordings agree", "not judged by another recording: 3"]),
        (["lift"], 10 * DENSITY, ["no force of a pull"]),
        (["stray"], DENSITY, ["marker {far} is", "another cloth"]),
    ],
)
def test_what_recordings_show_is_said(folder, capsys, names, density, words):
    text = said(folder[0], capsys, *names, density=density)
    assert all(part.format(far=folder[1]) in text for part in words)
    assert "contradicts" not in text or names != ["lift", "pull"]


@pytest.mark.slow(group="estimates")
def test_a_density_that_is_off_by_ten_is_told_by_the_force_of_a_pull(folder, capsys):
    text = said(folder[0], capsys, "lift", "pull", density=10 * DENSITY)
    (line,) = [line for line in text.splitlines() if "would agree on" in line]
    assert line.startswith("warning")
    assert 0.05 <= float(line.split("agree on about ")[1].split()[0]) <= 0.3
