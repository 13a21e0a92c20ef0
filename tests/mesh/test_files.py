"""Mesh files as tools write them: one cloth whatever its seams, axes, orientation and unit."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

trimesh = pytest.importorskip("trimesh")

from r2s.mesh.files import UNITS, read_mesh  # noqa: E402
from r2s.mesh.mesh import rectangle  # noqa: E402
from r2s.mesh.strain_samples import cells  # noqa: E402

FORMATS = "obj", "ply", "off", "stl", "glb", "gltf"
QUADS = cells((5, 5))
FACES = np.stack([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]], axis=1).reshape(-1, 3)
PLACES = np.array(rectangle((0.3, 0.3), (5, 5)).lay_flat())
GRID = PLACES / 0.3  # as texture coordinates


def written(path: Path, places=PLACES, faces: Any = FACES, texture=None, of_texture=None) -> Path:
    """An OBJ file, of polygons that may have texture coordinates of their own."""
    lines = ["v {} {} {}".format(*map(float, place)) for place in places]
    lines += ["vt {} {}".format(*map(float, place[:2])) for place in texture or []]
    of_texture = faces if of_texture is None else of_texture
    for face, other in zip(faces, of_texture, strict=True):
        pairs = [
            f"{a + 1}/{b + 1}" if texture else f"{a + 1}" for a, b in zip(face, other, strict=True)
        ]
        lines.append("f " + " ".join(pairs))
    path.write_text("\n".join(lines))
    return path


def exported(path: Path, places=PLACES, faces=FACES, **given) -> Path:
    trimesh.Trimesh(places, faces, process=False, **given).export(path)
    return path


def is_towel(read, side: float = 0.3) -> bool:
    """Whether a file is the towel of 5 x 5 vertices, in one piece, all of it counter-clockwise."""
    mesh = read.mesh
    counts = len(mesh.rest), len(mesh.faces), len(mesh.hinges)
    assert counts == (25, 32, 40) and np.all(mesh.area > 0)
    assert np.sum(mesh.area) == pytest.approx(side**2, rel=1e-3)
    ends = np.asarray(mesh.hinges[:, :2])  # at rest and in space edges are as long
    lengths = [
        np.linalg.norm(np.diff(np.asarray(x)[ends], axis=1), axis=2) for x in (mesh.rest, read.x)
    ]
    assert np.allclose(*lengths, rtol=1e-3)
    return True


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_is_one_towel(tmp_path, suffix):
    read = read_mesh(exported(tmp_path / f"towel.{suffix}"))
    assert is_towel(read) and not read.changes
    assert np.allclose(
        read.mesh.rest, PLACES[:, :2][read.file_vertices] if suffix != "stl" else read.x[:, :2]
    )


def split(row: float = 0.15, gap: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The towel's places and faces with the vertices of a row twice, `gap` apart."""
    upper = PLACES[FACES].mean(axis=1)[:, 0] > row
    places, faces = [PLACES[FACES[~upper].min() : FACES[~upper].max() + 1]], [FACES[~upper]]
    faces.append(FACES[upper] - FACES[upper].min() + len(places[0]))
    places.append(PLACES[FACES[upper].min() :] + [gap, 0, 0])
    return np.concatenate(places), np.concatenate(faces)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("gap", [0.0, 1e-6])
def test_halves_that_touch_are_joined(tmp_path, suffix, gap):
    read = read_mesh(exported(tmp_path / f"towel.{suffix}", *split(gap=gap)))
    assert is_towel(read)
    said = read.notes if suffix in ("stl", "glb", "gltf") else read.changes
    assert any("vertices welded to others within 0.003 mm" in each for each in said)


@pytest.mark.parametrize("weld, words", [(None, "2 pieces .* 0.1 mm apart"), (2e-4, "")])
def test_halves_apart_are_pieces_unless_the_tolerance_joins_them(tmp_path, weld, words):
    path = exported(tmp_path / "towel.ply", *split(gap=1e-4))
    if not words:
        assert is_towel(read_mesh(path, weld=weld))
        return
    with pytest.raises(ValueError, match=words):
        read_mesh(path, weld=weld)


def test_the_largest_of_several_pieces_is_taken_on_request(tmp_path):
    places = np.concatenate([PLACES, [[1, 0, 0], [1.1, 0, 0], [1, 0.1, 0]]])
    path = exported(tmp_path / "two.ply", places, np.concatenate([FACES, [[25, 26, 27]]]))
    with pytest.raises(ValueError, match=r"two.ply: the sheet is in 2 pieces \(areas 0.09, 0.005"):
        read_mesh(path)
    read = read_mesh(path, largest=True)
    assert is_towel(read) and "the largest is taken" in read.changes[0]
    with pytest.raises(ValueError, match="strict"):
        read_mesh(path, largest=True, strict=True)


