"""The commands that README and docs show are understood; `test_packaging` runs the quickstart."""

import re
import shlex

import pytest
from folders import ROOT

from r2s.cli.main import COMMANDS, main

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMAND = re.compile(r"^ +(r2s [a-z](?:.*\\\n)*.*)$", re.MULTILINE)


def commands(text: str) -> list[list[str]]:
    """The arguments of each command of `r2s` that stands on a line of its own."""
    lines = (found.replace("\\\n", " ") for found in COMMAND.findall(text))
    return [shlex.split(line, comments=True)[1:] for line in lines]


ALL = {" ".join(each): each for path in DOCUMENTS for each in commands(path.read_text("utf-8"))}


@pytest.mark.parametrize("arguments", ALL.values(), ids=ALL)
def test_a_command_of_the_documents_is_understood(arguments, monkeypatch):
    ran = []
    for kind in COMMANDS.values():
        monkeypatch.setattr(kind, "run", lambda self: ran.append(self))
    if arguments[-1] == "--help":
        with pytest.raises(SystemExit, match="0"):
            main(arguments)
    else:
        assert main(arguments) == 0
        assert len(ran) == 1
