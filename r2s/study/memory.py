"""Memory of a process that makes cells: what was compiled for one shape is of no use for others."""

import ctypes
import gc
import sys

import equinox as eqx
import jax

from r2s import kept, programs
from r2s.extras import require


def let_go_beyond(most: float) -> None:
    """Let compiled programs go if this process holds more memory than `most` [byte].

    Those that are kept in files (`r2s.programs`) are soon there again; where none are, nothing is
    let go.
    """
    if programs.kept() is None:
        return
    psutil = require("psutil", "study", "a study")
    if psutil.Process().memory_info().rss <= most:
        return
    let_go()


def let_go() -> None:
    """Let all compiled programs of this process go, and give their memory back."""
    kept.let_go()
    eqx.clear_caches()
    jax.clear_caches()
    gc.collect()
    if sys.platform == "linux":  # what was freed goes back to the system
        malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc alone
        if malloc_trim is not None:
            malloc_trim(0)