@pytest.mark.parametrize("faces", ["quads", "triangles"])
def test_a_seam_of_the_texture_cuts_no_cloth(tmp_path, faces):
    upper = PLACES[QUADS].mean(axis=1)[:, :1] > 0.15  # two islands of the texture
    texture, corners = [*GRID, *(GRID + [0.5, 0, 0])], np.where(upper, QUADS + 25, QUADS)
    path = written(tmp_path / "towel.obj", PLACES, QUADS, texture, corners)
    if faces == "triangles":
        halves = [np.concatenate([q[:, [0, 1, 2]], q[:, [0, 2, 3]]]) for q in (QUADS, corners)]
        written(path, PLACES, halves[0], texture, halves[1])
    read = read_mesh(path, strict=True)
    assert is_towel(read) and np.array_equal(read.file_vertices, np.arange(25))
    with pytest.raises(ValueError, match="texture has seams at 5 vertices"):
        read_mesh(path, uv=True)


@pytest.mark.parametrize("suffix", ["ply", "glb", "gltf"])
def test_split_normals_cut_no_cloth(tmp_path, suffix):
    places, normals = PLACES[FACES.ravel()], np.tile([0.0, 0, 1], (96, 1))
    normals[::2] = [0, 0.6, 0.8]
    faces = np.arange(96).reshape(-1, 3)
    path = exported(tmp_path / f"towel.{suffix}", places, faces, vertex_normals=normals)
    assert is_towel(read_mesh(path))


def test_normals_negative_numbers_and_comments_of_an_obj(tmp_path):
    path = written(tmp_path / "towel.obj")
    lines = path.read_text().split("\n")
    lines = [line.replace("v ", "v   ") + " # vertex" for line in lines]
    faces = ["f " + " \\\r\n".join(f"{k - 25}//1" for k in face) for face in FACES]
    path.write_text(
        "\ufeffmtllib none.mtl\n" + "\r\n".join(lines[:25] + ["vn 0 0 1", "s off", *faces])
    )
    assert is_towel(read_mesh(path, strict=True))


TURNS = [
    [90, 0, 0],
    [-90, 0, 0],
    [0, 90, 0],
    [0, 0, 8],
    [7, 0, 0],
    [0, -12, 0],
    [5, 9, 20],
    [90, 0, 3],
]


@pytest.mark.parametrize("faces", [FACES, QUADS], ids=["triangles", "quads"])
@pytest.mark.parametrize("degrees", TURNS, ids=str)
def test_the_plane_of_a_turned_sheet_is_found(tmp_path, degrees, faces):
    turn = Rotation.from_euler("xyz", degrees, degrees=True)
    read = read_mesh(written(tmp_path / "towel.obj", turn.apply(PLACES) + [0.2, -0.1, 0.7], faces))
    assert is_towel(read) and not [each for each in read.changes if "turned over" not in each]
    is_square = np.allclose(np.ptp(read.mesh.rest, axis=0), 0.3, atol=1e-5)
    assert is_square == (degrees != [0, 0, 8])  # in the plane of the file's axes these are kept
    assert is_square or "to this warp, which stays" in " ".join(read.notes)


def test_y_up_is_seen_from_above(tmp_path):
    x, y, _ = PLACES.T
    read = read_mesh(written(tmp_path / "towel.obj", np.column_stack([x, 0 * x, -y])), strict=True)
    assert is_towel(read) and np.allclose(read.mesh.rest, PLACES[:, :2], atol=1e-9)


@pytest.mark.parametrize("over", [slice(None), slice(0, 7), slice(1, None, 3)])
def test_faces_become_counter_clockwise(tmp_path, over):
    faces = FACES.copy()
    faces[over] = faces[over, ::-1]
    path = exported(tmp_path / "towel.off", PLACES, faces)
    read = read_mesh(path)
    assert is_towel(read) and read.changes == [
        f"{len(faces[over])} of 32 faces, clockwise, are turned over"
    ]
    assert np.allclose(read.mesh.rest, PLACES[:, :2])
    with pytest.raises(ValueError, match=r"towel.off: .* changes nothing, but \d+ of 32 faces"):
        read_mesh(path, strict=True)


@pytest.mark.parametrize("unit", ["cm", "mm", "in"])
@pytest.mark.parametrize("suffix", ["obj", "stl", "glb"])
def test_the_unit_is_asked_for(tmp_path, unit, suffix):
    path = exported(tmp_path / f"towel.{suffix}", PLACES / UNITS[unit])
    with pytest.raises(
        ValueError, match=rf"hardly in metres: in centim.* --unit .*{unit} \(0.3 m\)"
    ):
        read_mesh(path)
    assert is_towel(read_mesh(path, scale=UNITS[unit]))


