"""Clouds as other programs write them: read in order, and every point."""

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import numpy as np
import pytest
from folders import ROOT
from test_clouds import PCD, rows, write_cloud

from r2s.recordings.clouds import read_cloud, read_frames

SIX = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0.5]], np.float32)
LITTLE = "binary_little_endian"
XYZ = "".join(f"property float {axis}\n" for axis in "xyz")
VERTICES = f"element vertex 6\n{XYZ}"
FACES = "element face {}\nproperty list uchar int vertex_indices\n"
SEAM = "".join(f"{x:g} {y:g} {z:g} .5 .5\n" for x, y, z in SIX) + "3 0 1 2\n3 0 2 3\n"
TEXTURED = f"{VERTICES}property float s\nproperty float t\n" + FACES.format(2)
CAMERA = "element camera 2\nproperty float view_px\n"
COLOURED = [("normal", ">f8", 3), ("xyz", ">f8", 3), ("rgb", "u1", 3)]


def ply(kind: str, header: str, body: bytes) -> bytes:
    return f"ply\nformat {kind} 1.0\ncomment by hand\n{header}end_header\n".encode() + body


def coloured() -> bytes:
    """Normals before doubles, colours behind, the largest byte first."""
    values = np.zeros(6, COLOURED)
    values["xyz"] = SIX
    names = ["double nx", "double ny", "double nz", "double x", "double y", "double z"]
    names += ["uchar red", "uchar green", "uchar blue"]
    header = "element vertex 6\n" + "".join(f"property {name}\n" for name in names)
    return ply("binary_big_endian", header, values.tobytes())


def ascii_pcd(end: str, start: str = "") -> bytes:
    lines = "".join(f"{start}{x:g} {y:g} {z:g}{end}" for x, y, z in SIX)
    return (PCD.format(6, "ascii") + lines).encode()


AS_OTHERS_WRITE = {
    "textured.ply": ply("ascii", TEXTURED, SEAM.encode()),
    "crlf.ply": ply("ascii", TEXTURED, SEAM.encode()).replace(b"\n", b"\r\n"),
    "empty_faces.ply": ply(LITTLE, f"{VERTICES}element face 0\n", SIX.tobytes()),
    "empty_lists.ply": ply(LITTLE, VERTICES + FACES.format(0), SIX.tobytes()),
    "coloured.ply": coloured(),
    "camera_first.ply": ply("ascii", f"{CAMERA}{VERTICES}", b"1\n2\n" + rows(SIX)),
    "binary_camera_first.ply": ply(LITTLE, f"{CAMERA}{VERTICES}", bytes(8) + SIX.tobytes()),
    "blank.pcd": ascii_pcd(" \n"),
    "tabs.pcd": ascii_pcd("\t\n").replace(b" ", b" "),
    "indented.pcd": ascii_pcd("\n", "  "),
    "crlf.pcd": ascii_pcd(" \n").replace(b"\n", b"\r\n"),
    "blank_line.pcd": ascii_pcd("\n") + b"\n \n",
    "normals.xyz": rows(np.hstack([SIX, 0 * SIX])),
}


