"""The line that says what a command does: it moves on a terminal, and is written to a file."""

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
    assert "iteration 3, root of loss 2 mm" in told and told.endswith("\r\x1b[K")


def test_a_file_gets_a_line_now_and_then() -> None:
    file = io.StringIO()
    with Waiting("compiling", file, pause=0.1) as line:
        line.say("simulating")
        line(1, 4e-6)
        time.sleep(0.35)
    lines = file.getvalue().splitlines()
    assert 2 <= len(lines) <= 4 and all(each.startswith("simulating") for each in lines)
    quick = io.StringIO()
    with Waiting("compiling", quick):
        pass
    assert quick.getvalue() == ""
