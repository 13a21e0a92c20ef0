"""A study that is killed again and again, beside one that is not: are the figures the same?

python benchmarks/study_kills.py --kills 10                 # the run itself, by kill -9
python benchmarks/study_kills.py --kills 10 --workers 2     # or one of its workers

One column and fabric. Every run is killed after a time that is drawn; the last one is left alone.
Prints what was made when, and whether `results.csv` is the same to the byte.
"""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from measure import progress

ROOT = Path(__file__).parents[1]
STUDY = ("--columns", "diffcloud-cloth-lifting", "--fabrics", "grey_interlock", "--judged", "1")


def start(out: Path, workers: int) -> subprocess.Popen:
    command = [sys.executable, "experiments/study.py", *STUDY, "--out", str(out)]
    command += ["--workers", str(workers)]
    with open(out.with_suffix(".log"), "a") as log:
        return subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log, start_new_session=True)


def made(out: Path) -> int:
    return len(list(out.rglob("*.zip")))


def workers_of(pid: int) -> list[int]:
    """The processes that make cells: children of the nannies, which are children of the run."""
    found = []
    for process in Path("/proc").iterdir():
        if process.name.isdigit():
            try:
                line = (process / "cmdline").read_bytes().split(b"\0")
                session = os.getsid(int(process.name))
            except (OSError, ProcessLookupError):
                continue
            if session == pid and b"--multiprocessing-fork" in line:
                found.append(int(process.name))
    return found


def kill_run(running: subprocess.Popen) -> None:
    os.killpg(running.pid, signal.SIGKILL)
    running.wait()


def disturbed(out: Path, kills: int, workers: int, longest: float, draw: random.Random) -> None:
    running = start(out, workers)
    for number in range(1, kills + 1):
        time.sleep(draw.uniform(5, longest))
        if running.poll() is not None:
            progress(f"kill {number}: it had ended already, with {made(out)} cells")
            shutil.rmtree(out)
            out.mkdir()
            running = start(out, workers)
            continue
        victims = workers_of(running.pid) if workers > 1 else []
        progress(f"kill {number}: {'a worker' if victims else 'the run'}, {made(out)} cells made")
        if victims:
            os.kill(draw.choice(victims), signal.SIGKILL)
        else:
            kill_run(running)
            running = start(out, workers)
    progress(f"left alone: it ended with {running.wait()}, {made(out)} cells made")


def main(out: Path, kills: int, workers: int, longest: float, seed: int) -> None:
    for name in ("undisturbed", "disturbed"):
        (out / name).mkdir(parents=True, exist_ok=True)
    if not (out / "undisturbed" / "results.csv").exists():
        progress(f"undisturbed: ended with {start(out / 'undisturbed', 1).wait()}")
    disturbed(out / "disturbed", kills, workers, longest, random.Random(seed))
    first, second = (out / name / "results.csv" for name in ("undisturbed", "disturbed"))
    same = first.read_bytes() == second.read_bytes()
    print(f"results.csv is {'the same' if same else 'DIFFERENT'} after {kills} kills")
    sys.exit(0 if same else 1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Kill a study at random moments.")
    parser.add_argument("--out", type=Path, default=Path("results/kills"))
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--longest", type=float, default=90.0, help="[s] between kills")
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args()
    main(a.out, a.kills, a.workers, a.longest, a.seed)
