"""What cuts the cloth out of a scene: each cut alone, refusals with their remedy, conversion."""

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
import whole_scene as scenes
from pypcd4.pypcd4 import PointCloud
from whole_scene import BEIGE, BLUE, GREEN, ORANGE, RED, SIDE

from r2s._util.files import parse, write_json
from r2s.recordings.clouds import Cleaning
from r2s.recordings.images import encode_png, read_colour
from r2s.recordings.manifest import default_manifest
from r2s.recordings.open import convert
from r2s.recordings.recording import RecordingInfo, SheetPlacement, cloud, load
from r2s.recordings.rgbd import Rig, read_clouds, rgbd_recording
from r2s.recordings.segmentation import (
    FATES,
    Arm,
    Segmentation,
    Segmenter,
    fit_table,
    held_piece,
    in_colour,
    read_colours,
)
from r2s.recordings.views import Views
from r2s.viewer.cuts import draw_cuts

UP = (0.0, 0.0, 1.0)
BLUES = ((200.0, 0.3, 0.1), (255.0, 1.0, 1.0))
BOX = ((-0.3, -0.3, -0.05), (0.7, 0.7, 0.9))
HANGS = SheetPlacement((SIDE, SIDE), (0.0, 0.2, 0.1), (1.0, 0.0, 0.0), UP, ("weft", "opposite"))
LIES = SheetPlacement((SIDE, SIDE), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), ("origin",))
PATH = np.array([[[0, 0.2, 0.5], [SIDE, 0.2, 0.5]]] * 2)
CUTS = Segmentation(
    table_margin=0.01, gripper_radius=0.015, arms=(Arm(UP, 0.05, 0.5, start=0.01),), link=0.025
)


