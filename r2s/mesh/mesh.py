"""The rest shape of a sheet: a mesh in material coordinates, and what follows from it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r2s.mesh.bends import Bends
from r2s.mesh.plate_elements import PlateElements
from r2s.mesh.strain_samples import StrainSamples, cells

ELEMENTS = ("wrinkling", "quadrilaterals", "falling", "rising", "alternating")  # of a rectangle
SMALLEST, LARGEST = 1e-3, 50.0  # [m], of sheets


class Mesh(eqx.Module):
    """A flat sheet at rest, with its warp along the first material axis.

    Its surface is made of triangles, where cameras and the sheet itself meet it. Strain, drag and
    curvature are those of the triangles, too, or those of the cells and vertices of a grid
    (`rectangle`).

    - `rest`: material coordinates (warp, weft), [m].
    - `faces`: corners of the triangles, counter-clockwise in material coordinates.
    - `hinges`: the two ends of each inner edge, then the two vertices opposite to it.
    - `area`, `vertex_area`: rest areas of the faces, and the share of each vertex in them, [m^2].
    - `hinge_length`, `hinge_area`: of each hinge's edge [m], and its two faces together [m^2].
    - `hinge_direction`: angle between the warp and the line that the hinge bends, which is at right
      angles to its edge, 0 to pi/2 [rad].
    - `hinge_bends`: the bends at the hinges.
    - `samples`: where strain is evaluated, in elements on which the air acts, too.
    - `plate`: where curvature is evaluated.
    """

    rest: Float[Array, "vertex 2"]
    faces: Int[Array, "face 3"]
    hinges: Int[Array, "hinge 4"]
    area: Float[Array, " face"]
    vertex_area: Float[Array, " vertex"]
    hinge_length: Float[Array, " hinge"]
    hinge_area: Float[Array, " hinge"]
    hinge_direction: Float[Array, " hinge"]
    hinge_bends: Bends
    samples: StrainSamples
    plate: PlateElements

    @classmethod
    def make(cls, rest: Float[np.ndarray, "vertex 2"], faces: Int[np.ndarray, "face 3"]) -> "Mesh":
        """A mesh of linear triangles, from material coordinates [m].

        Raises `ValueError` for wrong shapes, indices out of range, vertices in no face, an edge of
        more than two faces, faces that are degenerate or clockwise, and a sheet below `SMALLEST` or
        above `LARGEST`, whose coordinates are probably not in metres.
        """
        rest, faces = np.asarray(rest, float), np.asarray(faces)
        _check(rest, faces)
        edges = rest[faces[:, 1:]] - rest[faces[:, :1]]  # (face, edge, material axis)
        area = np.linalg.det(edges) / 2
        if np.any(area <= 1e-12 * np.ptp(rest) ** 2):
            worst = int(np.argmin(area))
            raise ValueError(
                f"face {worst} has the signed area {area[worst]:.3g} m^2: "
                "faces must be counter-clockwise and not degenerate"
            )
        hinges, hinge_faces = _hinges(faces)
        ends = rest[hinges[:, 0]] - rest[hinges[:, 1]]
        vertex_area = np.zeros(len(rest))
        np.add.at(vertex_area, faces.ravel(), np.repeat(area / 3, 3))
        length = np.linalg.norm(ends, axis=-1)
        hinge_area = area[hinge_faces].sum(axis=-1)
        bends = Bends(
            vertices=jnp.asarray(hinges, int),
            weights=None,
            per_angle=jnp.asarray(length / hinge_area, float),
            rest_curvature=jnp.zeros(len(hinges), float),
        )
        return cls(
            rest=jnp.asarray(rest, float),
            faces=jnp.asarray(faces, int),
            hinges=jnp.asarray(hinges, int),
            area=jnp.asarray(area, float),
            vertex_area=jnp.asarray(vertex_area, float),
            hinge_length=jnp.asarray(length, float),
            hinge_area=jnp.asarray(hinge_area, float),
            hinge_direction=jnp.asarray(np.arctan2(*np.abs(ends.T)), float),
            hinge_bends=bends,
            samples=StrainSamples.of_triangles(rest, faces),
            plate=PlateElements.of_triangles(rest, faces, hinges, hinge_faces, area, bends),
        )

    def lay_flat(self, z: float = 0.0) -> Float[Array, "vertex 3"]:
        """Positions [m] of the sheet at rest in the plane at `z` [m], warp along x."""
        return jnp.pad(self.rest, ((0, 0), (0, 1)), constant_values=z)


def _check(rest: np.ndarray, faces: np.ndarray) -> None:
    if rest.ndim != 2 or rest.shape[1] != 2 or not np.all(np.isfinite(rest)):
        raise ValueError(f"rest must be finite, of shape (vertex, 2) [m], got shape {rest.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"faces must be integers of shape (face, 3), got shape {faces.shape}")
    if not len(faces):
        raise ValueError("a mesh needs at least one face, got none")
    lonely = np.setdiff1d(np.arange(len(rest)), faces)
    if faces.min() < 0 or faces.max() >= len(rest) or len(lonely):
        raise ValueError(
            f"faces must use each of the vertices 0 to {len(rest) - 1} and no other; "
            f"they go from {faces.min()} to {faces.max()} and leave out {lonely[:5].tolist()}"
        )
    extent = float(np.max(np.ptp(rest, axis=0))) if len(rest) else 0.0
    if not SMALLEST <= extent <= LARGEST:
        raise ValueError(
            f"the rest coordinates extend over {extent:g}, expected {SMALLEST} to {LARGEST} m: "
            "are they in millimetres, or normalised?"
        )


def _hinges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inner edges with their two opposite vertices, and the two faces of each."""
    # of each face: start, end and opposite vertex of its sides
    sides = np.stack([np.roll(faces, -k, axis=1) for k in range(3)], axis=2).reshape(-1, 3)
    edges, first, edge, count = np.unique(
        np.sort(sides[:, :2], axis=1),
        axis=0,
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )
    if np.max(count) > 2:
        low, high = edges[np.argmax(count)]
        raise ValueError(f"edge {low}-{high} belongs to {np.max(count)} faces, at most 2 may be")
    edge = edge.ravel()
    order = np.argsort(first[edge], kind="stable")  # edges in the order of their first sides
    pairs = order[count[edge[order]] == 2].reshape(-1, 2)
    left, right = sides[pairs].transpose(1, 0, 2)  # the left face goes from start to end
    if np.any(overlap := left[:, 0] == right[:, 0]):
        one, other = pairs[overlap][0] // 3
        low, high = sorted(left[overlap][0, :2].tolist())
        raise ValueError(
            f"faces {one} and {other} lie on the same side of edge {low}-{high}: faces must not "
            "overlap"
        )
    return np.column_stack([left, right[:, 2]]), pairs // 3


