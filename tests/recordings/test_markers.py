"""Markers on rendered videos of a stretch: kept, exact, lost and found; planes; broken input."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2")

from r2s.recordings.images import read_grey  # noqa: E402
from r2s.recordings.markers import (  # noqa: E402
    Tracks,
    detect,
    find_grid,
    on_table,
    plane_homography,
    to_metres,
    track,
)

SIZE = (1280, 720)  # [px]
PITCH, RADIUS = 0.045, 0.006  # [m], of a sheet of 0.45 m
CORNERS = np.array([[0.0, 0.0], [0.8, 0.0], [0.8, 0.5], [0.0, 0.5]])  # [m], on the table
IN_IMAGE = np.array([[105.0, 50.0], [1190.0, 20.0], [1240.0, 690.0], [60.0, 660.0]])  # [px]
TO_IMAGE = cv2.getPerspectiveTransform(np.float32(CORNERS), np.float32(IN_IMAGE))


def stretched(strain: float, shape=(9, 9), poisson: float = 0.3) -> np.ndarray:
    """Where the markers are, [m], when the sheet is pulled along x from its clamp at x = 0.12."""
    row, column = np.meshgrid(*map(np.arange, shape), indexing="ij")
    x = 0.15 + PITCH * column * (1 + strain)
    y = 0.25 + PITCH * (row - (shape[0] - 1) / 2) * (1 - poisson * strain)
    return np.stack([x, y], axis=-1).reshape(-1, 2)


@lru_cache(maxsize=2)
def scene(camera: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where on the table each pixel looks, [m], and how bright the lamp is there."""
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    back = np.linalg.inv(np.frombuffer(camera).reshape(3, 3)).astype(np.float32)
    w = back[2, 0] * x + back[2, 1] * y + back[2, 2]
    px = (back[0, 0] * x + back[0, 1] * y + back[0, 2]) / w
    py = (back[1, 0] * x + back[1, 1] * y + back[1, 2]) / w
    light = 0.55 + 0.35 * x / SIZE[0] + 0.25 * np.exp(-(((x - 400) / 300) ** 2) - (y / 400) ** 2)
    return px, py, light


