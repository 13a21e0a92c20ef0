"""The study: pairs, what a figure means, and that nothing finished is made again."""

import json
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from r2s import presets, synthetic
from r2s.recording import cloud
from r2s.study import judge, pairs, run, tables

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def pair():
    fabric = presets.grey_interlock()
    lift, fold = synthetic.lift, synthetic.fold
    return pairs.Pair(
        lift(fabric, "grey", 1, key=jr.key(0)),
        fold(fabric, "grey", 1, key=jr.key(1)),
        float(fabric.density),
        fold(fabric, "grey", 2, key=jr.key(2)),
        fabric,
    )


def test_a_recording_is_at_no_distance_from_itself(pair):
    found = judge.against_recording(pair.fold, pair.fold)
    assert all(value == 0 for value in found.values())


def test_the_true_fabric_is_nearer_than_another_and_than_noise_allows(pair):
    truth = judge.against_motion(pair.fold, judge.predict(pair.fold, presets.grey_interlock()))
    other = judge.against_motion(pair.fold, judge.predict(pair.fold, presets.pink_solid()))
    # 1 mm of noise, sampling of the surface every 5 mm, one point in a hundred 0.2 m away
    assert truth["chamfer_real_to_sim"] < 0.007
    assert truth["chamfer_real_to_sim"] < other["chamfer_real_to_sim"]
    assert truth["hausdorff"] >= truth["chamfer"]


def test_a_diverged_motion_is_a_result(pair):
    shape = (len(pair.fold.times), 81, 3)
    found = judge.against_motion(pair.fold, np.full(shape, np.nan))
    whole = judge.against_recording(pair.fold, pair.fold)
    assert found.keys() == whole.keys()
    assert all(np.isnan(value) for value in found.values())


def test_the_cropped_distance_leaves_out_what_the_recording_cannot_show(pair):
    x = judge.predict(pair.fold, presets.grey_interlock())
    found = judge.against_motion(pair.fold, x)
    assert found["chamfer_sim_to_real_cropped"] < found["chamfer_sim_to_real"]
    assert cloud(pair.fold, 20)[:, 2].min() > 0


def test_an_estimate_is_made_once(pair, tmp_path, monkeypatch):
    effort = run.Effort(run.Cost(coarse=2, starts=1, iterations=1))
    with monkeypatch.context() as patch:
        patch.setattr(run, "_approach", lambda effort: _fake)
        judged, rows = run.run([pair], tmp_path, effort)
    stored = json.loads((tmp_path / "estimates" / "lift_grey.json").read_text())
    assert stored["parameters"]["warp"]["unit"] == "N/m"
    assert tables.read_rows(tmp_path / "results.csv") == rows
    baselines = {row.baseline for row in rows}
    assert baselines == {"", "default", "repeatability"}  # one fabric, so no other

    def refuse(effort):
        raise AssertionError("made again")

    monkeypatch.setattr(run, "_approach", refuse)
    again, _ = run.run([pair], tmp_path, effort)
    np.testing.assert_array_equal(again[0].estimate.values, judged[0].estimate.values)
    with pytest.raises(AssertionError, match="made again"):
        run.run([pair], tmp_path, run.Effort(run.Cost(coarse=3)))


def _fake(pair):
    """An estimate without the work: the middle of the family."""
    from r2s.estimators.estimate import without_deviations
    from r2s.family import OrthotropicFamily

    family = OrthotropicFamily.make(pair.density)
    middle = jnp.full(family.dim, 0.5)
    values = np.asarray(family.values(middle))
    losses, history = np.full((1, 1), 1e-4), values[None, None]
    return without_deviations("fake", family, middle, 1e-4, losses, history, 0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--data", "no-such-folder"), "no such folder"),
        (("--data", "r2s"), "no lift with a fold"),
        (("--data", "r2s", "--density", "-1"), "must be positive"),
    ],
)
def test_a_wrong_call_says_what_is_wrong_and_writes_nothing(arguments, message, tmp_path):
    out = tmp_path / "results"
    command = [sys.executable, "experiments/study.py", *arguments, "--out", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert message in done.stderr
    assert not out.exists()