@pytest.mark.parametrize("name", AS_OTHERS_WRITE)
def test_clouds_as_other_programs_write_them_are_read_in_order(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(AS_OTHERS_WRITE[name])
    np.testing.assert_array_equal(read_cloud(tmp_path / name), SIX)


@pytest.mark.parametrize("kind", ["npy", "ascii.ply", "binary.ply", "ascii.pcd", "binary.pcd"])
def test_points_that_are_no_numbers_are_left_out_and_counted(tmp_path: Path, kind: str) -> None:
    """As PCL and Open3D write an organised cloud."""
    points = np.where(np.arange(6)[:, None] % 3 == 1, np.float32(np.nan), SIX)
    files = []
    for frame in range(2):
        (tmp_path / str(frame)).mkdir()
        files.append(write_cloud(tmp_path / str(frame) / kind, points))
    with pytest.warns(
        UserWarning, match=r"33\.3% of the points are NaN, not measured: left out"
    ) as said:
        clouds = read_frames(files)
    assert len(said) == 1
    for read in (*clouds, read_cloud(files[0])):
        np.testing.assert_array_equal(read, SIX[[0, 2, 3, 5]])


WRITERS = ["open3d-cpu==0.20.0", "pye57==0.4.19", "pymeshlab==2025.7.post1", "libusb-package"]
WRITE = """
import sys; from pathlib import Path; import numpy as np, open3d, pye57, pymeshlab
to, points = Path(sys.argv[1]), np.load(Path(sys.argv[1]) / "points.npy")
cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
for colours in ("plain", "coloured"):
    for i, kind in enumerate(("ascii", "binary", "compressed")):
        for suffix in ("ply", "pcd"):
            file = str(to / f"open3d_{colours}_{kind}.{suffix}")
            open3d.io.write_point_cloud(file, cloud, write_ascii=i == 0, compressed=i == 2)
    cloud.colors = cloud.normals = open3d.utility.Vector3dVector(np.abs(points) / 9)
tensor = open3d.t.geometry.PointCloud(points.astype(np.float32))
for kind in ("ascii", "binary"):
    for suffix in ("ply", "pcd"):
        file = str(to / f"open3dt_{kind}.{suffix}")
        open3d.t.io.write_point_cloud(file, tensor, write_ascii=kind == "ascii")
for what, faces in (("cloud", []), ("mesh", [[0, 1, 2], [0, 2, 3]])):
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(points, np.array(faces, np.int32).reshape(-1, 3)))
    if faces:
        meshes.compute_texcoord_parametrization_triangle_trivial_per_wedge(textdim=64)
    for binary in (True, False):
        meshes.save_current_mesh(str(to / f"meshlab_{what}_{binary}.ply"), binary=binary)
    for suffix in ("obj", "xyz", "e57")[: 2 if faces else 3]:
        meshes.save_current_mesh(str(to / f"meshlab_{what}.{suffix}"))
turn, shift = np.array([np.cos(0.3), 0, 0, np.sin(0.3)]), np.array([1.0, 2, 3])
local = (points - shift) @ pye57.e57.Quaternion(turn).rotation_matrix
for name, state in (("all", None), ("marked", np.array([0, 2] * 6, np.int8))):
    fields = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), np.ascontiguousarray(local.T)))
    if state is not None:
        fields = {k: np.repeat(v, 2) * np.where(state, 0, 1) for k, v in fields.items()}
        fields["cartesianInvalidState"] = state
    with pye57.E57(str(to / f"pye57_{name}.e57"), mode="w") as file:
        file.write_scan_raw(fields, rotation=turn, translation=shift)
"""
READ = """
import sys; from pathlib import Path; import numpy as np
sys.path.append(sys.argv[2])
from r2s.recordings.clouds import READERS, read_cloud
points = np.load(Path(sys.argv[1]) / "points.npy")
for file in sorted(Path(sys.argv[1]).iterdir()):
    if file.suffix in READERS:
        np.testing.assert_allclose(read_cloud(file), points, atol=2e-6, err_msg=file.name)
        print(file.name)
"""


@pytest.mark.slow(group="documents")
def test_what_open3d_pye57_pymeshlab_and_pypcd4_write_is_read(tmp_path: Path) -> None:
    """All of them are installed for the test, in a folder of its own."""
    from pypcd4.pypcd4 import Encoding, PointCloud

    points = np.random.default_rng(0).uniform(-1, 1, (6, 3))
    np.save(tmp_path / "points.npy", points)
    for encoding in Encoding:
        PointCloud.from_xyz_points(points).save(tmp_path / f"pypcd4_{encoding.value}.pcd", encoding)
    venv.create(tmp_path / "venv", with_pip=True)
    python = str(tmp_path / "venv/bin/python")
    subprocess.run([python, "-m", "pip", "install", "-q", *WRITERS], check=True)
    (packages,) = (tmp_path / "venv/lib").glob("*/site-packages")
    # Open3D needs it, and a server may lack it
    shutil.copy(next(packages.glob("libusb_package/libusb-1.0.so*")), tmp_path / "libusb-1.0.so.0")
    with_libusb = os.environ | {"LD_LIBRARY_PATH": str(tmp_path)}
    subprocess.run([python, "-c", WRITE, str(tmp_path)], check=True, env=with_libusb)
    command = [sys.executable, "-c", READ, str(tmp_path), str(packages)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-2000:]
    assert len(done.stdout.split()) == 32