def render(strain: float, camera=TO_IMAGE, seed=0, shape=(9, 9), poisson=0.3, noise=4.0, blur=1.2):
    """A grey photograph of the sheet, with lamp, blur and noise."""
    px, py, light = scene(camera.tobytes())
    column = (px - 0.15) / (PITCH * (1 + strain))  # of the cloth, in units of its pitch
    row = (py - 0.25) / (PITCH * (1 - poisson * strain)) + (shape[0] - 1) / 2
    near_row = np.clip(np.rint(row), 0, shape[0] - 1)
    near_column = np.clip(np.rint(column), 0, shape[1] - 1)
    away = np.hypot(row - near_row, column - near_column) * PITCH
    pixel = 0.8 / SIZE[0]  # [m]
    dot = np.clip((RADIUS - away) / pixel + 0.5, 0, 1)
    cloth = (row > -0.8) & (row < shape[0] - 0.2) & (column > -1.0) & (column < shape[1])
    image = np.where(cloth, 190 - 140 * dot, 110)  # on a grey table
    clamp = cloth & ((column < -0.55) | (column > shape[1] - 0.45))
    image[clamp] = 60
    image = cv2.GaussianBlur((image * light).astype(np.float32), (0, 0), blur)
    image += noise * np.random.default_rng(seed).standard_normal(image.shape, np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def in_image(metres: np.ndarray, camera=TO_IMAGE) -> np.ndarray:
    return cv2.perspectiveTransform(metres[None].astype(np.float64), camera)[0]


def strains(count: int = 60) -> np.ndarray:
    """Pulled by 12 %, smoothly, and held for the last third."""
    progress = np.clip(np.arange(count) / (2 * count / 3), 0, 1)
    return 0.12 * progress**2 * (3 - 2 * progress)


@pytest.fixture(scope="module")
def pull() -> list[np.ndarray]:
    return [render(strain, seed=i) for i, strain in enumerate(strains())]


def error(tracks: Tracks, truth: np.ndarray) -> float:
    off = np.linalg.norm(tracks.pixels - truth, axis=-1)[tracks.seen]
    return float(np.sqrt(np.mean(off**2)))


TRUTH = np.stack([in_image(stretched(strain)) for strain in strains()])


@pytest.mark.slow(group="motions")
def test_all_markers_are_kept_to_a_fifth_of_a_pixel(pull: list[np.ndarray]) -> None:
    tracks = track(pull)
    assert tracks.seen.all() and tracks.pixels.shape == (60, 81, 2)
    assert error(tracks, TRUTH) < 0.2


def test_the_strain_comes_back_in_metres(pull: list[np.ndarray]) -> None:
    tracks = track([pull[0], *pull[8:60:8], pull[-1]])
    metres = to_metres(plane_homography(IN_IMAGE, CORNERS), tracks.pixels)
    expected = np.stack([stretched(s) for s in strains()[[0, *range(8, 60, 8), 59]]])
    assert np.sqrt(np.mean((metres - expected) ** 2)) < 2e-4  # [m]
    grid = metres[-1].reshape(9, 9, 2)
    along = np.diff(grid[..., 0], axis=1).mean() / PITCH - 1
    across = np.diff(grid[..., 1], axis=0).mean() / PITCH - 1
    assert along == pytest.approx(0.12, abs=1e-3)
    assert across == pytest.approx(-0.036, abs=1e-3)
    assert on_table(metres, 0.01).shape == (9, 81, 3)


@pytest.mark.slow(group="motions")
def test_covered_markers_are_reported_and_found_again(pull: list[np.ndarray]) -> None:
    frames, covered = [], []
    for i, image in enumerate(pull):
        image = image.copy()
        if 12 <= i < 36:  # a dark cable over two columns, and a bright hand that wanders
            left = 500 + 4 * (i - 12)
            cv2.rectangle(image, (left, 0), (left + 90, SIZE[1]), 35, -1)
            cv2.circle(image, (300 + 3 * i, 500), 60, 150, -1)
        frames.append(image)
        covered.append(image != pull[i])
    tracks = track(frames)
    assert tracks.seen[:12].all() and tracks.seen[37:].all()
    assert not tracks.seen[20].all()
    assert error(tracks, TRUTH) < 0.25
    assert np.isnan(tracks.pixels[~tracks.seen]).all()
    # what is covered in the middle is not seen, what is clear of covers by a dot's width is
    for i in range(12, 36):
        x, y = np.rint(TRUTH[i]).astype(int).T
        wide = cv2.dilate(covered[i].astype(np.uint8), np.ones((41, 41), np.uint8))
        assert not tracks.seen[i][covered[i][y, x]].any()
        assert tracks.seen[i][wide[y, x] == 0].all()


@pytest.mark.parametrize("angle", [-35.0, 40.0, 170.0])
def test_a_turned_camera_keeps_the_order_or_an_origin_tells_it(angle: float) -> None:
    """Bright dots on dark cloth, by a camera turned about the middle of its image."""
    turn = cv2.getRotationMatrix2D((SIZE[0] / 2, SIZE[1] / 2), angle, 0.75)
    camera = np.vstack([turn, [0, 0, 1]]) @ TO_IMAGE
    frames = [255 - render(s, camera, seed=7, noise=2.0) for s in (0.0, 0.02)]
    truth = np.stack([in_image(stretched(s), camera) for s in (0.0, 0.02)])
    upside_down = error(track(frames, dark=False), truth) > 100
    assert upside_down == (angle > 90)
    assert error(track(frames, dark=False, origin=tuple(truth[0, 0])), truth) < 0.3


def test_a_grid_that_is_no_square() -> None:
    shape = (5, 8)
    frames = [render(s, seed=3, shape=shape) for s in (0.0, 0.01)]
    truth = np.stack([in_image(stretched(s, shape)) for s in (0.0, 0.01)])
    tracks = track(frames, shape)
    assert tracks.seen.shape == (2, 40) and error(tracks, truth) < 0.2
    with pytest.raises(ValueError, match="has not 5 rows and 8 columns.*swap"):
        track(frames, shape, origin=tuple(truth[0, 7]))


def test_off_the_grid_is_no_marker(pull: list[np.ndarray]) -> None:
    image = pull[0].copy()
    for x, y in ((60, 40), (90, 690), (1200, 350), (1000, 40)):
        cv2.circle(image, (x, y), 8, 30, -1)
    centres, _ = detect(image)
    assert len(centres) >= 84
    grid = find_grid(centres, (9, 9))
    assert np.linalg.norm(centres[grid] - TRUTH[0], axis=1).max() < 0.6


@pytest.mark.slow(group="motions")
@pytest.mark.parametrize(
    "noise, blur, limit", [(10.0, 1.2, 0.15), (10.0, 2.5, 0.2), (20.0, 2.0, 0.3), (4.0, 4.0, 0.2)]
)
def test_worse_pictures(noise: float, blur: float, limit: float) -> None:
    frames = [render(s, seed=i, noise=noise, blur=blur) for i, s in enumerate(strains())]
    tracks = track(frames)
    assert tracks.seen.mean() > 0.999 and error(tracks, TRUTH) < limit


def test_what_is_wrong_names_the_frame(pull: list[np.ndarray]) -> None:
    first, blank = pull[0], np.full((720, 1280), 128, np.uint8)
    covered = first.copy()
    cv2.circle(covered, tuple(np.rint(TRUTH[0, 40]).astype(int).tolist()), 20, 190, -1)
    for frames, shape, words in (
        ([], (9, 9), "there are no frames"),
        ([blank], (9, 9), "frame 0: no round dots"),
        ([covered], (9, 9), "frame 0: expected a grid of 9 x 9 markers, found 80"),
        ([first], (8, 8), "frame 0: more than one grid of 8 x 8"),
        ([first, blank], (9, 9), "frame 1: (only 0 of 81|no round dots)"),
        ([first, np.roll(first, 31, axis=0)], (9, 9), "frame 1: only .* moved by more than"),
    ):
        with pytest.raises(ValueError, match=words):
            track(frames, shape)


def test_a_plane_needs_four_points_that_fit() -> None:
    found = plane_homography(IN_IMAGE, CORNERS)
    np.testing.assert_allclose(to_metres(found, IN_IMAGE), CORNERS, atol=1e-9)
    assert np.isnan(to_metres(found, np.full((1, 2), np.nan))).all()
    with pytest.raises(ValueError, match="at least four points.*found 3"):
        plane_homography(IN_IMAGE[:3], CORNERS[:3])
    with pytest.raises(ValueError, match="points in the table lie on a line"):
        plane_homography(IN_IMAGE, CORNERS * [1.0, 0.0])
    five = np.vstack([CORNERS, [[0.4, 0.2]]])
    seen = in_image(five)
    with pytest.raises(ValueError, match="misses point .* mm: two points are swapped"):
        plane_homography(seen[[0, 1, 2, 4, 3]], five)


def write_images(folder: Path, images: list[np.ndarray]) -> None:
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / f"frame_{i:03d}.png"), image)


