"""A mesh of one's own: a disc from an OBJ file, held in the middle, as in a drape test.

    python examples/own_mesh.py [sheet.obj]

Any plane mesh will do: no grid is needed. `r2s doctor --mesh sheet.obj` checks a file.
Needs trimesh: pip install 'r2s[study]'
"""

import sys
import tempfile
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import trimesh

import r2s


def write_disc(path: Path, radius: float = 0.15, rings: int = 5) -> None:
    """A disc [m] of rings of six more triangles each, from its middle."""
    points, faces = [np.zeros((1, 2))], []
    for ring in range(1, rings + 1):
        angle = np.arange(6 * ring) * np.pi / (3 * ring)
        points.append(ring / rings * radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        inner, outer = 1 + 3 * ring * (ring - 1) - 6 * (ring - 1), 1 + 3 * ring * (ring - 1)
        for i in range(6 * ring):
            side, place = divmod(i, ring)

            def near(k, r=ring, a=inner):
                return 0 if r == 1 else a + k % (6 * (r - 1))

            here, there = outer + i, outer + (i + 1) % (6 * ring)
            faces.append((near(side * (ring - 1) + place), here, there))
            if place:
                back = near(side * (ring - 1) + place - 1)
                faces.append((back, here, near(side * (ring - 1) + place)))
    flat = np.pad(np.concatenate(points), ((0, 0), (0, 1)))
    trimesh.Trimesh(flat, faces, process=False).export(path)


if __name__ == "__main__":
    if not sys.argv[1:]:
        write_disc(file := Path(tempfile.mkdtemp()) / "disc.obj")
    path = sys.argv[1] if sys.argv[1:] else file
    file = r2s.read_mesh(path)
    print(*file.changes, *file.notes, sep="\n")
    sheet, centre = file.mesh, np.mean(file.mesh.rest, axis=0)
    middle = jnp.asarray(np.flatnonzero(np.linalg.norm(sheet.rest - centre, axis=1) < 0.07))
    solver = r2s.ImplicitCloth(r2s.Scene(sheet, middle), dt=0.02)
    start = jnp.pad(sheet.rest, ((0, 0), (0, 1)))
    control = r2s.Control(jnp.broadcast_to(start[middle], (75, len(middle), 3)))
    moved = eqx.filter_jit(r2s.simulate)(
        solver, r2s.presets.black_denim(), solver.init(start), control
    )
    print(f"{len(sheet.rest)} vertices; the edge hangs {-1e3 * moved.x[-1, :, 2].min():.1f} mm low")
