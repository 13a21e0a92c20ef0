"""A report is one file, whole, without links, and reads no text as HTML."""

import base64
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from r2s.study.report.page import PNG, Section, write_report
from r2s.study.tables import Table

VOID = {"meta", "img", "link", "br", "hr", "input"}
TABLE = Table(("fabric", "estimate [mm]"), (("a<b", "1.0"), ("mean", "1.0")), "on the fold", foot=1)


class Page(HTMLParser):
    """Checks that tags are closed in order; collects tags, attributes and text."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.text = [], [], ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture
def images(tmp_path):
    generator = np.random.default_rng(0)
    paths = [tmp_path / "one.png", tmp_path / "two.png"]
    for path in paths:
        path.write_bytes(PNG + generator.bytes(5000))
    return paths


@pytest.fixture
def report(tmp_path, images):
    sections = [
        Section("The <fold>", ("5 < 6 & so on.",), (TABLE, TABLE), ((images[0], 'a "caption"'),)),
        Section("Lift", figures=((images[1], "<b>bold</b>"),)),
    ]
    path = tmp_path / "report.html"
    write_report(path, "A <study>", "One.\n\nTwo <i>.\n", sections)
    return path


def test_every_figure_is_within(report, images):
    found = Page(report.read_text()).all("img")
    assert [image["alt"] for image in found] == ['a "caption"', "<b>bold</b>"]
    for image, path in zip(found, images, strict=True):
        kind, data = image["src"].split(",")
        assert kind == "data:image/png;base64"
        assert base64.b64decode(data) == path.read_bytes()


def test_nothing_is_fetched(report):
    text = report.read_text()
    page = Page(text)
    assert not re.search("https?:|//|@import|url\\(", re.sub('base64,[^"]*', "", text).lower())
    attributes = {name for _, found in page.tags for name in found}
    assert "href" not in attributes
    assert all("src" not in found for found in page.all("script"))


def test_text_is_escaped_and_shown(report):
    page = Page(report.read_text())
    expected = ["A <study>", "The <fold>", "5 < 6 & so on.", "Two <i>.", "a<b"]
    for text in [*expected, "<b>bold</b>", "on the fold"]:
        assert text in page.text
    tags = {tag for tag, _ in page.tags}
    assert not tags & {"study", "fold", "i", "b"}
    assert len(page.all("p")) == 3
    assert [found.get("class") for found in page.all("table")] == ["sortable", "sortable"]


def test_phones_and_the_dark(report):
    page = Page(report.read_text())
    assert {"name": "viewport", "content": "width=device-width, initial-scale=1"} in page.all(
        "meta"
    )
    assert "prefers-color-scheme: dark" in page.text


def test_a_missing_figure_is_named_and_nothing_is_written(tmp_path):
    section = Section("Fold", figures=((tmp_path / "lost.png", ""),))
    with pytest.raises(FileNotFoundError, match="lost.png"):
        write_report(tmp_path / "report.html", "A study", "", [section])
    (tmp_path / "lost.png").write_text("no picture")
    with pytest.raises(ValueError, match="lost.png.*PNG"):
        write_report(tmp_path / "report.html", "A study", "", [section])
    assert [path.name for path in tmp_path.iterdir()] == ["lost.png"]


def test_the_smallest_report(tmp_path):
    write_report(tmp_path / "report.html", "A study", "", [])
    page = Page((tmp_path / "report.html").read_text())
    assert page.all("table") == [] and page.all("p") == [] and len(page.all("h1")) == 1
