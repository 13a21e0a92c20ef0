"""How far a study has come, on stderr: a bar on a terminal, a line every half minute in a file."""

import io
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from tqdm import tqdm

from r2s.study.durations import in_words

REFRESH, LINES = 1.0, 30.0  # [s] between updates of the bar, and between lines
SHAPE = "{desc}: {percentage:3.0f} %, {elapsed} elapsed{postfix}"
TRUST = 300.0  # [s] that count as done as fast as expected, until cells that are made say more


@contextmanager
def progress(seconds: float, cells: int, processes: int) -> Iterator[tqdm]:
    """A bar to update by the expected CPU seconds of each cell that is done, of `seconds` in all.

    It moves while cells are running: the main thread waits for them.
    """
    is_terminal = sys.stderr.isatty()
    stream = sys.stderr if is_terminal else io.StringIO()
    stop = threading.Event()
    with tqdm(total=seconds, desc=f"study of {cells} cells", bar_format=SHAPE, file=stream) as bar:

        def show() -> None:
            while not stop.wait(REFRESH if is_terminal else LINES):
                pace = (TRUST + bar.format_dict["elapsed"]) / (TRUST + bar.n / processes)
                left = pace * (seconds - bar.n) / processes
                bar.set_postfix_str(f"about {in_words(left)} left", refresh=False)
                if is_terminal:
                    bar.refresh()
                else:
                    print(bar, file=sys.stderr, flush=True)

        thread = threading.Thread(target=show, daemon=True)
        thread.start()
        try:
            yield bar
        finally:
            stop.set()
            thread.join()
