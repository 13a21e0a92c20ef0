"""RGB-D folders to clouds: there and back, cameras that are merged, paired and cleaned."""

from dataclasses import asdict, replace
from pathlib import Path

import jax.random as jr
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rgbd_scene import INFO, PATH, TIMES, camera, distances, rig, surface, write

from r2s._util.files import write_json
from r2s.materials import presets
from r2s.recordings.clouds import Cleaning, clean, inside, outliers
from r2s.recordings.images import encode_png, read_mask
from r2s.recordings.recording import cloud
from r2s.recordings.rgbd import Rig, pair, read_clouds, read_rig, rgbd_recording, stream
from r2s.recordings.synthetic_rgbd import NONE, write_rgbd
from r2s.recordings.views import Views
from r2s.scenarios import synthetic
from r2s.scenarios.scenario import from_recording, rollout
from r2s.scenarios.standard import SCENARIOS


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rgbd")
    write(folder)
    return folder


def test_a_flawed_recording_lies_on_its_surface(folder: Path) -> None:
    info = replace(INFO, time_offset=-0.02)
    recording = rgbd_recording(folder, info, PATH, np.arange(4) / 10)
    np.testing.assert_allclose(recording.times, TIMES - 0.02, atol=1e-6)
    for frame in range(len(TIMES)):
        points = cloud(recording, frame)
        error = distances(points, surface(frame))
        assert len(points) > 2000
        assert error.mean() < 2e-3 and np.median(error) < 1e-3


def test_frames_are_read_one_at_a_time_and_thinned_by_a_seed(tmp_path: Path) -> None:
    scene = write(tmp_path)
    some = [replace(scene, clean=replace(scene.clean, max_points=300, seed=s)) for s in (1, 1, 2)]
    frames, again, other = (stream(tmp_path, thin) for thin in some)
    first = next(frames)[1]
    assert first.shape == (300, 3)
    np.testing.assert_array_equal(first, next(again)[1])
    assert (first != next(other)[1]).any()
    (tmp_path / "right" / "depth" / "002.png").write_bytes(b"")
    next(frames)
    with pytest.raises(ValueError, match="right/depth/002.png"):
        next(frames)


def test_without_masks_the_table_is_cut_off(tmp_path: Path) -> None:
    scene = rig(table=(0.0, 0.02))
    cameras = {name: replace(view, masks=False) for name, view in scene.cameras.items()}
    scene = replace(scene, cameras=cameras)
    write(tmp_path, scene, flaws=replace(NONE, noise=1e-3))
    for frame, (_, points) in enumerate(stream(tmp_path, scene)):
        assert np.median(distances(points, surface(frame))) < 1e-3
        assert np.mean(distances(points, surface(frame)) > 0.01) < 0.02


def test_cameras_are_paired_by_time(tmp_path: Path) -> None:
    """A camera that started a frame later has its pictures under other numbers."""
    scene = write(tmp_path)
    for kind in ("depth", "masks"):
        (tmp_path / "right" / kind / "000.png").unlink()
    (tmp_path / "right" / "times.csv").write_text("".join(f"{t + 0.004}\n" for t in TIMES[1:]))
    times, clouds = read_clouds(tmp_path, scene)
    np.testing.assert_allclose(times, [0, *(TIMES[1:] + 0.002)], atol=1e-6)
    for frame, points in enumerate(clouds):
        assert distances(points, surface(frame)).mean() < 2e-3


def test_a_camera_that_lost_its_first_image_keeps_its_times(tmp_path: Path) -> None:
    """All cameras number their frames alike, where a rate gives the times."""
    scene = replace(write(tmp_path), frame_rate=15.0)
    for side in ("left", "right"):
        (tmp_path / side / "times.csv").unlink(missing_ok=True)
    for kind in ("depth", "masks"):
        (tmp_path / "right" / kind / "000.png").unlink()
    with pytest.warns(UserWarning, match="1 of 4 frames are missing"):
        _, clouds = read_clouds(tmp_path, scene)
    for frame, points in enumerate(clouds):
        assert distances(points, surface(frame)).mean() < 2e-3