def grid(low: Any, high: Any, spacing: float = 0.01) -> np.ndarray:
    axes = [np.arange(a, b + spacing / 2, spacing) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


CLOTH = grid((0, 0.2, 0.1), (SIDE, 0.2, 0.5))
TABLE = grid((-0.2, -0.1, 0), (0.6, 0.6, 0), 0.02)
ARM = grid((-0.02, 0.18, 0.51), (0.02, 0.22, 0.89), 0.02)
MUG = grid((0.1, 0.35, 0.02), (0.15, 0.4, 0.1))
PARTS = [(CLOTH, BLUE), (TABLE, BEIGE), (ARM, BEIGE), (ARM + [SIDE, 0, 0], BEIGE), (MUG, BLUE)]
POINTS = np.concatenate([points for points, _ in PARTS])
COLOURS = np.concatenate([np.tile(np.uint8(shade), (len(part), 1)) for part, shade in PARTS])


def segmenter(how: Segmentation = CUTS, sheet: SheetPlacement = HANGS, **more: Any) -> Segmenter:
    fields = {"table_height": 0.0, "gripper_path": PATH, "gripper_times": np.array([0.0, 1.0])}
    fields["where"] = "here"
    return Segmenter(how, sheet, **(fields | more))


def kept(how: Segmentation, points: np.ndarray = POINTS, **more: Any) -> Segmenter:
    """Of a frame, checked."""
    cutter = segmenter(how, **more)
    cutter(points, 0.5, COLOURS if len(points) == len(COLOURS) else ())
    cutter.check()
    return cutter


def test_each_cut_takes_its_own_and_the_cloth_is_left() -> None:
    cutter = segmenter()
    is_cloth = cutter(POINTS, 0.5, outside=7)
    cutter.check()
    counts = dict(zip(FATES, cutter.frames[0].counts, strict=True))
    assert counts["outside"] == 7 and counts["table"] == len(TABLE)
    assert counts["other pieces"] == len(MUG)
    assert counts["gripper"] < 15 and counts["arm"] > 2 * len(ARM) - 15
    assert is_cloth[: len(CLOTH)].mean() > 0.99 and not is_cloth[len(CLOTH) :].any()
    assert sum(counts.values()) == len(POINTS) + 7
    assert 0.9 < cutter.frames[0].area < 1.2 and 0.9 < cutter.frames[0].reach < 1.05


@pytest.mark.parametrize(
    "how",
    [
        replace(CUTS, colour=BLUES, arms=(), table_margin=0.0),
        replace(CUTS, workspace=((-1.0, 0.1, -1.0), (1.0, 0.3, 1.0)), table_margin=0.02),
        replace(CUTS, workspace=((-1.0, -1.0, 0.05), (1.0, 1.0, 0.5)), table_margin=0.0, arms=()),
        replace(CUTS, arms=tuple(Arm(UP, 0.05, 0.5, 0.01, (i,)) for i in (0, 1))),
    ],
    ids=["colour", "workspace", "workspace instead of table and arms", "an arm each"],
)
def test_other_cuts_leave_the_same_cloth(how: Segmentation) -> None:
    counts = kept(how).frames[0].counts
    assert abs(counts[-1] - len(CLOTH)) < 0.02 * len(CLOTH)


def test_cuts_are_made_in_the_world_of_the_recording() -> None:
    """Clouds in millimetres with y up, as `cloud` of a manifest says."""
    turned = 1e3 * POINTS[:, [0, 2, 1]] * [1, 1, -1]
    back = segmenter(to_world=lambda points: 1e-3 * points[:, [0, 2, 1]] * [1, -1, 1])
    np.testing.assert_array_equal(back(turned, 0.5), segmenter()(POINTS, 0.5))


@pytest.mark.parametrize("tilt", [0.0, 2.0, -5.0])
def test_the_plane_of_the_table_is_found_among_other_things(tilt: float) -> None:
    rise = np.tan(np.radians(tilt))
    noise = np.random.default_rng(0).normal(0, 1e-3, len(TABLE))
    table = TABLE + np.stack([0 * noise, 0 * noise, 0.01 + rise * TABLE[:, 0] + noise], axis=1)
    normal = fit_table(np.concatenate([table, CLOTH, MUG, MUG + [0.2, 0, 0]]), 0.03)
    assert np.degrees(np.arccos(normal[:3] @ [-rise, 0, 1] * np.cos(np.radians(tilt)))) < 0.2
    assert abs(normal[3] + 0.01 * normal[2]) < 1e-3


@pytest.mark.parametrize(
    ("limits", "inside"),
    [
        (((340.0, 0.5, 0.2), (15.0, 1.0, 1.0)), [True, False, False, False, False]),  # around 0
        (((200.0, 0.3, 0.2), (250.0, 1.0, 1.0)), [False, True, False, False, False]),
        (((0.0, 0.0, 0.8), (360.0, 0.1, 1.0)), [False, False, True, False, False]),  # any hue
        (((0.0, 0.0, 0.0), (360.0, 1.0, 0.2)), [False, False, False, True, False]),
        (((0.0, 1.0, 1.0), (0.0, 1.0, 1.0)), [False, False, False, False, True]),  # inclusive
    ],
)
def test_colours_are_within_limits(limits: Any, inside: list[bool]) -> None:
    colours = np.array([RED, BLUE, (240, 240, 235), (30, 30, 30), (255, 0, 0)], np.uint8)
    if limits[0][0] == 340:
        colours = colours[:4]
    np.testing.assert_array_equal(in_colour(colours, limits), inside[: len(colours)])


@pytest.mark.parametrize(
    ("gap", "touch", "expected"),
    [(0.03, 0.06, 1), (0.015, 0.06, 2), (0.03, 0.5, 1), (0.03, 0.001, 0)],
    ids=["apart", "linked", "the larger of two that touch", "none touches"],
)
def test_the_largest_piece_at_a_gripper_is_kept(gap: float, touch: float, expected: int) -> None:
    large, small = grid((0, 0, 0), (0.2, 0.2, 0)), grid((-0.1 - gap, 0, 0), (-gap, 0.2, 0))
    how = Segmentation(link=0.02, touch=touch)
    held = held_piece(np.concatenate([large, small]), np.array([[0.0, 0, 0.01]]), how)
    share = [1.0, 0.0] if expected == 1 else [expected / 2] * 2
    assert [held[: len(large)].mean(), held[len(large) :].mean()] == share


@pytest.mark.parametrize(
    ("change", "more", "words"),
    [
        ({"arms": (), "gripper_radius": 0.0}, {}, "covers 12.%.*gripper_radius, arms, .*or masks"),
        ({"table_margin": 0.0, "link": 0.12}, {}, "covers .*narrow the workspace"),
        (
            {"workspace": ((-1.0, -1.0, 0.45), (1.0, 1.0, 1.0))},
            {},
            "covers 1.%.*widen what cuts most",
        ),
        ({"link": 0.004}, {}, "covers 0%.*sparse points a greater link"),
        (
            {"workspace": ((5.0, 5.0, 5.0), (6.0, 6.0, 6.0)), "table_margin": 0.0},
            {},
            "left .outside 100",
        ),
        ({"colour": ((100.0, 0.5, 0.5), (140.0, 1.0, 1.0))}, {}, "no cloth is left .*other colour"),
        ({}, {"gripper_path": PATH + [0, 0, 1.0]}, "0.610 m from a gripper.*one clock"),
        ({}, {"table_height": 0.4}, "no table within 0.1 m of z = 0.4 m: correct table_height"),
        ({}, {"sheet": LIES}, "lies on the table.*give its colour, or masks"),
        ({"arms": (Arm(UP, 0.05, 0.5, grippers=(2,)),)}, {}, "grippers .2,.: there are 2, from 0"),
    ],
)
def test_what_is_no_sheet_is_refused_with_the_remedy(change, more, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        kept(replace(CUTS, **change), **more)


def test_frames_that_hide_the_cloth_are_few() -> None:
    """A tenth may show less of it, as when it turns its edge to a camera."""
    cutter, edge = segmenter(), np.concatenate([TABLE, CLOTH[CLOTH[:, 0] < 0.03]])
    for points in [POINTS] * 9 + [edge]:
        cutter(points, 0.5)
    cutter.check()
    cutter(edge, 0.5)
    with pytest.raises(ValueError, match="frame 9 at 0.5 s"):
        cutter.check()


def test_frames_that_are_not_used_may_show_no_sheet() -> None:
    """Such as those in which the gripper goes away; their points are kept as far as may be."""
    cutter = segmenter(used=(0.0, 0.5))
    for time, points in ((0.4, POINTS), (0.5, POINTS), (0.6, CLOTH + [0, 0, 0.4])):
        is_cloth = cutter(points, time)
    cutter.check()
    assert is_cloth.mean() > 0.5
    with pytest.raises(ValueError, match="no cloth is left"):
        segmenter()(np.concatenate([TABLE, CLOTH - [0, 0, 0.08]]), 0.5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"table_margin": -0.01}', "0 <= table_margin"),
        ('{"link": 0}', "0 < link"),
        ('{"gripper_radius": 0.1}', "gripper_radius < touch"),
        ('{"workspace": [[0, 0, 0], [1, 1, 0]]}', "least corner first"),
        ('{"colour": [[0, 100, 100], [20, 255, 255]]}', "saturation and value .to 1.*over 255"),
        ('{"colour": [[0, 0.5, 0.5], [20, 0.4, 1]]}', "least and greatest"),
        ('{"arms": [{"direction": [0, 0, 0], "radius": 0.1, "end": 1}]}', "needs a direction"),
        ('{"arms": [{"direction": [0, 0, 1], "radius": 0.1, "end": 0}]}', "end above start"),
        ('{"tabel": 0.01}', "unknown: tabel"),
    ],
)
def test_keys_are_checked(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse(Segmentation, json.loads(text), "cameras.json: segmentation")
    assert parse(Segmentation, json.loads(json.dumps(asdict(CUTS))), "here") == CUTS


def coloured_ply(path: Path, points: np.ndarray, colours: np.ndarray) -> None:
    trimesh.PointCloud(points, colours).export(path)


def coloured_pcd(path: Path, points: np.ndarray, colours: np.ndarray) -> None:
    packed = PointCloud.encode_rgb(colours)
    PointCloud.from_xyzrgb_points(np.column_stack([points, packed]).astype(np.float32)).save(path)


def meshed_ply(path: Path, points: np.ndarray, colours: np.ndarray) -> None:
    mesh = trimesh.Trimesh(points, [[0, 1, 2]], vertex_colors=colours, process=False)
    mesh.export(path)


@pytest.mark.parametrize(
    ("write", "suffix"), [(coloured_ply, "ply"), (meshed_ply, "ply"), (coloured_pcd, "pcd")]
)
def test_colours_of_clouds_are_read(tmp_path: Path, write, suffix: str) -> None:
    write(tmp_path / f"0.{suffix}", POINTS, COLOURS)
    np.testing.assert_array_equal(read_colours(tmp_path / f"0.{suffix}"), COLOURS)
    points = np.where(np.arange(len(POINTS))[:, None] % 5 == 0, np.nan, POINTS)  # nothing measured
    write(tmp_path / f"1.{suffix}", points, COLOURS)
    kept = COLOURS[np.arange(len(POINTS)) % 5 > 0]
    np.testing.assert_array_equal(read_colours(tmp_path / f"1.{suffix}"), kept)


def test_as_many_colours_as_points_are_needed() -> None:
    how = replace(CUTS, colour=BLUES)
    with pytest.raises(ValueError, match=f"5 colours of {len(POINTS)} points"):
        segmenter(how)(POINTS, 0.5, COLOURS[:5])


@pytest.mark.parametrize("kind", ["points", "mesh", "npy"])
def test_clouds_without_colours_are_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / ("0.npy" if kind == "npy" else "0.ply")
    if kind == "points":
        trimesh.PointCloud(POINTS).export(path)
    elif kind == "mesh":
        trimesh.Trimesh(POINTS, [[0, 1, 2]], process=False).export(path)
    with pytest.raises(ValueError, match="no colours: write ply or pcd .*leave out"):
        read_colours(path)


def test_colour_images_are_those_of_the_depth(tmp_path: Path) -> None:
    picture = np.zeros((12, 16, 3), np.uint8)
    picture[:6] = ORANGE
    for name in ("0.png", "0.jpg"):
        cv2.imwrite(str(tmp_path / name), picture[..., ::-1])
        read = read_colour(tmp_path / name, (16, 12))
        assert np.abs(read.astype(int) - picture).max() < 40
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[: len(data) - 80])
        with pytest.raises(ValueError, match=f"{name}.*truncated"):
            read_colour(tmp_path / name, (16, 12))
    (tmp_path / "1.png").write_bytes(encode_png(picture))
    with pytest.raises(ValueError, match="register colour to depth"):
        read_colour(tmp_path / "1.png", (32, 24))


