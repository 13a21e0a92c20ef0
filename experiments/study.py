"""Which approach, which simulator, which scenario? Every cell of the study, and its report.

python experiments/study.py --workers 2              # one fabric, about 20 minutes
python experiments/study.py --preset paper --slurm 16 --out paper    # days, for a cluster
python experiments/study.py --data FOLDER            # recordings (see README, "Your recordings")
"""

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # before JAX: see `r2s.__main__`

from r2s import compilation  # noqa: E402
from r2s.study.main import study  # noqa: E402

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Estimate, and judge on motions never seen.")
    add = parser.add_argument
    add("--preset", default="one_fabric", help="one_fabric, three_fabrics, paper or full")
    add("--data", type=Path, help="folder of recordings; synthetic ones without")
    add("--out", type=Path, default=Path("results"), help="folder of the results")
    add("--paper", type=Path, help="folder of the tables of Ru et al. 2025, to set beside ours")
    add("--density", type=float, default=0.15, help="areal density of recordings [kg/m^2]")
    add("--materials", default="", help="folder of measured tables, FABRIC.json (ARCSim)")
    name = "such as diffcloud-cloth-lifting, instead of the preset's; was --columns"
    add("--configurations", "--columns", nargs="*", help=name)
    add("--fabrics", nargs="*", help="presets, instead of the preset's")
    add("--repeats", type=int, help="estimates of each fabric")
    add("--judged", type=int, help="motions to judge by, of each scenario")
    add("--seed", type=int, default=0)
    add("--workers", type=int, default=1, help="processes on this machine (extra cluster)")
    add("--scheduler", default="", help="address of a Dask scheduler, such as tcp://node:8786")
    add("--slurm", type=int, default=0, help="jobs of a Slurm cluster")
    add("--compilation-cache", type=Path, help="folder where workers keep compiled programs")
    add("--no-cache", action="store_true", help="keep no compiled programs, and read none")
    settings = vars(parser.parse_args())
    if settings.pop("no_cache"):
        compilation.forget()
    try:
        missing = study(**settings)
        sys.exit(f"{missing} cells are missing: see the report" if missing else 0)
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"error: {error}")
