"""The main job: which fabric was that, and how well does it predict a motion never seen?

python experiments/study.py                          # five known fabrics, made by the solver
python experiments/study.py --data FOLDER            # recordings (see README, "Your recordings")
"""

import argparse
import sys
from pathlib import Path

from r2s.study import pairs, pictures, run, tables


def main(data: str, out: Path, density: float, only: str, effort: run.Effort) -> None:
    if data:
        found = pairs.recorded_pairs(Path(data), density, only)
        kind = f"recordings in {data}, areal density assumed {density:g} kg/m^2"
    else:
        found = pairs.synthetic_pairs(list(pairs.presets.FIVE), effort.seed)
        kind = "synthetic recordings of five known fabrics, made by the same solver"
    out.mkdir(parents=True, exist_ok=True)
    judged, rows = run.run(found, out, effort)
    settings = {"data": kind, **{k: str(v) for k, v in vars(effort).items()}}
    intro = (
        f"Fabrics estimated from a lift and judged on a fold that the estimate never saw: {kind}."
    )
    for table in pictures.publish(out, judged, rows, settings, intro):
        print(f"\n{tables.markdown(table)}")
    print(f"\n{out / 'report.html'} has the pictures, {out / 'results.csv'} every figure.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Estimate from lifts, judge on folds.")
    parser.add_argument("--data", default="", help="folder of recordings; synthetic when empty")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of the results")
    parser.add_argument("--density", type=float, default=0.15, help="areal density [kg/m^2]")
    parser.add_argument("--only", default="", help="regular expression for names of lifts")
    parser.add_argument("--recipe", default="default", choices=("default", "original"))
    parser.add_argument("--coarse", type=int, default=24, help="places of the coarse search")
    parser.add_argument("--starts", type=int, default=3, help="descents from the best of them")
    parser.add_argument("--iterations", type=int, default=25, help="Gauss-Newton steps")
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args()
    try:
        effort = run.Effort(run.Cost(a.coarse, a.starts, a.iterations), a.recipe, a.seed)
        main(a.data, a.out, a.density, a.only, effort)
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
