"""One HTML file that holds a whole study: words, tables and pictures, without any link."""

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from r2s.files import write_text
from r2s.study import tables
from r2s.study.tables import Table

PNG = b"\x89PNG\r\n\x1a\n"

STYLE = """
:root { color-scheme: light dark; --ink: #1c1c1c; --paper: #ffffff; --line: #d0d0d0;
  --soft: #f3f4f6; --dim: #5a5a5a; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e6e6; --paper: #16181c; --line: #3c4048; --soft: #22262c; --dim: #a4a8b0; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem; max-width: 75rem; color: var(--ink);
  background: var(--paper); font: 1rem/1.5 system-ui, sans-serif; overflow-wrap: break-word; }
p { max-width: 45rem; }
h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--line); }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
caption, figcaption { text-align: left; color: var(--dim); font-size: .9rem; padding: .3rem 0; }
th, td { border-bottom: 1px solid var(--line); padding: .3rem .7rem; text-align: left;
  vertical-align: top; }
thead th { background: var(--soft); }
.sortable thead th { cursor: pointer; }
th[aria-sort=ascending]::after { content: " \\25b2"; }
th[aria-sort=descending]::after { content: " \\25bc"; }
td.number { text-align: right; white-space: nowrap; }
tfoot td { font-weight: 600; }
figure { margin: 1.5rem 0; }
.beside { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 30rem), 1fr));
  gap: 0 1rem; }
.beside figure { margin: .5rem 0; min-width: 0; }
img { display: block; max-width: 100%; height: auto; background: #ffffff; border-radius: .3rem; }
@media (max-width: 45rem) { figure img { max-width: none; width: 45rem; } }
"""

# Numbers by size, what is no number after them by the alphabet, whichever the direction.
SCRIPT = """
for (const head of document.querySelectorAll("table.sortable thead th")) {
  head.addEventListener("click", () => {
    const up = head.getAttribute("aria-sort") !== "ascending";
    for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const body = head.closest("table").tBodies[0];
    const text = row => row.cells[head.cellIndex].textContent.trim();
    const order = (a, b) => {
      const x = parseFloat(text(a)), y = parseFloat(text(b));
      if (isNaN(x) !== isNaN(y)) return isNaN(x) ? 1 : -1;
      const less = (x - y) || text(a).localeCompare(text(b));
      return up ? less : -less;
    };
    body.append(...[...body.rows].sort(order));
  });
}
"""


@dataclass(frozen=True)
class Section:
    """A part of a report: paragraphs, then tables, then pictures (a PNG file and its caption).

    - `html`: last, is put in as it is: a fragment that is trusted, such as
      `r2s.study.report.player`'s.
    - `beside`: pictures stand two in a row where the page is wide enough.
    """

    heading: str
    paragraphs: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[tuple[Path, str], ...] = ()
    html: str = ""
    beside: bool = False


def write_report(
    path: Path | str,
    title: str,
    intro: str,
    sections: Sequence[Section],
) -> None:
    """Write a report as one HTML file, which needs no other file and no network.

    `intro`: paragraphs of plain text, apart by empty lines. All text but `Section.html` is escaped.
    Raises FileNotFoundError that names a figure that is missing, ValueError that names one that is
    no PNG, and OSError that names `path`; then nothing is written.
    """
    paragraphs = [part for part in intro.split("\n\n") if part.strip()]
    body = "".join(map(_section, sections))
    text = (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{escape(title)}</h1>\n{_paragraphs(paragraphs)}{body}"
        f"<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )
    write_text(path, text)


def _section(section: Section) -> str:
    shown = "".join(f'<div class="wide">\n{tables.html(t)}</div>\n' for t in section.tables)
    pictures = "".join(_figure(Path(path), caption) for path, caption in section.figures)
    if section.beside and pictures:
        pictures = f'<div class="beside">\n{pictures}</div>\n'
    heading = f"<h2>{escape(section.heading)}</h2>\n"
    body = f"{_paragraphs(section.paragraphs)}{shown}{pictures}{section.html}"
    return f"<section>\n{heading}{body}</section>\n"


def _paragraphs(paragraphs: Iterable[str]) -> str:
    return "".join(f"<p>{escape(text.strip())}</p>\n" for text in paragraphs)


def _figure(path: Path, caption: str) -> str:
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise FileNotFoundError(error.errno, "the figure of a report is missing", path) from error
    if not data.startswith(PNG):
        raise ValueError(f"{path}: the figure of a report must be a PNG")
    source = "data:image/png;base64," + base64.b64encode(data).decode("ascii")
    picture = f'<img alt="{escape(caption)}" src="{source}">'
    return (
        f'<figure>\n<div class="wide">{picture}</div>\n'
        f"<figcaption>{escape(caption)}</figcaption>\n</figure>\n"
    )