def test_images_and_videos_give_the_same_markers(tmp_path: Path, pull: list[np.ndarray]) -> None:
    write_images(tmp_path, pull[:4])
    (tmp_path / "notes.txt").write_text("passed over")
    np.testing.assert_array_equal(list(read_grey(tmp_path)), pull[:4])
    video = tmp_path / "pull.mp4"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, SIZE)
    for image in pull[:4]:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    tracks = track(read_grey(video))
    assert tracks.seen.all() and error(tracks, TRUTH[:4]) < 0.3


def test_broken_images_and_videos_are_named(tmp_path: Path, pull: list[np.ndarray]) -> None:
    def refused(path: Path, words: str) -> None:
        with pytest.raises((ValueError, FileNotFoundError), match=words):
            list(read_grey(path))

    refused(tmp_path / "nowhere.mp4", "nowhere.mp4: no such video")
    refused(tmp_path, "no numbered frames such as 000.png")
    (tmp_path / "text.mp4").write_text("no video")
    refused(tmp_path / "text.mp4", "text.mp4: no video that OpenCV can read")
    write_images(tmp_path, [image[:90, :160] for image in pull[:4]])
    file = tmp_path / "frame_001.png"
    file.write_bytes(file.read_bytes()[:500])
    refused(tmp_path, "frame_001.png: truncated PNG")
    cv2.imwrite(str(file), pull[1][:80, :160])
    refused(tmp_path, "frame_001.png: frame 1 has 160 x 80 pixels, the first")
    file.unlink()
    refused(tmp_path, r"frame 1 \(counted from the first\) is missing: restore it")
