"""Which approach, which simulator, which scenario? `r2s study`, by default into `results`.

python experiments/study.py --workers 2              # one fabric, about 20 minutes
python experiments/study.py --preset paper --slurm 16 --out paper    # days, for a cluster
python experiments/study.py --data FOLDER            # recordings (see README, "Your recordings")
"""

import sys

from r2s.__main__ import command

if __name__ == "__main__":
    sys.argv[1:] = ["study", "--out", "results", *sys.argv[1:]]  # the last --out counts
    sys.exit(command())
