"""The console script `r2s`, and `python -m r2s`: settings that come before NumPy and JAX."""

import os
import sys


def command() -> int:
    """Run the command line of this process; its exit code."""
    # XLA warns at length of each program that is read from a file: it takes its own preferences of
    # instructions for features that the machine lacks
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # the threads of OpenBLAS wait for each other over small matrices: a motion on 17 x 17 vertices
    # takes 1.6 times as long on two of them as on one
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from r2s.cli.main import command

    return command()


if __name__ == "__main__":
    sys.exit(command())
