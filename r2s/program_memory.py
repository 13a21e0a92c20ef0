"""What compiled programs hold of a process: those of one shape are of no use for others."""

import ctypes
import gc
import sys
from pathlib import Path

import equinox as eqx
import jax

from r2s import kept, programs
from r2s.extras import require

MAPPED, MOST_MAPPED = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
SHARE = 0.5  # of the mappings that Linux allows, beyond which programs go


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


def let_go_in_time() -> None:
    """Let compiled programs go if this process has used `SHARE` of the mappings it may have.

    A derivative of a motion takes a thousand, Linux allows 65,530 by default, and a process that
    asks for more ends in a segmentation fault. What is needed again is compiled again, or read from
    where it is kept.
    """
    if mappings() > SHARE * most_mappings():
        let_go()


def mappings() -> int:
    """How many mappings this process has; 0 where the system does not tell."""
    return MAPPED.read_bytes().count(b"\n") if MAPPED.exists() else 0


def most_mappings() -> float:
    """How many a process may have; infinite where the system does not tell."""
    return float(MOST_MAPPED.read_text()) if MOST_MAPPED.exists() else float("inf")


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