def manifest(folder: Path, how: Segmentation | None, **changes: Any) -> Path:
    """A folder with the manifest of a sheet that hangs."""
    folder.mkdir(exist_ok=True)
    whole = json.loads((default_manifest().parent / "templates" / "study.json").read_text())
    fling = whole["scenarios"]["fling"] | {"frames_used": [0, 1], "sheet": asdict(HANGS)} | changes
    fling["segmentation"] = how and asdict(how)
    whole["scenarios"] = {"fling": fling}
    write_json(folder / "manifest.json", whole)
    np.save(folder / "fling_gripper.npy", PATH)
    return folder


def test_a_folder_of_coloured_clouds_is_converted(tmp_path: Path) -> None:
    how = replace(CUTS, colour=BLUES)
    views = Views(tuple(seen().values()), Cleaning(BOX))
    folder = manifest(tmp_path / "in", how, views=asdict(views))
    (folder / "fling_blue").mkdir()
    for frame in range(2):
        coloured_ply(folder / "fling_blue" / f"{frame}.ply", POINTS, COLOURS)
    drawn: list[Any] = []
    (line,) = convert(folder, tmp_path / "out", draw=lambda *what: drawn.append(what))
    assert "cuts: table" in line and "other colour" in line and "cloth" in line
    ((path, title, frames),) = drawn
    assert path == tmp_path / "out" / "fling_blue_cuts.png" and title == "fling_blue"
    assert len(frames) == 2
    recording = load(tmp_path / "out" / "fling_blue.npz")
    made, views = cloud(recording, 1), recording.info.views
    assert views is not None and views.hidden == CUTS.gripper_radius
    np.testing.assert_allclose(made.mean(axis=0), CLOTH.mean(axis=0), atol=2e-3)
    assert abs(len(made) - len(CLOTH)) < 0.02 * len(CLOTH)
    np.save(folder / "fling_gripper.npy", PATH + 1.0)
    with pytest.raises(ValueError, match="fling_blue: frame 0 at 0 s: no cloth is left"):
        list(convert(folder, tmp_path / "out", draw=lambda *what: drawn.append(what)))
    assert drawn[1][2][0].counts[-1] == 0  # which shows why it is refused


