"""Pictures of recordings: written, of the right frames, and errors that name the file."""

from pathlib import Path

import numpy as np
import pytest
from recorded_lift import FRAMES, cloth, lab, recorded

pytest.importorskip("matplotlib")
from matplotlib.figure import Figure  # noqa: E402
from PIL import Image  # noqa: E402

from r2s.recordings.open import (
    SimulatedCloth,
    load_trajectory,
    open_recording,
    save_trajectory,
)
from r2s.recordings.recording import frame_durations, save
from r2s.viewer.pictures import _draw_force, contact_sheet, pictures, show, write_gif, write_mp4


def colours(path: Path) -> set[tuple[int, int, int]]:
    pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
    return set(map(tuple, np.unique(pixels, axis=0).tolist()))


def test_a_sheet_and_a_gif_are_written(tmp_path: Path) -> None:
    written = show(recorded(), tmp_path / "new" / "folder", video="gif")
    assert [path.name for path in written] == ["lift_made.png", "lift_made.gif"]
    assert sorted(written) == sorted((tmp_path / "new" / "folder").iterdir())
    with Image.open(written[1]) as video:
        frame_durations = []
        for frame in range(getattr(video, "n_frames", 1)):
            video.seek(frame)
            frame_durations.append(video.info["duration"])
    assert frame_durations == [70, 60, 70, 70, 60]  # [ms]: 5/15 s in all
    assert (0xD5, 0x5E, 0x00) in colours(written[0])  # the cloud


def test_the_cloth_is_drawn_over_it_and_markers_too(tmp_path: Path) -> None:
    without = show(recorded(), tmp_path / "without", video="none")
    assert len(without) == 1
    with_cloth = contact_sheet(tmp_path / "with.png", recorded(), cloth())

    def blue(path):
        return sum(b > r + 60 for r, _, b in colours(path))

    assert blue(with_cloth) > 5 + blue(without[0])
    markers = np.full((FRAMES, 4, 3), 0.1)
    seen = np.array([True, True, False, True])[None].repeat(FRAMES, axis=0)
    marked = recorded(markers=markers, markers_seen=seen)
    drawn = contact_sheet(tmp_path / "marked.png", marked)
    assert drawn.read_bytes() != without[0].read_bytes()


@pytest.mark.parametrize("vector", [False, True])
def test_the_force_is_drawn_below(tmp_path: Path, vector: bool) -> None:
    """Its curve as the log has it; dots only at frames that the log reaches."""
    times = np.linspace(0.1, 1.0, 50)
    force = 3 * times
    log = np.outer(force, [0.6, 0.0, -0.8]) if vector else force
    pulled = recorded(force=log, force_times=times)
    axes = Figure().add_subplot()
    _draw_force(axes, pulled, list(range(FRAMES)))
    curve, dots = (np.asarray(line.get_ydata(), float) for line in axes.lines)
    np.testing.assert_allclose(curve, force, rtol=1e-12)
    expected = np.where(np.arange(FRAMES) / 15 < 0.1, np.nan, np.arange(FRAMES) / 5)
    np.testing.assert_allclose(dots, expected, rtol=1e-12)
    assert axes.get_xlim()[1] < 0.3  # the frames end long before the log
    heights = [
        Image.open(contact_sheet(tmp_path / "sheet.png", recording)).height
        for recording in (recorded(), pulled)
    ]
    assert heights[1] > heights[0] + 100
    frames = list(pictures(pulled))
    assert len(frames) == FRAMES and all(side % 2 == 0 for side in frames[0].shape[:2])
    assert (frames[2][-160:] != frames[3][-160:]).any()  # the dot moves


def test_a_video_of_opencv(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    written = show(recorded(3), tmp_path, video="mp4")
    capture = cv2.VideoCapture(str(written[1]))
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 3
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(15, abs=0.01)


def test_videos_go_by_the_frames_times(tmp_path: Path) -> None:
    """The third of four frames was dropped."""
    cv2 = pytest.importorskip("cv2")
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=2)
    frames = [np.roll(grey, 5 * n, axis=0) for n in range(3)]
    lasting = frame_durations(np.array([0.0, 0.1, 0.3]))
    np.testing.assert_allclose(lasting, [0.1, 0.2, 0.15])
    write_gif(tmp_path / "v.gif", frames, lasting)
    with Image.open(tmp_path / "v.gif") as video:
        shown = []
        for frame in range(3):
            video.seek(frame)
            shown.append(video.info["duration"])
    assert shown == [100, 200, 150]  # [ms]
    write_mp4(tmp_path / "v.mp4", frames, lasting)
    capture = cv2.VideoCapture(str(tmp_path / "v.mp4"))
    seconds = capture.get(cv2.CAP_PROP_FRAME_COUNT) / capture.get(cv2.CAP_PROP_FPS)
    assert seconds == pytest.approx(0.45, abs=0.02)


def test_a_cloth_that_flew_off_does_not_spoil_the_picture(tmp_path: Path) -> None:
    lost = cloth()
    lost.x[2:] = 1e6
    lost.x[3:] = np.nan
    contact_sheet(tmp_path / "lost.png", recorded(), lost)
    assert len(list(pictures(recorded(3), SimulatedCloth(lost.x[:3], lost.faces)))) == 3
    with pytest.raises(ValueError, match="trajectory has 4 frames, the recording lift_made 5"):
        show(recorded(), tmp_path, cloth(4))


def test_a_trajectory_is_read_back(tmp_path: Path) -> None:
    file = tmp_path / "trajectory.npz"
    save_trajectory(file, cloth().x, cloth().faces)
    np.testing.assert_array_equal(load_trajectory(file).x, cloth().x)
    np.testing.assert_array_equal(load_trajectory(file).faces, cloth().faces)


@pytest.mark.parametrize(
    "arrays, words",
    [
        ({"x": cloth().x}, "lacks the arrays faces"),
        ({"x": cloth().x[0], "faces": cloth().faces}, "expected x .frame, vertex, 3"),
        ({"x": cloth().x, "faces": cloth().faces + 1}, "faces must be numbers of the 4 vertices"),
        ({"x": cloth().x, "faces": cloth().faces * 1.0}, "faces must be numbers"),
    ],
)
def test_a_trajectory_that_is_none_names_the_file(tmp_path: Path, arrays, words: str) -> None:
    np.savez(tmp_path / "t.npz", **arrays)
    with pytest.raises(ValueError, match=f"t.npz: .*{words}"):
        load_trajectory(tmp_path / "t.npz")


def test_recordings_are_opened_by_what_they_are(tmp_path: Path) -> None:
    save(recorded(), tmp_path / "made.npz")
    assert open_recording(tmp_path / "made.npz").info.name == "lift_made"
    folder = lab(tmp_path, "lift_camel_1")
    assert open_recording(folder / "lift_camel_1").info.fabric == "camel"
    assert open_recording(folder).info.trial == "1"
    (folder / "lift_denim_1").mkdir()
    with pytest.raises(ValueError, match="name one of its recordings.*lift_camel_1, lift_denim_1"):
        open_recording(folder)
    with pytest.raises(FileNotFoundError, match="nowhere: no such recording"):
        open_recording(tmp_path / "nowhere")
