"""How long RGB-D images take to become clouds, and how much memory.

    python benchmarks/rgbd.py --frames 60 --cameras 2 --across 1280 --down 720

A few frames are rendered and written, then copied until there are enough; a process of its own
converts them, so that its peak memory is that of the conversion.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

RENDERED = 4
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
        size = write(Path(folder), args)
        out = subprocess.run(
            [sys.executable, __file__, "--convert", folder], check=True, stdout=subprocess.PIPE
        )
    found = json.loads(out.stdout)
    images = args.frames * args.cameras
    print(f"{args.frames} frames, {args.cameras} cameras, {args.across} x {args.down}")
    print(f"files           {images} depth images and as many masks, {size / 1e6:.0f} MB")
    print(
        f"conversion      {found['seconds']:.1f} s, {1e3 * found['seconds'] / images:.0f} ms/image"
    )
    print(f"processor time  {found['processor']:.1f} s")
    print(f"peak memory     {found['peak']:.0f} MB, {found['before']:.0f} MB of them the libraries")
    print(f"points          {found['points']:.0f} a frame")


def write(folder: Path, args: argparse.Namespace) -> int:
    """Write the images; returns their size in bytes."""
    from r2s.mesh import rectangle
    from r2s.observe.calibration import DepthCamera, look_at
    from r2s.observe.cleaning import Cleaning
    from r2s.observe.rgbd import Rig
    from r2s.observe.synthetic_rgbd import write_rgbd

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


def peak() -> float:
    """Peak memory of this process [MB]; getrusage would count that of the parent (Linux)."""
    status = Path("/proc/self/status").read_text()
    found = re.search(r"VmHWM:\s+(\d+) kB", status)
    assert found, "no VmHWM in /proc/self/status"
    return int(found[1]) / 1e3


def convert(folder: Path) -> None:
    from r2s.observe import images
    from r2s.observe.rgbd import read_rig, stream

    images.opencv()
    before = peak()
    start, processor = time.perf_counter(), time.process_time()
    counts = [len(points) for _, points in stream(folder, read_rig(folder))]
    found = {
        "seconds": time.perf_counter() - start,
        "processor": time.process_time() - processor,
        "peak": peak(),
        "before": before,
        "points": float(np.mean(counts)),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