def test_cuts_are_drawn(tmp_path: Path) -> None:
    cutter = segmenter()
    cutter(POINTS[::10], 0.5, outside=3)
    draw_cuts(tmp_path / "cuts.png", "a scene", cutter.frames)
    picture = np.asarray(cv2.imread(str(tmp_path / "cuts.png")))
    assert picture.shape == (460, 1260, 3)
    for shade in ((213, 94, 0), (140, 140, 140)):  # of the cloth and the table
        assert (np.abs(picture[..., ::-1].astype(int) - shade).max(axis=2) < 12).sum() > 100


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sheet that hangs in a scene, seen by two cameras."""
    folder = tmp_path_factory.mktemp("scene")
    arms = [part for at in PATH[0] for part in scenes.arm(at)]
    around = [scenes.table(BEIGE), *arms, scenes.box((0.1, 0.1, 0.1), (0.2, 0.5, 0.05), GREEN)]
    frames = [[scenes.sheet(scenes.hanging(0.1), BLUE), *around]] * 2
    scenes.write_scene(folder, Rig(seen(), Cleaning(BOX)), frames, [0.0, 1 / 15])
    return folder


def seen(**changes: Any) -> dict[str, Any]:
    return scenes.cameras(2, across=120, **changes)


CUT = replace(CUTS, arms=(Arm(UP, 0.07, 0.9),), gripper_radius=0.02, link=0.04)
INFO = RecordingInfo("s", "fling", "blue", "1", "made up", (0, 1), HANGS, 0.0, None)


@pytest.mark.parametrize(
    "how",
    [CUT, replace(CUT, colour=BLUES, table_margin=0.0)],
    ids=["geometry", "colour"],
)
def test_images_without_masks_give_the_cloth(images: Path, how: Segmentation) -> None:
    rig = Rig(seen(), Cleaning(BOX, voxel=0.0, neighbours=0), segmentation=how)
    path = PATH, np.array([0.0, 1.0])
    made = rgbd_recording(images, INFO, *path, rig=rig)
    true = read_clouds(images, replace(rig, cameras=seen(masks=True), segmentation=None))[1]
    with pytest.raises(ValueError, match="segmentation needs sheet and grippers"):
        read_clouds(images, rig)
    for frame in range(2):
        points = np.asarray(cloud(made, frame), np.float32)
        share, others = scenes.shares(points, true[frame].astype(np.float32))
        assert share > 0.97 and others < 0.01


def test_masks_are_used_where_given(images: Path) -> None:
    """One camera has masks, another none: cuts are made in what the second sees."""
    clean, views = Cleaning(BOX, voxel=0.0, neighbours=0), seen()
    views["c0"] = replace(views["c0"], masks=True)
    cutter = segmenter(CUT)
    both = read_clouds(images, Rig(views, clean), segmenter=cutter)[1][0]
    alone = read_clouds(images, Rig({"c0": views["c0"]}, clean))[1][0]
    assert scenes.shares(both, alone)[0] == 1
    assert len(both) == len(alone) + cutter.frames[0].counts[-1]
    masked = segmenter(CUT, LIES)  # without masks it would be refused
    read_clouds(images, Rig(seen(masks=True), clean), segmenter=masked)
    assert not masked.frames


def test_a_changed_colour_image_is_converted_again_where_it_is_read(
    images: Path, tmp_path: Path
) -> None:
    folder = manifest(tmp_path / "in", replace(CUT, colour=BLUES))
    shutil.copytree(images, folder / "fling_blue")
    rig = Rig(seen(), Cleaning(BOX))
    write_json(folder / "fling_blue" / "cameras.json", asdict(rig))
    (first,) = convert(folder, tmp_path / "out")
    (second,) = convert(folder, tmp_path / "out")
    assert "cuts: outside" in first and "up to date" in second
    picture = folder / "fling_blue" / "c0" / "colour" / "000.png"
    picture.write_bytes(encode_png(np.zeros((90, 120, 3), np.uint8)))
    assert "up to date" not in next(convert(folder, tmp_path / "out"))
    picture.unlink()
    with pytest.raises(ValueError, match="colour: no image that belongs to .*000.png"):
        next(convert(folder, tmp_path / "out"))
    shutil.rmtree(picture.parent)
    with pytest.raises(ValueError, match="c0/colour: no such folder"):
        next(convert(folder, tmp_path / "out"))
    write_json(folder / "fling_blue" / "cameras.json", asdict(replace(rig, segmentation=CUT)))
    assert "cuts: outside" in next(convert(folder, tmp_path / "out"))  # it comes first
