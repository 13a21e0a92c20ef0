#!/bin/sh
# trimesh.load(..., process=False), which is documented to leave vertices alone, changes those of a
# PLY whose vertices have texture coordinates s and t: vertices that no face uses are dropped, and
# one that a seam shares is doubled. So a textured cloud loses points, without a word. With
# fix_texture=False all vertices come, in the order of the file.
#
# Seen with trimesh 5.2.0: 4 vertices of 6; with fix_texture=False 6.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q trimesh==5.2.0 numpy==2.4.6
"$folder/venv/bin/python" - "$folder/textured.ply" <<'PYTHON'
import sys

import numpy as np
import trimesh

points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]], float)
header = ["ply", "format ascii 1.0", "element vertex 6"]
header += [f"property float {name}" for name in ("x", "y", "z", "s", "t")]
header += ["element face 2", "property list uchar int vertex_indices", "end_header"]
rows = ["%g %g %g .5 .5" % tuple(point) for point in points] + ["3 0 1 2", "3 0 2 3"]
with open(sys.argv[1], "w") as file:
    file.write("\n".join([*header, *rows, ""]))
kept = trimesh.load(sys.argv[1], process=False).vertices
every = trimesh.load(sys.argv[1], process=False, fix_texture=False).vertices
print("trimesh", trimesh.__version__, "vertices:", len(kept), "with fix_texture=False:", len(every))
assert len(kept) == 4, "it has changed"
assert np.array_equal(every, points)
PYTHON
