"""How long RGB-D images take to become a recording (`r2s data convert`), and how much memory.

    python benchmarks/rgbd.py --frames 60 --cameras 2 --across 1280 --down 720

A few frames are rendered and written, then copied until there are enough; a process of its own
converts them, so that its peak memory is that of the conversion.
"""

import argparse
import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

RENDERED = 4
NAME = "lift_made_1"
POSITIONS = {"left": (-0.5, -0.1, 0.5), "right": (0.1, -0.4, 0.9)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--cameras", type=int, default=2, choices=(1, 2))
    parser.add_argument("--across", type=int, default=1280)
    parser.add_argument("--down", type=int, default=720)
    parser.add_argument("--convert", type=Path, help="only convert this folder")
    args = parser.parse_args()
    if args.convert:
        convert(args.convert)
        return
    with tempfile.TemporaryDirectory() as folder:
        size = write(Path(folder) / NAME, args)
        describe(Path(folder), args.frames)
        out = subprocess.run(
            [sys.executable, __file__, "--convert", folder], check=True, stdout=subprocess.PIPE
        )
    found = json.loads(out.stdout)
    images = args.frames * args.cameras
    cores = len(os.sched_getaffinity(0))
    print(
        f"{args.frames} frames, {args.cameras} cameras, {args.across} x {args.down}, {cores} cores"
    )
    print(f"files           {images} depth images and as many masks, {size / 1e6:.0f} MB")
    print(
        f"conversion      {found['seconds']:.1f} s, {1e3 * found['seconds'] / images:.0f} ms/image"
    )
    print(f"processor time  {found['processor']:.1f} s")
    print(f"peak memory     {found['peak']:.0f} MB, {found['before']:.0f} MB of them the libraries")
    print(f"points          {found['points']:.0f} a frame")
    print(f"when up to date {found['again']:.1f} s")


def write(folder: Path, args: argparse.Namespace) -> int:
    """Write the images; returns their size in bytes."""
    from r2s.geometry.mesh import rectangle
    from r2s.recordings.cameras.calibration import DepthCamera, look_at
    from r2s.recordings.cameras.cleaning import Cleaning
    from r2s.recordings.cameras.rgbd import Rig
    from r2s.recordings.cameras.synthetic_rgbd import write_rgbd

    size = args.across, args.down
    lens = ((0.7 * size[0],) * 2, ((size[0] - 1) / 2, (size[1] - 1) / 2))
    cameras = {
        name: DepthCamera(size, *lens, look_at(position, (0.22, 0.22, 0.1)), 1e-3)
        for name, position in list(POSITIONS.items())[: args.cameras]
    }
    box = Cleaning(((-0.1, -0.1, -0.02), (0.6, 0.6, 0.6)), max_points=4000)
    mesh = rectangle((0.45, 0.45), (17, 17))
    flat = np.asarray(mesh.rest)
    heights = [0.1 + 0.03 * np.sin(12 * flat[:, 0] + 0.3 * k) for k in range(RENDERED)]
    x = np.stack([np.column_stack([flat, z]) for z in heights])
    times = np.arange(RENDERED) / 15
    write_rgbd(folder, Rig(cameras, box, 15.0), x, np.asarray(mesh.faces), times, colour=False)
    for name in cameras:
        (folder / name / "times.csv").unlink()
        for kind in ("depth", "masks"):
            for frame in range(RENDERED, args.frames):
                source = folder / name / kind / f"{frame % RENDERED:03d}.png"
                shutil.copy(source, source.with_name(f"{frame:03d}.png"))
    return sum(path.stat().st_size for path in folder.rglob("*.png"))


def describe(folder: Path, frames: int) -> None:
    """The manifest of the recording, and its gripper's path."""
    from r2s.recordings.manifest import default_manifest

    manifest = json.loads((default_manifest().parent / "templates" / "study.json").read_text())
    manifest["scenarios"]["lift"]["frames_used"] = [0, frames - 1]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    np.save(folder / "lift_gripper.npy", np.zeros((frames, 3)))


def peak() -> float:
    """Peak memory of this process [MB]; getrusage would count that of the parent (Linux)."""
    status = Path("/proc/self/status").read_text()
    found = re.search(r"VmHWM:\s+(\d+) kB", status)
    assert found, "no VmHWM in /proc/self/status"
    return int(found[1]) / 1e3


def convert(folder: Path) -> None:
    from r2s.cli import main as r2s
    from r2s.recordings.cameras import images
    from r2s.recordings.recording import load

    images.require("cv2", "camera", "depth images")
    before = peak()
    out = folder / "out"
    command = ["data", "convert", str(folder), "--to", str(out)]
    start, processor = time.perf_counter(), time.process_time()
    with contextlib.redirect_stdout(sys.stderr):
        code = r2s(command)
    found = {
        "seconds": time.perf_counter() - start,
        "processor": time.process_time() - processor,
        "peak": peak(),
        "before": before,
    }
    if code:
        sys.exit(code)
    start = time.perf_counter()
    with contextlib.redirect_stdout(sys.stderr):
        r2s(command)
    found["again"] = time.perf_counter() - start
    found["points"] = float(np.mean(load(out / f"{NAME}.npz").mask.sum(axis=1)))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