def test_a_small_or_large_sheet_is_right_where_its_unit_is_stated(tmp_path):
    for factor in (0.03, 30):
        path = exported(tmp_path / "towel.ply", factor * PLACES)
        with pytest.raises(ValueError, match="hardly in metres"):
            read_mesh(path)
        assert is_towel(read_mesh(path, scale=1.0), 0.3 * factor)


@pytest.mark.parametrize(
    "faces, words",
    [
        ([*FACES, FACES[3]], "1 faces that are there twice"),
        ([*FACES, FACES[3][::-1]], "1 faces that are there twice"),
        ([*FACES, *FACES[:, ::-1]], "32 faces that are there twice"),
        ([*FACES, [0, 0, 1]], "1 faces without area"),
        ([*FACES, [0, 1, 2]], "1 faces without area"),
    ],
)
def test_what_is_there_twice_or_has_no_area_is_left_out(tmp_path, faces, words):
    path = written(tmp_path / "towel.obj", PLACES, faces)
    read = read_mesh(path)
    assert is_towel(read) and words in read.changes[0]
    with pytest.raises(ValueError, match="strict"):
        read_mesh(path, strict=True)


def test_unused_vertices_are_left_out_and_the_others_keep_their_numbers(tmp_path):
    places = np.concatenate([[[9.0, 9, 9]], PLACES, [[8.0, 8, 8]]])
    read = read_mesh(written(tmp_path / "towel.obj", places, FACES + 1))
    assert is_towel(read) and np.array_equal(read.file_vertices, 1 + np.arange(25))
    assert read.changes == ["2 vertices of no face are left out"]


BOWL = PLACES + np.outer(np.sum((PLACES - 0.15) ** 2, axis=1), [0, 0, 1])
FIN = np.concatenate([PLACES, [[0.15, 0.15, 0.1]]])
HOLE = np.delete(FACES, [10, 11], axis=0)
LAYERS = np.concatenate([PLACES, PLACES + [0.01, 0.01, 0]])


@pytest.mark.parametrize(
    "places, faces, words",
    [
        (BOWL, FACES, "not plane at rest, it deviates by .* mm over .* mm: lay it flat, or"),
        (PLACES + np.outer(PLACES[:, 0] > 0.2, [0, 0, 0.01]), FACES, "not plane at rest"),
        (FIN, [*FACES, [11, 12, 25]], r"an edge, \[0.15, 0.075, 0.0\] to .*, has 3 faces"),
        (PLACES[:, [0, 0, 2]] * [1, 0, 0], FACES, "no face has an area"),
        (np.concatenate([PLACES, [[0.2, 0.1, 0]]]), [*FACES, [0, 1, 25]], "lie over each other"),
        (LAYERS, [*FACES, *(FACES + 25)], "2 pieces"),
        (PLACES, [*FACES, [0, 5, 1], [1, 5, 6]], "has 3 faces"),
        (PLACES[[0, 5, 6, 1]], [[0, 1, 2], [0, 2, 3], [0, 1, 3], [1, 2, 3]], "lie over each other"),
        (PLACES, [*FACES[:-1], [0, 1, 99]], "a face names v 100 of 25"),
        (np.where(PLACES == 0.3, np.nan, PLACES), FACES, "v 5 is not finite"),
        (PLACES, [], "there are no faces"),
    ],
)  # fmt: skip
def test_what_is_no_sheet_is_refused(tmp_path, places, faces, words):
    path = written(tmp_path / "sheet.obj", places, faces)
    with pytest.raises(ValueError, match=rf"sheet.obj: .*{words}"):
        read_mesh(path)


def test_a_hole_is_named(tmp_path):
    read = read_mesh(written(tmp_path / "towel.obj", PLACES, HOLE))
    assert any(note.startswith("a hole, 300 mm around, at [") for note in read.notes)


def test_halves_whose_vertices_do_not_match_are_refused(tmp_path):
    fine = np.array(rectangle((0.15, 0.3), (3, 9)).lay_flat())
    quads = cells((3, 9))
    fine[:, 0] += 0.3
    path = written(tmp_path / "a.obj", np.concatenate([PLACES, fine]), [*QUADS, *(quads + 25)])
    with pytest.raises(ValueError, match="2 pieces .* 0 mm apart"):
        read_mesh(path)


def test_a_cut_within_the_sheet_is_refused(tmp_path):
    """A triangle without area joins an edge to its halves: without it the sides only touch."""
    a, b, c = FACES[12]  # its diagonal goes from c to a
    middle, (d,) = (PLACES[a] + PLACES[c]) / 2, set(FACES[13]) - {a, c}
    faces = [*np.delete(FACES, 13, axis=0), [a, 25, d], [25, c, d], [a, c, 25]]
    path = written(tmp_path / "a.obj", np.concatenate([PLACES, [middle]]), faces)
    with pytest.raises(ValueError, match="a cut, .* whose sides touch"):
        read_mesh(path)


