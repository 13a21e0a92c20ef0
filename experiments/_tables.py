"""Tables of experiments: written as CSV with what made them, printed as Markdown, and resumed."""

import argparse
import csv
import importlib.metadata
import io
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from r2s._util.files import source_hash, write_text
from r2s._util.threads import cores
from r2s.study.tasks import Task, processor, provenance

SOURCE = 16  # hexadecimal digits of a hash
Line = dict[str, str]  # of a table, by column


def made_by(tasks: Iterable[Task], folder: Path) -> Line:
    """The source that made the tasks of a line, and all that these need.

    Raises `ValueError` for more than one: figures of two sources are no table.
    """
    noted = {words.partition("source ")[2].partition(";")[0] for words in provenance(tasks, folder)}
    if len(noted) > 1:
        raise ValueError(f"{folder} is of several sources, empty it: {', '.join(sorted(noted))}")
    return {"made by source": ", ".join(source[:8] for source in noted)}


def command_line(document: str | None, out: str) -> argparse.ArgumentParser:
    """A parser described by the first line of a document, with the option `--out`."""
    parser = argparse.ArgumentParser(description=(document or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(out), help=f"by default {out}")
    return parser


def write(path: Path, lines: Sequence[Line], caption: str, facts: Line | None = None) -> None:
    """Write a table as CSV.

    Its first lines, each after "#", say what it is, which command made it, with which version and
    source of r2s (`r2s._util.files.source_hash`), on which machine and when; `facts`
    replaces any of these, or adds to them.
    """
    comments = {
        "table": caption,
        "command": shlex.join(["python", *sys.argv]),
        "version": f"r2s {importlib.metadata.version('r2s')}",
        "source": source_hash()[:SOURCE],
        "seed": "that of the command, else as the driver has it",
        "machine": f"{cores()} cores, {processor()}",
        "date": time.strftime("%Y-%m-%d"),
    } | (facts or {})
    path.parent.mkdir(parents=True, exist_ok=True)
    head = "".join(f"# {name}: {text}\n" for name, text in comments.items())
    text = io.StringIO()
    writer = csv.DictWriter(text, _header(lines), lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    write_text(path, head + text.getvalue())


def keep(path: Path, lines: Sequence[Line], caption: str, facts: Line | None = None) -> None:
    """Write a table as CSV, as `write` does, and print it as Markdown."""
    write(path, lines, caption, facts)
    print(markdown(lines, caption))


def read(path: Path) -> tuple[list[Line], Line]:
    """Read the lines of a table that `write` wrote, and what its comments say."""
    text = path.read_text(encoding="utf-8").splitlines()
    comments = [line[2:].split(": ", 1) for line in text if line.startswith("# ")]
    lines = csv.DictReader(line for line in text if not line.startswith("# "))
    return list(lines), {name: fact for name, fact in comments}


def shown(path: Path) -> str:
    """A table that `write` wrote in Markdown, and below it what made it."""
    lines, facts = read(path)
    made = [facts[name] for name in ("version", "machine", "date", "cost") if name in facts]
    return f"{markdown(lines, facts['table'])}\n`{facts['command']}`: {', '.join(made)}.\n"


def insert(document: Path, name: str, table: str) -> None:
    """Put a table between the two marks of its name in a document, in place of what is there."""
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
    before, _, rest = document.read_text(encoding="utf-8").partition(begin)
    if end not in rest:
        raise ValueError(f"{document}: expected the lines {begin.strip()} and {end.strip()}")
    write_text(document, before + begin + table + end + rest.partition(end)[2])


def resumed(
    path: Path, caption: str, jobs: Iterable[Line], make: Callable[..., Line]
) -> list[Line]:
    """Make one line for each job, keep the table after each, and skip the jobs that it holds.

    Raises `ValueError` for a table that another version, source or processor began.
    """
    lines: list[Line] = []
    if path.exists():
        lines, facts = read(path)
        by = facts.get("machine", "").partition(", ")[2]
        made = facts.get("version", ""), facts.get("source", "no known source"), by
        own = f"r2s {importlib.metadata.version('r2s')}", source_hash()[:SOURCE], processor()
        if made != own:
            begun = f"begun by {' on '.join(made)}, not {' on '.join(own)}"
            raise ValueError(f"{path}: {begun}: move it away, or give another --out")
    for job in jobs:
        if any(job.items() <= line.items() for line in lines):
            continue
        print(", ".join(job.values()), file=sys.stderr, flush=True)
        lines.append(job | make(**job))
        write(path, lines, caption)
    print(markdown(lines, caption))
    return lines


def markdown(lines: Sequence[Line], caption: str) -> str:
    """A caption and a table in Markdown; what a line lacks stays empty."""
    header = _header(lines)
    rows = [header, ["---"] * len(header), *([x.get(name, "") for name in header] for x in lines)]
    return f"{caption}\n\n" + "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _header(lines: Sequence[Line]) -> list[str]:
    return list(dict.fromkeys(name for line in lines for name in line))
