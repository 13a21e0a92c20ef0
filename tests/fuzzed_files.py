"""Valid small files of every kind that r2s reads from its users, and what reads each."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import h5py
import jax.numpy as jnp
import numpy as np
import rgbd_scene
import trimesh
from scipy.spatial.transform import Rotation

from r2s._util.files import write_json
from r2s.estimation import cards, checkpoint
from r2s.estimation.estimate import Nuisance, point_estimate
from r2s.laboratory.files import read_tests
from r2s.materials import presets
from r2s.materials.arcsim import read_material, write_material
from r2s.materials.parameters import OrthotropicSpace
from r2s.mesh.files import read_mesh
from r2s.mesh.mesh import rectangle
from r2s.recordings import clouds, images
from r2s.recordings.clocks import read_times
from r2s.recordings.datasets import known_bar, read_dataset
from r2s.recordings.force_log import read_force_log
from r2s.recordings.gripper_paths import read_track
from r2s.recordings.manifest import read_manifest
from r2s.recordings.open import convert, load_trajectory, open_recording, save_trajectory
from r2s.recordings.recording import load, make_recording, save
from r2s.recordings.rgbd import read_rig
from r2s.recordings.segmentation import read_colours
from r2s.recordings.swings import read_swing

POINTS = np.random.default_rng(0).uniform(0, 0.3, (12, 3)).astype(np.float32)
COLOURS = np.random.default_rng(1).integers(0, 255, (12, 3), np.uint8)
TEMPLATE = Path(__file__).parents[1] / "data_manifests" / "templates" / "study.json"
SIZE = (16, 12)  # pixels across, down
TIMES = np.arange(4) / 10  # [s]
PLACES = np.linspace([0, 0, 0.01], [0.1, 0.0, 0.2], 4)  # [m]
TURNS = Rotation.from_rotvec(np.linspace([0, 0, 0], [0, 0, 0.7], 4)).as_quat()
SHEET = rectangle((0.3, 0.3), (3, 3))


class Kind(NamedTuple):
    """`write` makes a valid file of a `name`, or a folder; `read` reads it."""

    name: str
    write: Callable[[Path], Any]
    read: Callable[[Path], Any]


def _text(content: str) -> Callable[[Path], Any]:
    return lambda path: path.write_text(content)


def _rows(values: np.ndarray, mark: str = " ") -> str:
    return "".join(mark.join(f"{value:.9g}" for value in row) + "\n" for row in values)


def _header(kind: str, form: str, count: int) -> str:
    """Of a PLY or a PCD of coloured points."""
    if kind == "ply":
        axes = "".join(f"property float {axis}\n" for axis in "xyz")
        shades = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
        return f"ply\nformat {form} 1.0\nelement vertex {count}\n{axes}{shades}end_header\n"
    return (
        "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {form}\n"
    )


def _cloud(kind: str, form: str) -> Callable[[Path], Any]:
    """Writes coloured points as PLY or PCD."""
    packed = COLOURS.astype(np.uint32) @ np.array([65536, 256, 1], np.uint32)
    shades = COLOURS if kind == "ply" else packed[:, None]
    head = _header(kind, form, len(POINTS)).encode()
    if form == "ascii":
        body = _rows(np.column_stack([POINTS, shades])).encode()
    else:
        body = b"".join(p.tobytes() + s.tobytes() for p, s in zip(POINTS, shades, strict=True))
    return lambda path: path.write_bytes(head + body)


def _e57(path: Path) -> None:
    import pye57  # pyright: ignore[reportMissingImports]

    with pye57.E57(str(path), mode="w") as file:
        scan = {f"cartesian{axis}": POINTS[:, i].astype(float) for i, axis in enumerate("XYZ")}
        file.write_scan_raw(scan)


def _track(path: Path) -> None:
    arrays = {"times": TIMES, "positions": PLACES, "quaternions": TURNS}
    if path.suffix == ".npz":
        np.savez(path, **arrays)
    else:
        write_json(path, {name: array.tolist() for name, array in arrays.items()})


def _image(pixels: np.ndarray) -> Callable[[Path], Any]:
    return lambda path: path.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes())


def _movie(path: Path) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for frame in range(4):
        writer.write(np.full((48, 64, 3), 40 * frame, np.uint8))
    writer.release()


def _greys(folder: Path) -> None:
    folder.mkdir()
    for frame in range(3):
        _image(np.full((12, 16), 40 * frame, np.uint8))(folder / f"{frame:03d}.png")


def _recording(path: Path) -> None:
    markers = np.repeat(POINTS[None, :4].astype(float), 4, axis=0)
    info = dataclasses.replace(rgbd_scene.INFO, frames_used=(0, 3))
    more = {"markers": markers, "marker_places": np.array([[0, 0], [0, 0.1], [0.1, 0], [0.1, 0.1]])}
    force = {"force": np.arange(4.0), "force_times": TIMES}
    save(make_recording([POINTS] * 4, TIMES, PLACES, TIMES, info, **more, **force), path)


def _swing(path: Path) -> None:
    grid = np.stack(np.meshgrid(np.arange(3.0), np.arange(3.0), [0.0], indexing="ij"), axis=-1)
    points = np.repeat(0.1 * grid[None, :, :, 0], 9, axis=0)
    clock = np.arange(9) / 10
    np.savez(
        path,
        times=clock + 0.3,
        points=points,
        tool_times=clock,
        tool_position=np.repeat([[0.0, 0.0, 0.5]], 9, axis=0),
        tool_quaternion_xyzw=np.repeat([[0.0, 0.0, 0.0, 1.0]], 9, axis=0),
    )


def _knit(path: Path) -> None:
    stretch = np.linspace(1, 1.5, 12)
    with h5py.File(path, "w") as file:
        file["clampSize"], file["fabricSize"] = [142.0], [400.0]
        for name in ("video2", "video3", "video4", "video5"):
            pins = np.zeros((6, 2, 12))
            pins[0, 0], pins[1, 0] = 200 - 20 * (stretch - 1), -200 + 20 * (stretch - 1)
            pins[-2, 1] = 240 * stretch
            file[f"{name}/traj"], file[f"{name}/forces"] = pins, 20 * (stretch - 1)


def _laboratory(curve: str) -> Callable[[Path], Any]:
    """Writes the tests of a laboratory, whose pull is in a file beside them."""

    def write(path: Path) -> None:
        folder = path.parent
        stretch = np.linspace(0, 0.02, 20)
        rows = np.column_stack([1e3 * stretch, 300 * 0.25 * stretch, 50 - 100 * stretch])
        head = "extension_mm,force_N,width_mm\n"
        (folder / "warp.csv").write_text(head + _rows(rows, ","))
        _knit(folder / "knit.h5")
        pull = {"file": curve, "direction": "warp", "length": 0.2, "width": 0.05}
        tests: dict[str, Any] = {"format": "r2s-laboratory/1", "source": "own", "pulls": [pull]}
        tests["cantilevers"] = [{"direction": "warp", "overhangs": [0.061, 0.06, 0.063]}]
        tests["drapes"] = [{"coefficient": 0.42, "specimen_radius": 0.15, "support_radius": 0.09}]
        write_json(folder / "tests.json", tests)

    return write


def _card(path: Path) -> None:
    space = OrthotropicSpace.make(0.2)
    place = jnp.full(space.dim, 0.5)
    history = np.ones((3, 2)), np.ones((3, 2, space.dim))
    found = point_estimate("diffcloud", space, place, 1e-6, *history, 1.5, converged=True)
    nuisances = (Nuisance("shift x", "m", 0.001, np.nan),)
    found = dataclasses.replace(found, nuisances=nuisances, correlation=np.eye(space.dim))
    cards.write(path, cards.Card.make("any", found, cards.Provenance("estimated", date="2026")))


def _old_card(path: Path) -> None:
    path.write_bytes((Path(__file__).parent / "data" / "card_0.2.0.json").read_bytes())


def _mesh(path: Path) -> None:
    places = np.array(SHEET.lay_flat())
    made = trimesh.Trimesh(places, np.asarray(SHEET.faces), process=False)
    if path.name == "ascii.stl":
        path.write_text(str(made.export(file_type="stl_ascii")))
    elif path.suffix == ".gltf":
        made.export(path, embed_buffers=True, merge_buffers=True)
    else:
        made.export(path)


def _textured(path: Path) -> None:
    lines = ["v {} {} {}".format(*place) for place in np.array(SHEET.lay_flat())]
    lines += ["vt {} {}".format(*place) for place in 3 * np.asarray(SHEET.rest)]
    lines += ["f " + " ".join(f"{n}/{n}" for n in face) for face in np.asarray(SHEET.faces) + 1]
    path.write_text("\n".join(lines))


def _manifest(**changes: Any) -> dict[str, Any]:
    made = json.loads(TEMPLATE.read_text())
    lift = made["scenarios"]["lift"] | changes
    return made | {"scenarios": {"lift": lift}, "files": {}}


def _folder_of_clouds(folder: Path) -> None:
    """A recording of clouds in several files, with its manifest and its path."""
    sheet = {"size": [0.3, 0.3], "origin": [0, 0, 0], "warp": [1, 0, 0], "weft": [0, 1, 0]}
    changes: dict[str, Any] = {"folder": "lift_(?P<fabric>[a-z]+)(?P<trial>[0-9]?)"}
    changes |= {"sheet": sheet | {"pinned": ["origin"]}, "frame_rate": 0, "frames_used": []}
    changes |= {"gripper": {"file": "lift_gripper.csv"}, "table_height": 0.0, "time_offset": 0.0}
    (folder / "lift_tan").mkdir(parents=True)
    write_json(folder / "manifest.json", _manifest(**changes))
    for frame in range(4):
        np.save(folder / "lift_tan" / f"{frame:03d}.npy", POINTS)
    (folder / "lift_tan" / "times.csv").write_text("".join(f"{time}\n" for time in TIMES))
    rows = _rows(np.column_stack([TIMES, PLACES]), ",")
    (folder / "lift_gripper.csv").write_text("time_s,x,y,z\n" + rows)


def _folder_of_images(folder: Path) -> None:
    """The same of images of two cameras."""
    _folder_of_clouds(folder)
    for file in (folder / "lift_tan").iterdir():
        file.unlink()
    cameras = {
        "left": rgbd_scene.camera((-0.4, -0.1, 0.45), resolution=(40, 30)),
        "right": rgbd_scene.camera(
            (0.4, -0.3, 0.6), resolution=(40, 30), distortion=(-0.1, 0, 0, 0)
        ),
    }
    box = clouds.Cleaning(((-0.1, -0.1, -0.02), (0.4, 0.4, 0.4)), voxel=0.0)
    scene = rgbd_scene.rig()
    rgbd_scene.write(folder / "lift_tan", dataclasses.replace(scene, cameras=cameras, clean=box))


def _converted(folder: Path) -> None:
    """Convert a folder; what is written must be whole, whatever happens."""
    to = folder.parent / "canonical"
    try:
        list(convert(folder, to, force=True))
    finally:
        for file in to.iterdir() if to.is_dir() else ():
            if file.suffix == ".npz":
                load(file)
            elif file.suffix != ".sha256":
                raise AssertionError(f"left behind: {file}")
            file.unlink()


def _depth(path: Path) -> Any:
    return images.read_depth(path, 1e-3, SIZE)


GREY = np.random.default_rng(2).integers(600, 800, SIZE[::-1], np.uint16)
PICTURE = np.random.default_rng(3).integers(0, 255, (*SIZE[::-1], 3), np.uint8)
MASK = np.pad(np.full((6, 8), 255, np.uint8), ((3, 3), (4, 4)))
LOG = "time_s,force_N\n" + "".join(f"{0.1 * i:.1f},{i}\n" for i in range(12))
PATH_ROWS = np.column_stack([TIMES, PLACES, TURNS])
KINDS = (
    Kind("cloud.npy", lambda path: np.save(path, POINTS), clouds.read_cloud),
    *(
        Kind(f"{form}.{kind}", _cloud(kind, form), read)
        for kind, form in (
            *(("ply", "ascii"), ("ply", "binary_little_endian")),
            *(("pcd", "ascii"), ("pcd", "binary")),
        )
        for read in (lambda path: (clouds.read_cloud(path), read_colours(path)),)
    ),
    Kind("cloud.obj", _text("v 0 0 0\nv 1 0 0 1 1 1\nvn 0 0 1\nv 0 1 2\n"), clouds.read_cloud),
    Kind("cloud.xyz", _text("# x y z\n" + _rows(POINTS)), clouds.read_cloud),
    Kind("cloud.e57", _e57, clouds.read_cloud),
    Kind("times.csv", _text("frame,time\n0,0.0\n1,0.1\n2,0.25\n3,0.3\n"), read_times),
    Kind("path.npy", lambda path: np.save(path, PLACES), read_track),
    Kind("path.csv", _text("time_s,x_m,y,z,qx,qy,qz,qw\n" + _rows(PATH_ROWS, ",")), read_track),
    Kind("path.tum", _text("# t x y z qx qy qz qw\n" + _rows(PATH_ROWS)), read_track),
    Kind("path.npz", _track, lambda path: read_track(path, "xyzw")),
    Kind("path.json", _track, lambda path: read_track(path, "xyzw")),
    Kind(
        "cameras.json",
        lambda path: write_json(path, dataclasses.asdict(rgbd_scene.rig())),
        lambda path: read_rig(path.parent),
    ),
    Kind("manifest.json", lambda path: write_json(path, _manifest()), read_manifest),
    Kind("dataset.json", _text((TEMPLATE.parents[1] / "swings.json").read_text()), read_dataset),
    Kind("depth.png", _image(GREY), _depth),
    Kind("depth.npy", lambda path: np.save(path, GREY.astype(np.float32)), _depth),
    Kind("mask.png", _image(MASK), lambda path: images.read_mask(path, SIZE)),
    Kind("colour.png", _image(PICTURE), lambda path: images.read_colour(path, SIZE)),
    Kind("colour.jpg", _image(PICTURE), lambda path: images.read_colour(path, SIZE)),
    Kind("video.avi", _movie, lambda path: list(images.read_grey(path))),
    Kind("greys", _greys, lambda path: list(images.read_grey(path))),
    Kind("log.csv", _text(LOG), read_force_log),
    Kind("recording.npz", _recording, open_recording),
    Kind("swing.npz", _swing, lambda path: read_swing(path, known_bar())),
    Kind(
        "trajectory.npz",
        lambda path: save_trajectory(path, np.repeat(POINTS[None], 3, axis=0), [[0, 1, 2]]),
        load_trajectory,
    ),
    Kind(
        "state.npz",
        lambda path: checkpoint.save(path, {"theta": PLACES}, {"kind": "descent", "run": "a"}),
        lambda path: checkpoint.load(path, {"kind": "descent", "run": "a"}),
    ),
    Kind("tests.json", _laboratory("warp.csv"), read_tests),
    Kind("warp.csv", _laboratory("warp.csv"), lambda path: read_tests(path.parent / "tests.json")),
    Kind("knit.h5", _laboratory("knit.h5"), lambda path: read_tests(path.parent / "tests.json")),
    Kind("card.json", _card, cards.read),
    Kind("old_card.json", _old_card, cards.read),
    Kind("material.json", lambda path: write_material(path, presets.black_denim()), read_material),
    *(
        Kind(f"mesh.{kind}", _mesh, read_mesh)
        for kind in ("obj", "ply", "off", "stl", "glb", "gltf")
    ),
    Kind("ascii.stl", _mesh, read_mesh),
    Kind("textured.obj", _textured, lambda path: read_mesh(path, uv=True)),
    Kind("clouds", _folder_of_clouds, _converted),
    Kind("images", _folder_of_images, _converted),
)