@pytest.mark.parametrize("suffix", ["obj", "ply", "off"])
def test_quadrilaterals_of_a_grid_are_kept(tmp_path, suffix):
    order = np.random.default_rng(0).permutation(25)  # vertices in any order
    places, quads = PLACES[order], np.argsort(order)[QUADS]
    path = written(tmp_path / "a.obj", places, quads)
    if suffix != "obj":
        body = "\n".join(" ".join(map(str, p)) for p in places)
        body += "\n" + "\n".join("4 " + " ".join(map(str, q)) for q in quads) + "\n"
        head = "OFF\n25 16 0\n"
        if suffix == "ply":
            head = "ply\nformat ascii 1.0\nelement vertex 25\n"
            head += "".join(f"property double {axis}\n" for axis in "xyz")
            head += "element face 16\nproperty list uchar int vertex_indices\nend_header\n"
        path = tmp_path / f"a.{suffix}"
        path.write_text(head + body)
    read = read_mesh(path, strict=True)
    assert is_towel(read) and read.mesh.samples.corners.shape == (16, 4)
    assert np.allclose(places[read.file_vertices], read.x)
    assert np.allclose(read.x[:, :2], read.mesh.rest, atol=1e-6)


def test_other_quadrilaterals_are_cut(tmp_path):
    places = PLACES + 0.2 * np.outer(PLACES[:, 0] ** 2, [1, 0, 0])
    read = read_mesh(written(tmp_path / "a.obj", places, QUADS))
    assert read.mesh.samples.corners.shape == (32, 3) and "16 quadrilaterals, no" in read.notes[-1]


@pytest.mark.parametrize("scale", [[1, 1, 1], [3, 3, 0], [0.5, 2, 0], [-1, 1, 0], [0.2, -0.2, 0]])
@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_the_rest_shape_of_a_texture_is_as_long_as_the_edges(tmp_path, scale, suffix):
    bent = PLACES.copy()  # around a cylinder
    bent[:, 0], bent[:, 2] = np.sin(4 * PLACES[:, 0]) / 4, np.cos(4 * PLACES[:, 0]) / 4
    texture = GRID * scale + [0.1, 0.2, 0]
    path = written(tmp_path / "bent.obj", bent, FACES, list(texture))
    if suffix == "glb":
        visual = trimesh.visual.TextureVisuals(uv=texture[:, :2])
        path = exported(tmp_path / "bent.glb", bent, FACES, visual=visual)
    read = read_mesh(path, uv=True)
    assert np.all(read.mesh.area > 0) and len(read.mesh.hinges) == 40
    assert np.ptp(read.mesh.rest, axis=0) == pytest.approx(0.3, rel=0.02)
    with pytest.raises(ValueError, match="not plane at rest"):
        read_mesh(path)


def test_a_texture_that_is_no_rest_shape_is_refused(tmp_path):
    path = written(tmp_path / "a.obj")
    with pytest.raises(ValueError, match="no texture coordinates"):
        read_mesh(path, uv=True)
    warped = GRID**3
    with pytest.raises(ValueError, match="edges of the texture differ by .* unwrap it"):
        read_mesh(written(path, texture=list(warped)), uv=True)


@pytest.mark.parametrize(
    "name, text, words",
    [
        ("a.obj", "v 0 0\nf 1 2 3", "line 1, 'v 0 0'"),
        ("a.obj", "v 0 0 0\nf 1 1", "line 2, 'f 1 1': expected 3 entries"),
        ("a.obj", "v 0,1 0 0\nf 1 1 1", "line 1, 'v 0,1 0 0'"),
        ("a.obj", "v 0 0 0\nf 1 1 -2", "a face names v 0 of 1"),
        ("a.off", "nothing", "is no off file"),
        ("a.ply", "ply\n", "is no ply file"),
        ("a.glb", "", "is no glb file"),
        ("a.fbx", "", "unknown suffix '.fbx', expected one of .obj"),
    ],
)
def test_a_broken_file_is_named(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=f"{name}: .*{words}"):
        read_mesh(tmp_path / name)


def test_numbers_that_are_no_lengths_are_refused(tmp_path):
    path = written(tmp_path / "a.obj")
    for scale, weld in ((0.0, None), (float("nan"), None), (1.0, -1.0), (1.0, float("inf"))):
        with pytest.raises(ValueError, match="a.obj: (scale|weld) must"):
            read_mesh(path, scale=scale, weld=weld)
    with pytest.raises(FileNotFoundError, match="no.obj: no such mesh"):
        read_mesh(tmp_path / "no.obj")
