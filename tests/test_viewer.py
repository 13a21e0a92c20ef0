"""A report with a viewer: what a browser decodes and draws is what was stored."""

import json
import re
import subprocess
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from browser import BROWSER, needs_browser
from made_up_study import made_up_comparison
from test_report import Page

from r2s.study.report import player
from r2s.study.report.figures import looks_of
from r2s.study.report.motions import MotionComparison
from r2s.study.report.page import Section, write_report
from r2s.study.tables import Table

FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--window-size=900,900", "--virtual-time-budget=3000", "--dump-dom",
)  # fmt: skip
TABLE = Table(("n", "v"), (("b", "10 [9, 11]"), ("a", "9.5"), ("c", "diverged"), ("d", "-")), "")

# What a reader does, after which the page holds what came of it.
DEEDS = """
<script>
addEventListener("load", () => {
  const root = document.querySelector(".viewer"), canvas = root.querySelector("canvas");
  const slider = root.querySelector("input[type=range]");
  const picture = () => {
    const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
    let sum = 0;
    for (let i = 0; i < pixels.length; i++) sum = (31 * sum + pixels[i]) % 4294967291;
    return sum;
  };
  const found = { pictures: [picture()] };
  const change = (element, kind) => {
    element.dispatchEvent(new Event(kind));
    found.pictures.push(picture());
  };
  slider.value = 1;
  change(slider, "input");
  found.clock = root.querySelector("output").textContent;
  const boxes = [...root.querySelectorAll("input[type=checkbox]")];
  boxes[1].checked = false;
  change(boxes[1], "change");
  canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft" }));
  found.pictures.push(picture());
  canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "+" }));
  found.pictures.push(picture());
  found.sheet = [...root.viewer.positions("b")];
  found.points = [...root.viewer.positions("")];
  const choice = root.querySelector("select");
  choice.value = 1;
  change(choice, "change");
  found.legend = root.querySelector(".legend").textContent;
  const heads = document.querySelectorAll("table.sortable th");
  const column = i => [...document.querySelectorAll("tbody tr")].map(r => r.cells[i].textContent);
  heads[1].click();
  found.up = column(0);
  heads[1].click();
  found.down = column(0);
  const out = document.createElement("pre");
  out.id = "found";
  out.textContent = JSON.stringify(found);
  document.body.append(out);
});
</script>
"""


def diverged() -> MotionComparison:
    shown = made_up_comparison("shaking", "pink_solid")
    shown.motions["b"][2:] = np.nan
    return shown


@pytest.fixture(scope="module")
def recordings():
    return [made_up_comparison(), diverged()]


def page(path, recordings, extra=""):
    looks = looks_of(label for each in recordings for label in each.motions)
    shown = player.viewer(recordings, looks)
    section = Section("Motions", ("Words.",), (TABLE,), html=shown + extra)
    write_report(path, "A study", "", [section])
    return path.read_text()


def test_nothing_is_fetched_and_tags_are_closed(tmp_path, recordings):
    text = page(tmp_path / "report.html", recordings)
    found = Page(text)
    assert not re.search("https?:|//|@import|url\\(", re.sub('base64,[^"]*', "", text).lower())
    assert all("src" not in script for script in found.all("script"))
    assert len(found.all("canvas")) == 1 and len(found.all("option")) == 2
    assert player.viewer([], {}) == ""


def test_labels_are_escaped(tmp_path):
    shown = made_up_comparison(labels=("</script><b>",), fabric="<i>")
    found = Page(page(tmp_path / "report.html", [shown]))
    assert not {"i", "b"} & {tag for tag, _ in found.tags}


def test_size_of_a_long_recording():
    generator = np.random.default_rng(0)
    clouds = tuple(generator.normal(size=(3000, 3)) for _ in range(120))
    motions = {f"column {i}": generator.normal(size=(120, 81, 3)) for i in range(12)}
    faces = dict.fromkeys(motions, np.array([[0, 1, 2]]))
    errors = dict.fromkeys(motions, np.zeros((1, 120)))
    shown = MotionComparison(
        "f", "fling", "fling_f1", np.arange(120.0), clouds, faces, motions, errors
    )
    text = player.viewer([shown], looks_of(motions))
    assert 0.5 * player.BUDGET < len(text) < player.BUDGET + 30_000


def test_what_cannot_be_shown_is_refused(unchecked):
    shown = made_up_comparison()
    with pytest.raises(ValueError, match="fling_black_denim1: expected a cloud for each of 6"):
        replace(shown, clouds=shown.clouds[:2])
    both = dict(shown.motions)
    with pytest.raises(ValueError, match=r"fling_black_denim1, a: expected \(6, vertex, 3\)"):
        replace(shown, motions=both | {"a": both["a"][:3]})
    with pytest.raises(ValueError, match="the faces name vertex 15"):
        replace(shown, motions=both | {"a": both["a"][:, :9]})
    with pytest.raises(ValueError, match="expected errors of a, b, found those of a"):
        replace(shown, errors={"a": shown.errors["a"]})
    with pytest.raises(ValueError, match=r"fling_black_denim1, a: expected errors \(run, 6\)"):
        replace(shown, errors=dict(shown.errors) | {"a": shown.errors["a"][:, :3]})


@needs_browser
def test_in_a_browser(tmp_path, recordings):
    page(tmp_path / "report.html", recordings, DEEDS)
    command = (str(BROWSER), *FLAGS, f"--user-data-dir={tmp_path / 'profile'}")
    done = subprocess.run(
        [*command, (tmp_path / "report.html").as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    match = re.search('<pre id="found">(.*?)</pre>', done.stdout, re.DOTALL)
    assert match, done.stdout[-2000:]
    found = json.loads(match[1])
    assert len(set(found["pictures"])) == len(found["pictures"]) == 6
    assert found["clock"] == "frame 1, 0.20 s"
    shown = recordings[0]
    rounded: dict[str, Any] = {"atol": 0.51 * player.STEP, "rtol": 1e-6}
    np.testing.assert_allclose(
        np.reshape(found["sheet"], shown.motions["b"].shape), shown.motions["b"], **rounded
    )
    points = np.reshape(found["points"], (-1, 3))
    every = np.concatenate(shown.clouds)
    assert len(points) == len(every)
    points, every = (x[np.lexsort(np.round(x, 3).T)] for x in (points, every))
    np.testing.assert_allclose(points, every, **rounded)
    assert "b (diverged)" in found["legend"]
    assert found["up"] == ["a", "b", "d", "c"]
    assert found["down"][:2] == ["b", "a"] and set(found["down"][2:]) == {"c", "d"}
