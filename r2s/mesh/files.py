"""Sheets from mesh files, whose vertices, axes and unit are not yet those of a cloth."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from r2s._util.checks import SHOWN, expect, shown
from r2s._util.extras import require
from r2s.mesh.mesh import Mesh, rectangle

FORMATS = ".obj", ".ply", ".off", ".stl", ".gltf", ".glb"
SPLIT = ".stl", ".gltf", ".glb"  # a vertex is repeated by the format
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}  # [m]
SIDES = 0.02, 5.0  # [m], longest side of a sheet whose unit is not asked for
WELD, PLANE = 1e-5, 1e-3  # of the extent: one place, and plane; nearly plane
STRAIN = 0.2  # of the edges in a texture, root mean square, at most
STRAIGHT, SQUARE = 0.2, 0.02  # of the border, in one direction; [rad] from there to the warp
CUT = 0.01  # of an edge: a hole that is less wide is a cut


class MeshFile(NamedTuple):
    """A sheet from a file: at rest, and its vertices in the axes of the file, [m].

    `file_vertices`: number of each vertex in the file, from 0, the first of those welded.
    """

    mesh: Mesh
    x: Float[np.ndarray, "vertex 3"]
    file_vertices: Int[np.ndarray, " vertex"]
    changes: list[str]
    notes: list[str]


def read_mesh(
    path: Path | str,
    *,
    scale: float | None = None,
    uv: bool = False,
    weld: float | None = None,
    largest: bool = False,
    strict: bool = False,
) -> MeshFile:
    """Read a plane sheet from an .obj, .ply, .off, .stl, .gltf or .glb file (needs trimesh).

    Vertices at one place are welded, faces without area or there twice left out, clockwise ones
    turned over. The plane is that of the principal axes, seen from the nearest positive axis of the
    file. The warp is the file's x axis (y if the plane is across x); in a tilted plane it follows
    the direction that most of the border has, or is at right angles to it. Quadrilaterals of a
    uniform grid along the warp are kept (`rectangle`), others are cut in two.

    - `scale`: metres per unit of the file. None: 1, if the longest side is 20 mm to 5 m.
    - `uv`: the rest shape is the texture's, each of its axes scaled to the edges in space.
    - `weld`: vertices nearer than this are one, [m]; None: 1e-5 of the extent.
    - `largest`: take the largest of several pieces. - `strict`: refuse to change anything.

    Raises `FileNotFoundError`, `ImportError` without trimesh, and a `ValueError` that names the
    file and what is wrong: several pieces, layers, edges of three faces, cuts, no plane, the unit.
    """
    path, changes, notes = Path(path), [], [] if scale else ["lengths taken as metres"]
    trimesh = require("trimesh", "study", f"{path}: mesh files")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such mesh file")
    try:
        expect(scale is None or 0 < scale < np.inf, f"scale must be positive [m], got {scale}")
        expect(weld is None or 0 <= weld < np.inf, f"weld must not be negative [m], got {weld}")
        places, texture, polygons = _read(path, trimesh, uv)
        places = places * (scale or 1)
        corners = np.array([p[[0, k, k + 1]] for p in polygons for k in range(1, len(p) - 1)])
        used = np.unique(corners[..., 0])
        if left := len(places) - len(used):
            changes.append(f"{left} vertices of no face are left out")
        weld = WELD * float(np.max(np.ptp(places[used], axis=0))) if weld is None else weld
        single, first, number = np.unique(places, axis=0, return_index=True, return_inverse=True)
        for group in trimesh.grouping.clusters(single, weld):
            first[group] = np.min(first[group])
        first = first[number.ravel()]
        if count := len(used) - len(np.unique(first[used])):
            text = f"{count} of {len(used)} vertices welded to others within {1e3 * weld:.2g} mm"
            (notes if path.suffix.lower() in SPLIT else changes).append(text)
        corners[..., 0] = first[corners[..., 0]]
        corners = _one_layer(trimesh, places, corners, weld, largest, changes)
        vertices, faces = np.unique(corners[..., 0], return_inverse=True)
        x, faces, tilted = places[vertices], faces.reshape(-1, 3), False
        if texture is None:
            rest, tilted = _plane(x, changes, notes)
        else:
            rest = _unwrapped(texture[corners[..., 1]], x, faces, notes)
        over = np.linalg.det(rest[faces[:, 1:]] - rest[faces[:, :1]]) < 0
        faces[over] = faces[over, ::-1]
        if np.any(over):
            changes.append(f"{np.sum(over)} of {len(faces)} faces, clockwise, are turned over")
        _check_unit(np.ptp(rest, axis=0), scale)
        rest = _border(trimesh, rest, faces, tilted, notes)
        quads = np.array([first[p[:, 0]] for p in polygons if len(p) == 4], int).reshape(-1, 4)
        quads = np.searchsorted(vertices, quads[np.all(np.isin(quads, vertices), axis=1)])
        mesh, order = _make(rest, faces, quads, notes)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if strict and changes:
        raise ValueError(f"{path}: a strict reading changes nothing, but {'; '.join(changes)}")
    return MeshFile(mesh, x[order], vertices[order], changes, notes)


def _read(path: Path, trimesh: Any, uv: bool) -> tuple[np.ndarray, np.ndarray | None, Any]:
    """Vertices, texture coordinates, and the numbers of both at the corners of each polygon."""
    kind = path.suffix.lower()
    expect(kind in FORMATS, f"unknown suffix {kind!r}, expected one of {', '.join(FORMATS)}")
    if kind == ".obj":
        places, texture, polygons = _read_obj(path)
    else:
        try:
            loaded = trimesh.load_mesh(path, process=False)
            faces, texture = np.reshape(loaded.faces, (-1, 3)), getattr(loaded.visual, "uv", None)
            places = np.array(loaded.vertices, float).reshape(-1, 3)
        except Exception as error:  # trimesh raises anything, from KeyError to its own types
            words = f"is no {kind[1:]} file: {shown(error)}: export it again"
            raise ValueError(words) from error
        first, second = np.array_split(faces, 2)  # so trimesh cuts quadrilaterals
        if kind not in SPLIT and np.array_equal(first[:, [0, 2]], second[:, [2, 0]]):
            faces = np.column_stack([first, second[:, 1]])
        polygons = np.stack([faces, faces], axis=-1)
    expect(len(polygons) > 0, "there are no faces: export the whole mesh, not its points alone")
    expect(not uv or texture is not None, "its corners have no texture coordinates: export them")
    tables = [("v", places), ("vt", texture)][: 1 + uv]
    for (name, table), index in zip(tables, np.concatenate([*polygons]).T, strict=False):
        bad = index[(index < 0) | (index >= len(table))] + 1
        expect(not len(bad), f"a face names {name} {max(bad, default=0)} of {len(table)}")
        bad = np.flatnonzero(~np.all(np.isfinite(table), axis=1)) + 1
        expect(not len(bad), f"{name} {min(bad, default=0)} is not finite")
    return places, texture if uv else None, polygons


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray | None, Any]:
    # By hand: trimesh doubles vertices at seams, drops unused ones and cuts quadrilaterals.
    table: dict[str, list] = {"v": [], "vt": [], "f": []}
    text = path.read_text(encoding="utf-8-sig", errors="replace").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), 1):
        kind, *words = line.partition("#")[0].split() or [""]
        if kind not in table:
            continue
        try:
            least, size = (1, 2) if kind == "vt" else (3, 3)
            expect(len(words) >= least, f"expected {least} entries or more")
            if kind == "f":
                index = np.array([[int(k or 0) for k in [*w.split("/"), 0][:2]] for w in words])
                count = [len(table["v"]), len(table["vt"])]
                table["f"].append(index + np.where(index < 0, count, -1))
            else:
                table[kind].append(np.array([*words, "0"][:size], float))
        except ValueError as error:
            words = f"line {number}, {line.strip()[:50]!r}: {str(error)[:SHOWN]}"
            raise ValueError(words) from None
    textured = table["vt"] and all(np.all(face[:, 1] >= 0) for face in table["f"])
    texture = np.array(table["vt"]) if textured else None
    return np.array(table["v"]).reshape(-1, 3), texture, table["f"]


def _one_layer(
    trimesh: Any, places: np.ndarray, corners: np.ndarray, weld: float, largest: bool, changes: list
) -> Int[np.ndarray, "face 3 2"]:
    """The corners of one piece, without faces of no area or there twice."""
    keep = trimesh.triangles.nondegenerate(places[corners[..., 0]], height=weld)
    if not np.all(keep):
        changes.append(f"{np.sum(~keep)} faces without area are left out")
    expect(np.any(keep), "no face has an area")
    corners = corners[keep]
    _, keep = np.unique(np.sort(corners[..., 0], axis=1), axis=0, return_index=True)
    if count := len(corners) - len(keep):
        changes.append(f"{count} faces that are there twice are left out")
    corners = corners[np.sort(keep)]
    sheet = trimesh.Trimesh(places, corners[..., 0], process=False)
    edges, count = np.unique(sheet.edges_sorted, axis=0, return_counts=True)
    a, b = np.round(places[edges[np.argmax(count)]], 4).tolist()
    expect(max(count) < 3, f"an edge, {a} to {b} m, has {max(count)} faces: a sheet is one layer")
    label = trimesh.graph.connected_component_labels(sheet.face_adjacency, len(corners))
    area = np.bincount(label, sheet.area_faces)
    main = label == np.argmax(area)
    if len(area) > 1:
        sizes = ", ".join(f"{each:.3g}" for each in np.sort(area)[::-1][:4])
        words = f"{len(area)} pieces (areas {sizes}{', ...' * (len(area) > 4)} m^2)"
        rest, others = np.unique(sheet.faces[main]), np.unique(sheet.faces[~main])
        gap = 1e3 * np.min(KDTree(places[rest]).query(places[others])[0])
        words += f" whose nearest vertices are {gap:.3g} mm apart"
        remedy = "join them where they were made or by --weld, or take the largest (--largest)"
        expect(largest, f"the sheet is in {words}: {remedy}")
        changes.append(f"of {words} the largest is taken")
    return corners[main]


def _plane(
    x: np.ndarray, changes: list[str], notes: list[str]
) -> tuple[Float[np.ndarray, "vertex 2"], bool]:
    """Coordinates in the plane of the sheet, and whether that is tilted in the file."""
    _, _, axes = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)
    size, width, off = 1e3 * np.ptp(x @ axes.T, axis=0)
    expect(width > WELD * size, "the vertices lie on a line")
    words = f"not plane at rest, it deviates by {off:.4g} mm over {size:.4g} mm"
    expect(off < PLANE * size, f"{words}: lay it flat, or take the shape of its texture (--uv)")
    if off > WELD * size:
        changes.append(f"{words}: it is flattened")
    across = 2 - int(np.argmax(np.round(np.abs(axes[2, ::-1]), 3)))  # of equal ones z, y
    tilted = bool(1e3 * np.ptp(x[:, across]) > off + WELD * size)
    normal = axes[2] * np.sign(axes[2, across]) if tilted else np.eye(3)[across]
    along = int(across == 0)
    warp = np.eye(3)[along] - normal[along] * normal
    warp /= np.linalg.norm(warp)
    degrees = np.degrees(np.arccos(min(1, normal[across])))
    words = f", tilted by {degrees:.2g} degrees; warp along projected" if tilted else "; warp along"
    notes.append(f"plane across {'xyz'[across]} of the file{words} {'xyz'[along]}")
    return x @ np.stack([warp, np.cross(normal, warp)], axis=1), tilted


def _unwrapped(
    corners: Float[np.ndarray, "face 3 2"], x: np.ndarray, faces: np.ndarray, notes: list[str]
) -> Float[np.ndarray, "vertex 2"]:
    """Texture coordinates of the corners, each axis scaled to the edges in space."""
    rest = np.zeros((len(x), 2))
    rest[faces] = corners
    apart = np.max(np.abs(corners - rest[faces]), axis=2) > WELD * np.max(np.ptp(rest, axis=0))
    words = f"its texture has seams at {len(np.unique(faces[apart]))} vertices"
    expect(not np.any(apart), f"{words}: a rest shape is one island: unwrap it without cuts")
    step = np.roll(rest[faces], 1, axis=1) - rest[faces]
    square = np.sum((np.roll(x[faces], 1, axis=1) - x[faces]) ** 2, axis=2).ravel()
    scale = np.sqrt(np.maximum(np.linalg.lstsq(step.reshape(-1, 2) ** 2, square)[0], 0))
    strain = np.std(np.linalg.norm(step * scale, axis=2).ravel() / np.sqrt(square))
    words = f"edges of the texture differ by {100 * strain:.2g} % (rms) from those in space"
    expect(strain < STRAIN and min(scale) > 0, f"{words}: unwrap it with less distortion")
    rest *= scale * [np.sign(np.sum(np.linalg.det(step[:, 1:]))), 1]
    notes.append(f"warp along u; 1 is {scale[0]:.4g} m in u, {scale[1]:.4g} m in v; {words}")
    return rest


def _check_unit(size: np.ndarray, scale: float | None) -> None:
    low, high, side = *SIDES, float(max(size))
    fits = [f"{k} ({side * m:.3g} m)" for k, m in UNITS.items() if low <= side * m <= high]
    words = f"the sheet is {size[0]:.4g} by {size[1]:.4g}, hardly in metres"
    words += ": in centimetres, millimetres or inches? State it"
    remedy = f"--unit {' or '.join(fits) or 'm'}; scale=metres per unit"
    expect(scale is not None or low <= side <= high, f"{words}: {remedy}")


def _border(
    trimesh: Any, rest: np.ndarray, faces: np.ndarray, tilted: bool, notes: list[str]
) -> Float[np.ndarray, "vertex 2"]:
    """Name holes, refuse cuts; the rest shape, its warp along the border if it is tilted."""
    sheet = trimesh.Trimesh(np.pad(rest, ((0, 0), (0, 1))), faces, process=False)
    ends = sheet.edges[trimesh.grouping.group_rows(sheet.edges_sorted, require_count=1)]
    step = rest[ends[:, 1]] - rest[ends[:, 0]]
    length = np.linalg.norm(step, axis=1)
    sides, count = np.unique(sheet.edges, axis=0, return_counts=True)
    place = np.round(rest[sides[np.argmax(count), 0]], 4)
    expect(max(count) < 2, f"faces lie over each other at {place} m: a sheet is one flat layer")
    loop = trimesh.graph.connected_component_labels(ends, len(rest))[ends[:, 0]]
    for each in np.unique(loop):
        ring, start = loop == each, ends[np.argmax(loop == each), 0]
        around = np.sum(length[ring])
        twice = np.linalg.det(np.stack([rest[ends[:, 0]] - rest[start], step], axis=1))
        if (width := -np.sum(twice[ring]) / around) > -CUT * np.median(length):  # not the outer
            words = f"{1e3 * around:.4g} mm around, at {np.round(rest[start], 4)} m"
            is_hole = width > CUT * np.median(length)
            expect(is_hole, f"a cut, {words}, whose sides touch: join them at the same vertices")
            notes.append(f"a hole, {words}")
    bins = (np.arctan2(step[:, 1], step[:, 0]) * 1000 / np.pi).round().astype(int) % 1000
    total = np.bincount(bins, length)
    straight = step[np.argmax(length * (bins == np.argmax(total)))] @ [1, 1j]
    angle = np.angle((straight / abs(straight)) ** 4) / 4
    if np.max(total) > STRAIGHT * np.sum(length) and abs(angle) > (1e-9 if tilted else SQUARE):
        words = f"most of the border is at {np.degrees(angle):.3g} degrees to this warp"
        notes.append(f"{words}, which {'is turned there' if tilted else 'stays'}")
        turned = rest @ [1, 1j] * np.exp(-1j * angle * tilted)
        rest = np.column_stack([turned.real, turned.imag])
    return rest


def _make(
    rest: np.ndarray, faces: np.ndarray, quads: np.ndarray, notes: list[str]
) -> tuple[Mesh, Int[np.ndarray, " vertex"]]:
    """The mesh, of a grid if quadrilaterals make one, and the order of its vertices."""
    if len(quads):
        spacing = np.median(np.ptp(rest[quads], axis=1), axis=0)
        place, size = (rest - rest.min(axis=0)) / spacing, np.ptp(rest, axis=0).tolist()
        cell = np.round(place).astype(int)
        shape, order = tuple((cell.max(axis=0) + 1).tolist()), np.lexsort(cell.T[::-1])
        is_grid = len(rest) == np.prod(shape) and np.max(np.abs(place - cell)) < PLANE
        if is_grid and 2 * len(quads) == len(faces) and np.all(np.ptp(cell[quads], axis=1) == 1):
            notes.append(f"{len(quads)} quadrilaterals, a grid of {shape[0]} x {shape[1]} vertices")
            mesh = rectangle((size[0], size[1]), (shape[0], shape[1]))
            return dataclasses.replace(mesh, rest=jnp.asarray(rest[order], float)), order
        notes.append(f"{len(quads)} quadrilaterals, no uniform grid along the warp, are cut")
    return Mesh.make(rest, faces), np.arange(len(rest))
