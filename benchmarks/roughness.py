"""Where gradients of a cloth's loss help, and where they do not.

python benchmarks/roughness.py --out results/roughness      # all, about half an hour on one core
python benchmarks/roughness.py choices --small              # a quick trial of one part

- `cloth`: the loss along lines through the truth, at four widths, with the exact slope there.
- `choices`: descents from the same starts with exact slopes, secants, settled frames, windows,
  more damping, smoothing, coarse meshes.
- `losses`: which distance from cloud to sheet is precise, unbiased, cheap and far-sighted.
- `points`: whether derivatives of material points explode, by time step, contact or chaos.

Each prints its tables and writes CSV and pictures. What is done is kept in `*.npz` of the folder,
and not made again. CPU seconds, with compilation where it says so.
"""

import argparse
from pathlib import Path

PARTS = ("cloth", "choices", "losses", "points")


def run(part: str, out: Path, small: bool) -> None:
    """One part; imported here, since each compiles and draws what the others need not."""
    import importlib

    importlib.import_module(f"roughness_{part}").main(out, small)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Where gradients of a cloth's loss help.")
    parser.add_argument("parts", nargs="*", default=[], help=f"of {', '.join(PARTS)}; all")
    parser.add_argument("--out", type=Path, default=Path("results/roughness"))
    parser.add_argument("--small", action="store_true", help="a quick trial, in OUT/small")
    a = parser.parse_args()
    if unknown := set(a.parts) - set(PARTS):
        parser.error(f"no part {', '.join(unknown)}: there are {', '.join(PARTS)}")
    folder = a.out / "small" if a.small else a.out
    folder.mkdir(parents=True, exist_ok=True)
    for part in a.parts or PARTS:
        run(part, folder, a.small)
