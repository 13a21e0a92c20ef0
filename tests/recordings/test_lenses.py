"""Lenses: a pixel's ray is seen in that pixel, and pixels without a ray are named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rgbd_scene import camera, rig, write

from r2s.recordings.cameras import DepthCamera, project, rays
from r2s.recordings.images import read_depth, write_depth
from r2s.recordings.rgbd import read_clouds, stream
from r2s.recordings.views import render

WIDE = (4.7, 3.2, 1e-4, 1e-5, 0.17, 5.05, 4.77, 0.88)  # as a wide depth camera's calibration has
LENSES = {
    "five numbers": ("pinhole", (-0.3, 0.1, 1e-3, -1e-3, 0.0)),
    "rational": ("pinhole", WIDE),
    "thin prism": ("pinhole", (*WIDE, 2e-3, -1e-5, 3e-3, 1e-5)),
    "tilted": ("pinhole", (0.1, -0.05, 1e-3, 0.0, 0.02, *(0.0,) * 5, 1e-3, 0.0, 0.05, -0.03)),
    "fisheye": ("fisheye", (0.03, -0.01, 0.004, -0.001)),
    "ideal fisheye": ("fisheye", ()),
}


def lens(kind: str, numbers: tuple[float, ...], size: int = 120) -> DepthCamera:
    """A square image of 90 degrees to both sides of its middle, without distortion."""
    focal, middle = (size / 2, size / 2), (size / 2 - 0.5, size / 2 - 0.5)
    changes = dict(resolution=(size, size), focal_length=focal, centre=middle)
    return camera((0.2, -0.3, 0.6), **changes, lens=kind, distortion=numbers)


def there_and_back(view: DepthCamera) -> np.ndarray:
    """How far a pixel is from where its ray is seen, [px]; NaN where it has none."""
    directions = rays(view)
    seen = np.concatenate([directions, np.ones((*directions.shape[:2], 1))], axis=-1)
    pixels = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in view.resolution)), -1)
    return np.linalg.norm(project(view, np.nan_to_num(seen)) - pixels, axis=-1) + 0 * seen[..., 0]


@pytest.mark.parametrize("name", LENSES)
def test_a_ray_is_seen_in_its_pixel(name: str) -> None:
    off = there_and_back(lens(*LENSES[name]))
    assert np.isfinite(off).all() and off.max() < 0.01


def test_pixels_that_no_direction_reaches_have_no_ray() -> None:
    """A barrel whose radius grows to its largest, 0.61, at 0.91, and falls from there on."""
    view = lens("pinhole", (-0.4, 0.0, 0.0, 0.0))
    radius = np.linalg.norm((np.indices((120, 120)).T[..., ::-1] - 59.5) / 60, axis=-1)
    directions = rays(view)
    np.testing.assert_array_equal(np.isfinite(directions[..., 0]), radius < 0.6086)
    assert np.linalg.norm(directions, axis=-1)[radius < 0.6086].max() < 0.913
    assert np.nanmax(there_and_back(view)) < 0.01
    corners = np.array([[-5.0, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]])
    depth = render(view, corners, np.array([[0, 1, 2], [0, 2, 3]]))[0]
    assert (depth[radius < 0.6] > 0).all() and (depth[radius > 0.61] == 0).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lens": "wide"}, "lens must be one of .*pinhole.*fisheye"),
        (
            {"lens": "fisheye", "distortion": (0.1,) * 5},
            r"fisheye lens has one of \(0, 4\)",
        ),
        ({"distortion": (0.1,) * 6}, "distortion of a pinhole lens has one of"),
        ({"depth_along": "z"}, "depth_along must be 'axis' or 'ray', found 'z'"),
    ],
)
def test_unknown_lenses_are_refused(changes: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        camera((0.2, -0.3, 0.6), **changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("rgbd")
    write(made)
    return made


def with_left(**changes) -> dict:
    scene = rig()
    return {**scene.cameras, "left": replace(scene.cameras["left"], **changes)}


def test_the_share_of_pixels_without_a_ray_is_said_and_most_are_refused(folder: Path) -> None:
    bent = replace(rig(), cameras=with_left(distortion=(-0.7, 0.0, 0.0, 0.0)))
    with pytest.warns(
        UserWarning, match=r"left: .* give \d+\.\d% of the pixels no direction: left o"
    ):
        next(stream(folder, bent))
    with pytest.raises(ValueError, match='left: .* 9.*% of the pixels .*correct them.*"fisheye"'):
        next(stream(folder, replace(bent, cameras=with_left(distortion=(-9.0, 0.0, 0.0, 0.0)))))


def test_depth_along_the_ray_gives_the_points_of_depth_along_the_axis(folder, tmp_path) -> None:
    scene = rig(voxel=0.0, neighbours=0, edge=0.0)
    write(tmp_path, scene, seed=0)
    along = np.sqrt(1 + (rays(scene.cameras["left"]) ** 2).sum(axis=-1))
    for file in (tmp_path / "left/depth").iterdir():
        write_depth(file, read_depth(file, 1e-3, (160, 120)) * along, 1e-4)
    on_rays = replace(scene, cameras=with_left(depth_along="ray", depth_scale=1e-4))
    read, expected = (read_clouds(*each)[1][0] for each in ((tmp_path, on_rays), (folder, scene)))
    np.testing.assert_allclose(read, expected, atol=2e-4)
