"""How fast is the cloth of r2s, beside its peers, in one run on one machine?

python benchmarks/cloth.py                                # everything; an hour or more
python benchmarks/cloth.py --only hang --sizes 9          # a part, one size
python benchmarks/cloth.py --only scaling --sizes 17 33 65 129

JAX's threads get in each other's way on steps as small as these, and the peers use one: so the
program keeps to one core, unless --cores says otherwise (0: all).

Peers: pip install -e '.[bench]'; those that are missing are skipped. Times are process CPU seconds
(wall seconds where JAX runs on a GPU), without compilation. Tables go to stdout, progress to
stderr, and with --out everything to a JSON file.
"""

import argparse
import json
import shlex
import sys
from pathlib import Path

import hang
import jax
import measure
import parts

from r2s import files

PARTS = ("hang", "lift", "compile", "scaling", "batch", "explicit", "memory")


def main(options: argparse.Namespace) -> None:
    jax.config.update("jax_enable_x64", options.double)
    about = measure.machine()
    about |= {"command": shlex.join(["python", *sys.argv])}
    about |= {"float": 64 if options.double else 32, "damping_s": options.damping}
    print(", ".join(f"{name}: {value}" for name, value in about.items()))
    rows = []

    def written(more: list[measure.Row]) -> None:
        if options.out:
            files.write_json(options.out, {"machine": about, "rows": rows + more})

    options.written = written
    for part in options.only:
        rows += getattr(parts, part)(options)
        written([])


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Time the cloth of r2s beside its peers.")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="parts to run")
    parser.add_argument(
        "--sizes", nargs="+", type=int, help="vertices a side (default: 9 33 65; 17 33 65 scaling)"
    )
    parser.add_argument(
        "--references", nargs="*", type=int, default=[9], help="sizes to measure accuracy at"
    )
    parser.add_argument("--systems", default="", help="regular expression for their names")
    parser.add_argument("--damping", type=float, default=0.01, help="time [s] where it can be had")
    parser.add_argument("--cores", type=int, default=1, help="to run on; 0: all")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--budget", type=float, default=20.0, help="repeat no longer than this [s]")
    parser.add_argument("--members", type=int, default=64, help="fabrics of a batch")
    parser.add_argument("--double", action="store_true", help="r2s and mass-spring in float64")
    parser.add_argument("--out", type=Path, help="JSON file")
    parser.add_argument("--probe", nargs=2, metavar=("SYSTEM", "SIZE"), help=argparse.SUPPRESS)
    parser.add_argument(
        "--system", nargs=3, metavar=("SYSTEM", "SIZE", "FOLDER"), help=argparse.SUPPRESS
    )
    options = parser.parse_args()
    if any(size < 2 for size in options.sizes or ()) or options.repeats < 1:
        parser.error("--sizes must be at least 2 and --repeats at least 1")
    return options


if __name__ == "__main__":
    arguments = _arguments()
    measure.keep_to(arguments.cores)
    if arguments.probe:
        name, size = arguments.probe
        print(json.dumps(parts.probe(name, int(size), arguments)))
        sys.exit()
    if arguments.system:
        jax.config.update("jax_enable_x64", arguments.double)
        name, size, folder = arguments.system
        print(json.dumps(hang.of_system(name, int(size), Path(folder), arguments)))
        sys.exit()
    try:
        main(arguments)
    except OSError as error:
        sys.exit(f"error: {error}")
