"""What a user sees while a command computes: what it does, and for how long."""

import shutil
import sys
import threading
import time
from typing import Any

TICK, PAUSE = 1.0, 30.0  # [s]


class Waiting:
    """A line on a terminal that says what is done, rewritten every `tick` seconds.

    A thread of its own rewrites it: the main one waits for the compiler or the solver, which let
    others run. Called as a `Progress` of an estimator, it shows iteration and loss. A `stream` that
    is no terminal, such as a file, gets a line of its own every `pause` seconds.
    """

    def __init__(
        self, words: str, stream: Any = None, tick: float = TICK, pause: float = PAUSE
    ) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._is_terminal = self._stream.isatty()
        tick = tick if self._is_terminal else pause
        self._words, self._numbers, self._began, self._since = words, "", *[time.monotonic()] * 2
        self._tick, self._stop = tick, threading.Event()
        self._lock, self._thread = threading.Lock(), threading.Thread(target=self._run, daemon=True)

    def say(self, words: str) -> None:
        """What is done from now on."""
        self._words, self._since = words, time.monotonic()
        self._rewrite()

    def __call__(self, iteration: int, loss: float) -> None:
        self._numbers = f", iteration {iteration}, root of loss {1e3 * loss**0.5:.3g} mm"
        self._rewrite()

    def __enter__(self) -> "Waiting":
        self._thread.start()
        return self

    def __exit__(self, *_) -> None:
        self._stop.set()
        self._thread.join()
        if self._is_terminal:
            self._stream.write("\r\x1b[K")
            self._stream.flush()

    def _rewrite(self) -> None:
        if self._is_terminal:
            self._write()

    def _run(self) -> None:
        self._rewrite()
        while not self._stop.wait(self._tick):
            self._write()

    def _write(self) -> None:
        if self._stop.is_set():
            return
        now = time.monotonic()
        here, all_ = now - self._since, now - self._began
        text = f"{self._words}{self._numbers}: {here:.0f} s, {all_:.0f} s in all"
        if not self._is_terminal:
            print(text, file=self._stream, flush=True)
            return
        with self._lock:
            width = shutil.get_terminal_size().columns - 1  # a line that is folded would stay
            self._stream.write(f"\r\x1b[K{text[:width]}")
            self._stream.flush()
