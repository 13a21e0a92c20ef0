"""The line that says what a command does: it moves while nothing else does, on terminals alone."""

import io
import time

from r2s.cli.waiting import Waiting


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_line_moves_while_the_main_thread_waits() -> None:
    terminal = Terminal()
    with Waiting("compiling the motion", terminal, tick=0.02) as line:
        time.sleep(0.3)
        before = terminal.getvalue().count("compiling the motion")
        line.say("simulating 60 frames")
        line(3, 4e-6)
    told = terminal.getvalue()
    assert before >= 5 and "simulating 60 frames" in told
    assert "iteration 3, root of loss 0.002" in told and told.endswith("\r\x1b[K")


def test_nothing_is_written_where_nobody_looks() -> None:
    file = io.StringIO()
    with Waiting("compiling", file, tick=0.01) as line:
        time.sleep(0.05)
        line.say("simulating")
    assert file.getvalue() == ""
