"""Points that are no measurement: counted as they are in the files, said, and left out."""

import json
from pathlib import Path

import numpy as np
import pytest
from recorded_lift import lab
from test_checks import BOX, PLACE, TIMES, height, made_up, positions, suspicious

from r2s.cli.main import main as cli
from r2s.recordings.cameras import DepthCamera, look_at
from r2s.recordings.checks import check
from r2s.recordings.clouds import Cleaning
from r2s.recordings.open import convert, open_recordings
from r2s.recordings.recording import Recording, cloud, load, save
from r2s.recordings.strays import at_one_place, check_unit, strays, without_strays
from r2s.recordings.views import Views

RNG = np.random.default_rng(0)
X = [positions(h) for h in height(TIMES)]
PATH = np.stack([x[:1] for x in X])
CAMERA = (0.2, -0.6, 0.8)


def lift(extra: np.ndarray, **info) -> Recording:
    """A recording of a lifted sheet of 289 points, and some more in each frame."""
    clouds = [np.concatenate([x + RNG.normal(0, 1e-3, x.shape), extra]) for x in X]
    return made_up(clouds, TIMES, PATH, TIMES, **info)


VIEW = DepthCamera((160, 120), (140.0, 140.0), (79.5, 59.5), look_at(CAMERA, (0.2, 0.2, 0.0)), 1e-3)
VIEWS = Views((VIEW,), Cleaning(BOX))
BEHIND = np.add(CAMERA, [0.0, -0.1, 0.1]) + RNG.normal(0, 0.01, (30, 3))
FAR = RNG.uniform(-1, 1, (200, 3)) + [0, 9, 0]  # as depths at the end of the range
NOISY = np.array(CAMERA) + RNG.normal(0, 1e-3, (200, 3))


@pytest.mark.parametrize(
    ("extra", "info", "name"),
    [
        (np.tile(CAMERA, (200, 1)), {}, "repeats"),
        (np.tile(CAMERA, (5000, 1)), {}, "repeats"),  # most of all points
        (np.tile([0.1, 0.1, 0.0], (20, 1)), {}, "repeats"),  # within the sheet
        (BEHIND, {"views": VIEWS}, "behind"),
        (FAR, {}, "far"),
        (NOISY, {}, "far"),
    ],
)
def test_points_that_are_no_measurement_are_named_and_left_out(extra, info, name) -> None:
    recording = lift(extra, **info)
    assert name in suspicious(recording)
    kept, words = without_strays(recording)
    share = len(extra) / (len(extra) + len(X[0]))
    assert words.startswith("left out: ") and f"{share:.1%}" in words
    np.testing.assert_array_equal([len(cloud(kept, f)) for f in range(16)], len(X[0]))
    np.testing.assert_array_equal(cloud(kept, 3), cloud(recording, 3)[: len(X[0])])
    found = {f.check: f.figure for f in check(recording)}
    assert found[name] == pytest.approx(share)
    clean = {f.check: f.figure for f in check(lift(np.zeros((0, 3)), **info))}
    assert found["points"] == clean["points"]  # the other checks look at the points that are left


@pytest.mark.parametrize(
    "extra", [np.zeros((0, 3)), FAR[:8], np.tile(CAMERA, (5, 1))], ids=["none", "few", "five"]
)
def test_good_recordings_and_a_few_outliers_are_left_alone(extra: np.ndarray) -> None:
    recording = lift(extra)
    assert without_strays(recording) == (recording, "")


def test_clouds_that_were_drawn_with_repetition_have_no_points_at_one_place() -> None:
    drawn = X[0][RNG.integers(0, 289, 2500)]
    assert not at_one_place(drawn).any()
    assert at_one_place(np.concatenate([drawn, np.ones((200, 3))])).sum() == 200