def out_of_phase(folder: Path, scene: Rig) -> None:
    (folder / "right" / "times.csv").write_text("".join(f"{t + 0.03}\n" for t in TIMES))


def test_cameras_out_of_phase_are_known_frame_by_frame(tmp_path: Path) -> None:
    scene = write(tmp_path)
    out_of_phase(tmp_path, scene)
    views = Views(tuple(scene.cameras.values()), scene.clean)
    info = replace(INFO, frames_used=(0, 7), views=views)
    made = rgbd_recording(tmp_path, info, PATH, np.arange(4) / 10)
    assert made.info.views is not None and made.info.views.taken == ((0,), (1,)) * 4
    one = replace(info, views=replace(views, cameras=views.cameras[:1]))
    with pytest.raises(ValueError, match="out of phase: its views must have those of cameras.json"):
        rgbd_recording(tmp_path, one, PATH, np.arange(4) / 10)


def test_a_camera_out_of_phase_may_miss_the_fabric_alone(tmp_path: Path) -> None:
    scene = write(tmp_path)
    out_of_phase(tmp_path, scene)
    (tmp_path / "right/masks/001.png").write_bytes(encode_png(np.zeros((120, 160), np.uint8)))
    missing = replace(scene.cameras["right"], may_miss=True)
    scene = replace(scene, cameras={**scene.cameras, "right": missing})
    info = replace(INFO, frames_used=(2, 7))
    with pytest.warns(UserWarning, match="1 of 8 frames show no fabric, the first is 3: left out"):
        made = rgbd_recording(tmp_path, info, PATH, np.arange(4) / 10, rig=scene)
    kept = np.delete(np.sort([*TIMES, *(TIMES + 0.03)]), 3)
    np.testing.assert_allclose(made.times, kept, atol=1e-6)
    assert made.info.frames_used == (2, 6)


@pytest.mark.parametrize(("off", "fits"), [(1e-6, True), (4e-4, True), (5e-3, False)])
def test_masks_belong_to_the_nearest_depth_image(tmp_path: Path, off: float, fits: bool) -> None:
    """Where both have times in their names, of which one was rounded."""
    scene = write(tmp_path)
    for name in scene.cameras:
        (tmp_path / name / "times.csv").unlink()
        for kind, late in (("depth", 0.0), ("masks", off)):
            for file, time in zip(sorted((tmp_path / name / kind).iterdir()), TIMES, strict=True):
                file.rename(file.with_name(f"{1700000100 + time + late:.6f}.png"))
    if fits:
        for frame, (_, points) in enumerate(stream(tmp_path, scene)):
            assert distances(points, surface(frame)).mean() < 2e-3
    else:
        with pytest.raises(ValueError, match="left/masks: no image that belongs to"):
            next(stream(tmp_path, scene))


