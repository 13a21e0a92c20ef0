"""Kill a study again and again, and compare it with one that was left alone: the same to the byte?

python experiments/killed_study.py --kills 10                 # the run itself, by kill -9
python experiments/killed_study.py --kills 10 --workers 2     # or one of its workers

One configuration and fabric. A run is killed after a time that is drawn, and started again; the
last one is left alone. Ends with exit code 1 where the two `results.csv` differ.
"""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
from _tables import command_line

ROOT = Path(__file__).parents[1]
STUDY = "--configurations diffcloud-cloth-lifting --fabrics grey_interlock --judged 1".split()


def start(out: Path, workers: int) -> subprocess.Popen:
    """Start the study in a session of its own."""
    out.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, ROOT / "experiments" / "study.py", *STUDY]
    command += ["--out", out, "--workers", str(workers)]
    with open(out.with_suffix(".log"), "a") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)


def workers_of(running: subprocess.Popen) -> list[psutil.Process]:
    """The processes that make cells, which multiprocessing has spawned."""
    children = psutil.Process(running.pid).children(recursive=True)
    return [child for child in children if "--multiprocessing-fork" in child.cmdline()]


if __name__ == "__main__":
    parser = command_line(__doc__, "results/kills")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--longest", type=float, default=90.0, help="[s] between kills")
    a = parser.parse_args()
    start(a.out / "alone", 1).wait()
    draw, running = random.Random(0), start(a.out / "killed", a.workers)
    for number in range(a.kills):
        time.sleep(draw.uniform(5, a.longest))
        victims = workers_of(running) if a.workers > 1 and running.poll() is None else []
        print(f"kill {number}: {'a worker' if victims else 'the run'}", file=sys.stderr)
        if victims:
            draw.choice(victims).kill()
            continue
        os.killpg(running.pid, signal.SIGKILL)
        running = start(a.out / "killed", a.workers)
    running.wait()
    one, other = ((a.out / name / "results.csv").read_bytes() for name in ("alone", "killed"))
    print(f"results.csv is {'the same' if one == other else 'DIFFERENT'} after {a.kills} kills")
    sys.exit(one != other)