def test_a_wrong_unit_or_pose_is_said_and_a_frame_without_points_refused() -> None:
    away = made_up([x + [5, 0, 0] for x in X], TIMES, PATH, TIMES)
    kept, words = without_strays(away)
    assert kept is away and "pose or unit is wrong, they are kept" in words
    empty = made_up([*X[:15], np.tile(CAMERA, (300, 1))], TIMES, PATH, TIMES)
    with pytest.raises(ValueError, match="made_up: frame 15: no point is left of 300: .*export"):
        without_strays(empty)


def test_evaluate_and_estimate_read_what_is_left_and_say_so(tmp_path: Path, capsys) -> None:
    save(lift(np.tile(CAMERA, (200, 1))), tmp_path / "lift.npz")
    with pytest.warns(UserWarning, match=r"made_up: left out: 40.9% of the points are many at one"):
        (recording,) = open_recordings([tmp_path / "lift.npz"])
    assert not strays(recording)["repeats"].any()
    assert cli(["check", str(tmp_path / "lift.npz")]) == 1
    line = "repeats: 40.9% of the points are many at one place, about [0.2, -0.6, 0.8] m: 0.409"
    assert line in capsys.readouterr().out


def test_conversion_says_what_is_no_measurement_also_where_repeats_are_dropped(tmp_path) -> None:
    folder = lab(tmp_path, "lift_camel_1")
    files = sorted((folder / "lift_camel_1").glob("*.npy"))
    for file, x in zip(files, X, strict=False):
        nothing = np.full((40, 3), np.nan)
        np.save(file, np.concatenate([x, x, np.full((200, 3), 0.5), nothing]).astype(np.float32))
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["scenarios"]["lift"]["drop_repeats"] = True
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.warns(
        UserWarning, match=r"lift_camel_1: 4\.9% of the points are NaN, not measured: left out"
    ):
        (line,) = convert(folder, tmp_path / "out")
    assert (
        "; suspicious  repeats: 40.9% of the points are many at one place, about [0.5, 0.5, 0.5] m"
        in line
    )
    assert len(cloud(load(tmp_path / "out/lift_camel_1.npz"), 0)) == 489


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1e3, r"in millimetres\? Multiply cloud.scale by 0.001"),
        (100.0, r"in centimetres\? Multiply cloud.scale by 0.01"),
        (1 / 0.0254, r"in inches\? Multiply cloud.scale by 0.0254"),
        (1e-3, r"in metres, not mm\? Multiply cloud.scale by 1000"),
    ],
)
def test_clouds_in_another_unit_are_asked_about(tmp_path: Path, factor: float, words: str) -> None:
    folder = lab(tmp_path, "lift_camel_1")
    for file, x in zip(sorted((folder / "lift_camel_1").glob("*.npy")), X, strict=False):
        np.save(file, factor * x)
    with pytest.raises(ValueError, match=f"lift_camel_1: its points ext.*{words}"):
        list(convert(folder, tmp_path / "out"))
    assert not list((tmp_path / "out").glob("*.npz"))


@pytest.mark.parametrize("scene", [X[0], 0.3 * X[0], 8 * X[0], np.ones((5, 3))])
def test_a_part_of_a_sheet_and_a_room_pass(scene: np.ndarray) -> None:
    check_unit(Path("lift"), scene, PLACE.size)


@pytest.mark.parametrize("count", [31, 41])
@pytest.mark.parametrize("moves", [False, True])
def test_a_regular_grid_is_not_cropped_at_its_borders(count: int, moves: bool) -> None:
    side = np.linspace(0, 0.4, count)
    flat = np.stack(np.meshgrid(side, side, [0.0]), axis=-1).reshape(-1, 3)
    ups = height(TIMES) if moves else 0 * TIMES
    clouds = [flat + np.outer((flat[:, 0] < 0.2) * (1 - flat[:, 0] / 0.2), [0, 0, u]) for u in ups]
    path = np.stack([c[:1] for c in clouds])
    grid = made_up(clouds, TIMES, path, TIMES)
    assert not {name for name in suspicious(grid) if name.startswith("crop")}
    cut = made_up([c[c[:, 0] < 0.33] for c in clouds], TIMES, path, TIMES)
    assert "crop x" in suspicious(cut)
