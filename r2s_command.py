"""The console script `r2s`: what must be said before JAX is loaded, then `r2s.cli`.

A module of its own, since `import r2s` loads JAX.
"""

import os


def command() -> int:
    """Run the command line of this process; its exit code."""
    # XLA doubts each program that is read from a file, at length: it takes its own preferences of
    # instructions for features that the machine lacks
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # its threads wait for each other over matrices as small as ours: a motion on 17 x 17 vertices
    # takes 1.6 times as long on two of them as on one
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from r2s.cli import command

    return command()
