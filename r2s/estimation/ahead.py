"""Programs that an estimate will need soon, compiled on another core while it computes."""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from r2s import programs
from r2s.cores import compiling


@contextmanager
def compiling_ahead() -> Iterator[Callable[..., None]]:
    """A function that compiles a `r2s.kept.Kept` for some arguments, one after the other.

    It returns at once. Who calls the kept function before it is ready waits for it. Nothing is
    compiled ahead where no programs are kept. It is on the cores of `r2s.cores.compiling`. At the
    end what has not begun is left out.
    """
    more, waiting, is_over = threading.Condition(), deque[tuple[Any, tuple]](), False

    def run() -> None:
        while True:
            with more:
                more.wait_for(lambda: waiting or is_over)
                if is_over:
                    return
                function, arguments = waiting.popleft()
            with suppress(Exception):  # it is raised again where the function is called
                with compiling():
                    function.prepare(*arguments)

    thread = threading.Thread(target=run, name="compiling ahead", daemon=True)

    def prepare(function: Any, *arguments: Any) -> None:
        if programs.kept() is None:
            return
        with more:
            waiting.append((function, arguments))
            more.notify()
        if thread.ident is None:
            thread.start()

    yield prepare  # after an error nobody waits for the thread
    with more:
        is_over = True
        more.notify()
    if thread.ident is not None:
        thread.join()
