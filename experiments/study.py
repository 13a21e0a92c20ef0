"""Which approach, which simulator, which scenario? Every cell of the study, and its report.

python experiments/study.py --preset small           # minutes; "paper" and "full" are for a cluster
python experiments/study.py --data FOLDER            # recordings (see README, "Your recordings")
"""

import argparse
import sys
from pathlib import Path

from r2s.study import engine, matrix, results


def runner(a: argparse.Namespace) -> engine.Runner:
    if not (a.workers > 1 or a.scheduler or a.slurm):
        return engine.Serial()
    from r2s.study import cluster

    if a.scheduler:
        return cluster.at(a.scheduler)
    return cluster.slurm(a.slurm) if a.slurm else cluster.local(a.workers, a.compilation_cache)


def main(a: argparse.Namespace) -> int:
    about = a.columns, a.fabrics, a.repeats, a.judged, a.materials, a.seed
    plan = matrix.narrowed(matrix.PRESETS[a.preset], *about)
    if a.data:
        cells = matrix.recorded(a.data, a.density, plan)
    else:
        cells = matrix.synthetic(plan)
    workers = runner(a)
    try:
        failed = engine.run(cells, a.out, workers)
    finally:
        workers.close()
    results.publish(cells, failed, a.out, plan, str(a.data or "synthetic recordings"), a.paper)
    return 1 if failed else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Estimate, and judge on motions never seen.")
    add = parser.add_argument
    add("--preset", default="small", choices=matrix.PRESETS)
    add("--data", type=Path, help="folder of recordings; synthetic ones without")
    add("--out", type=Path, default=Path("results"), help="folder of the results")
    add("--paper", type=Path, help="folder of the tables of Ru et al. 2025, to set beside ours")
    add("--density", type=float, default=0.15, help="areal density of recordings [kg/m^2]")
    add("--materials", default="", help="folder of measured tables, FABRIC.json (ARCSim)")
    add("--columns", nargs="*", help="such as diffcloud-cloth-lifting, instead of the preset's")
    add("--fabrics", nargs="*", help="presets, instead of the preset's")
    add("--repeats", type=int, help="estimates of each fabric")
    add("--judged", type=int, help="motions to judge by, of each scenario")
    add("--seed", type=int, default=0)
    add("--workers", type=int, default=1, help="processes on this machine (extra cluster)")
    add("--scheduler", default="", help="address of a Dask scheduler, such as tcp://node:8786")
    add("--slurm", type=int, default=0, help="jobs of a Slurm cluster")
    add("--compilation-cache", type=Path, help="folder where workers keep compiled programs")
    try:
        sys.exit(main(parser.parse_args()))
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"error: {error}")