def borders(mesh: Mesh) -> Bool[Array, "face 3"]:
    """Which edges of the faces, each opposite to a corner, are borders of the sheet."""
    count = len(mesh.rest)

    def name(a: Array, b: Array) -> Array:
        return jnp.minimum(a, b) * count + jnp.maximum(a, b)

    edges = name(jnp.roll(mesh.faces, -1, axis=1), jnp.roll(mesh.faces, -2, axis=1))
    return ~jnp.isin(edges, name(mesh.hinges[:, 0], mesh.hinges[:, 1]))


def resized(mesh: Mesh, ratio: Float[Array, ""] | float) -> Mesh:
    """The sheet cut `ratio` times as long and as wide, of the same vertices."""

    def scaled(part: Any, lengths: Sequence[str], areas: Sequence[str], inverse: Sequence[str]):
        changed = {name: getattr(part, name) * ratio for name in lengths}
        changed |= {name: getattr(part, name) * ratio**2 for name in areas}
        return replace(part, **changed, **{name: getattr(part, name) / ratio for name in inverse})

    def bends(part: Bends) -> Bends:
        return scaled(part, (), (), ("per_angle", "rest_curvature"))

    waves = () if mesh.samples.hidden_waves is None else ("hidden_waves",)
    plate = scaled(mesh.plate, (), ("areas",), ())
    return replace(
        scaled(mesh, ("rest", "hinge_length"), ("area", "vertex_area", "hinge_area"), ()),
        hinge_bends=bends(mesh.hinge_bends),
        samples=scaled(mesh.samples, (), ("areas",), ("gradients", *waves)),
        plate=replace(plate, bends=bends(plate.bends)),
    )


def rectangle(
    size: tuple[float, float], shape: tuple[int, int] = (9, 9), elements: str = "wrinkling"
) -> Mesh:
    """A rectangle of `size` (warp, weft) [m] with `shape` vertices along warp and weft.

    Vertex (i, j) has the index i * shape[1] + j. The `elements` of strain and curvature are
    "quadrilaterals", which favour no direction; "wrinkling", quadrilaterals that give way under
    compression (`r2s.materials.wrinkling`); or triangles as of any other mesh, whose diagonals
    direct the folds: "falling" (from the corner of the warp to that of the weft), "rising" (from
    the origin to the opposite corner) or "alternating" (which bends too softly).

    Raises `ValueError` when a side is not positive or has no two vertices, or for other elements.

    >>> sheet = rectangle((0.3, 0.2), (4, 3))
    >>> sheet.rest.shape, sheet.faces.shape
    ((12, 2), (12, 3))
    """
    if not all(0 < side < np.inf for side in size) or min(shape) < 2:
        raise ValueError(f"a rectangle needs sides > 0 m and >= 2 vertices, got {size}, {shape}")
    rows, columns = shape
    warp, weft = np.meshgrid(
        np.linspace(0, size[0], rows), np.linspace(0, size[1], columns), indexing="ij"
    )
    a, b, c, d = cells(shape).T
    rises = _rises(elements, rows - 1, columns - 1).ravel()[:, None]
    first = np.where(rises, np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(rises, np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    mesh = Mesh.make(np.stack([warp.ravel(), weft.ravel()], 1), np.concatenate([first, second]))
    if elements not in ("quadrilaterals", "wrinkling"):
        return mesh
    spacing = size[0] / (rows - 1), size[1] / (columns - 1)
    plate = PlateElements.of_grid(spacing, shape)
    return replace(
        mesh,
        vertex_area=plate.areas,  # a vertex is an element of the plate
        samples=StrainSamples.of_grid(spacing, shape, elements == "wrinkling"),
        plate=plate,
    )


def _rises(elements: str, rows: int, columns: int) -> np.ndarray:
    """Whether the diagonal of a cell goes from its origin to its opposite corner."""
    if elements == "alternating":
        return np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 0
    if elements not in ELEMENTS:
        raise ValueError(f"elements are {', '.join(ELEMENTS)}, got {elements!r}")
    return np.full((rows, columns), elements == "rising")


def corner(shape: tuple[int, int], name: str) -> int:
    """Index of a corner of `rectangle`: "origin", "warp", "weft" or "opposite"."""
    rows, columns = shape
    corners = {"origin": 0, "weft": columns - 1, "warp": (rows - 1) * columns}
    corners["opposite"] = rows * columns - 1
    if name not in corners:
        raise ValueError(f"a corner is one of {sorted(corners)}, got {name!r}")
    return corners[name]