def test_a_mask_may_have_a_palette(folder: Path, tmp_path: Path) -> None:
    """As SAM 2 writes it: the colours mean nothing, black is the background."""
    from PIL import Image

    mask = np.zeros((12, 16), np.uint8)
    mask[3:6, 4:9] = 2
    picture = Image.fromarray(mask, "P")
    picture.putpalette([0, 0, 0, 128, 0, 0, 0, 0, 128])
    picture.save(tmp_path / "000.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "000.png", (16, 12)), mask > 0)


@given(
    gaps=st.lists(st.floats(0.01, 0.2), min_size=2, max_size=20),
    shift=st.floats(-0.004, 0.004),
    starts_late=st.booleans(),
)
def test_frames_within_the_tolerance_are_one_and_others_stand_alone(gaps, shift, starts_late):
    clock = np.cumsum(gaps)
    other = clock[int(starts_late) :] + shift
    times = {"a": clock, "b": other}
    frames = pair(times, 0.005)
    assert np.all(np.diff([time for time, _ in frames]) > 0)
    for time, chosen in frames:
        assert all(abs(times[name][index] - time) <= 0.005 for name, index in chosen.items())
    for name, ticks in times.items():  # every frame is there, once
        assert [chosen[name] for _, chosen in frames if name in chosen] == list(range(len(ticks)))
    assert sum(len(chosen) == 2 for _, chosen in frames) == len(other)


def test_cameras_out_of_phase_and_of_different_rates_keep_their_times():
    frames = pair({"a": np.arange(4) / 10, "b": 0.02 + np.arange(7) / 20})
    assert len(frames) == 11 and all(len(chosen) == 1 for _, chosen in frames)
    np.testing.assert_allclose([time for time, _ in frames][:4], [0, 0.02, 0.07, 0.1])


def test_cameras_of_a_set_lie_above_its_recordings(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no cameras.json there or in the folder above"):
        read_rig(tmp_path / "lift_a")
    write_json(tmp_path / "cameras.json", asdict(rig()))
    (tmp_path / "lift_a").mkdir()
    assert read_rig(tmp_path / "lift_a") == rig()
    own = Rig({"one": camera((0.5, 0.5, 0.5))}, rig().clean, frame_rate=30.0)
    write_json(tmp_path / "lift_a" / "cameras.json", asdict(own))
    assert read_rig(tmp_path / "lift_a") == own


POINTS = arrays(float, st.tuples(st.integers(0, 40), st.just(3)), elements=st.floats(-2, 2))


@given(points=POINTS, voxel=st.sampled_from([0.0, 0.1]), most=st.integers(0, 20))
@settings(max_examples=60)
def test_what_is_cleaned_is_in_the_box_and_not_too_much(
    points: np.ndarray, voxel: float, most: int
) -> None:
    box = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    how = Cleaning(box, table=(0.0, 0.2), voxel=voxel, max_points=most)
    kept = clean(points, how, frame=0)
    assert inside(kept, how).all()
    assert (np.abs(kept[:, 2]) > 0.2 - 1e-9).all()
    assert len(kept) <= (most or len(points))
    np.testing.assert_array_equal(kept, clean(points, how, frame=0))


def test_lone_points_are_outliers() -> None:
    sheet = np.stack(np.meshgrid(np.arange(30), np.arange(30), [0.0]), axis=-1).reshape(-1, 3)
    lone = np.array([[10.0, 10, 8], [-9, 0, 0]])
    found = outliers(np.concatenate([sheet, lone]), 8, 3.0)
    assert found[-2:].all() and not found[:-2].any()
    assert not outliers(sheet[:5], 8, 3.0).any()


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize("motion_of", ["lifting", "folding"])
def test_a_simulated_fabric_comes_back_within_2_mm(motion_of: str, tmp_path: Path) -> None:
    """Two 720p cameras with the flaws of real ones, a soft sheet that is lifted or folded."""
    fabric = presets.grey_interlock()
    recorded = synthetic.record(SCENARIOS[motion_of](), fabric, "grey", key=jr.key(0))
    scenario = from_recording(recorded, (17, 17))
    moved = np.asarray(rollout(scenario, fabric).x)[::10]
    faces, times = np.asarray(scenario.scene.mesh.faces), np.asarray(recorded.times)[::10]
    positions = {"left": (-0.5, -0.1, 0.5), "right": (0.1, -0.4, 0.9)}
    views = {n: camera(p, resolution=(1280, 720)) for n, p in positions.items()}
    box = Cleaning(((-0.2, -0.2, -0.05), (0.7, 0.7, 0.7)))
    write_rgbd(tmp_path, Rig(views, box), moved, faces, times)
    means = []
    for (_, points), x in zip(stream(tmp_path, read_rig(tmp_path)), moved, strict=True):
        means.append(distances(points, x, faces).mean())
    assert max(means) < 2e-3
