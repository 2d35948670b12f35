"""The HTML report."""

import hashlib
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.cli.main import main
from pam_ocp.figures import write_report
from pam_ocp.figures.sheets import Grid
from pam_ocp.studies.file_kinds import load


class Page(HTMLParser):
    """Tags that are opened are closed; nothing is loaded from elsewhere."""

    VOID = frozenset({"meta", "img", "br", "hr", "link"})

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.ids, self.links = [], [], set(), []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        said = dict(attrs)
        self.ids.add(said.get("id"))
        if tag == "img":
            assert said["src"].startswith("data:image/png;base64,")
        if tag == "a":
            self.links.append(said["href"])
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        assert tag in self.VOID
        self.handle_starttag(tag, attrs)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def files(static_fit, load_motion, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    pam.save_muscle(static_fit.muscle(name="<b>mine</b>"), folder / "muscle.toml")
    static_fit.to_json(folder / "fit.json")
    load_motion.save(folder / "motion.npz")
    return folder


def test_a_report_is_one_page_with_all_that_was_given(files, tmp_path):
    named = [files / n for n in ("muscle.toml", "fit.json", "motion.npz")]
    out = tmp_path / "r.html"
    assert main(["report", *map(str, named), "--out", str(out), "--title", "Rig & all"]) == 0
    text = out.read_text("utf-8")
    page = Page(text)
    assert page.open == []
    assert not {"script", "link", "iframe"} & set(page.tags)
    assert not re.search(r"https?://(?!www\.w3\.org)", re.sub(r"data:image[^\"]*", "", text))
    assert {link.removeprefix("#") for link in page.links} <= page.ids
    assert page.tags.count("img") == 3
    assert "Rig &amp; all" in text
    assert "&lt;b&gt;mine" in text  # a name is text
    for file in named:
        assert hashlib.sha256(file.read_bytes()).hexdigest() in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("none.toml",), "none.toml"),
        (("README.md",), "README.md"),
        (("motion.npz", "--out", "r.pdf"), ".html"),
    ],
)
def test_what_cannot_be_shown_is_said(files, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(files)
    (files / "README.md").write_text("x")
    assert main(["report", *arguments]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    assert not (files / "report.html").exists()


CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_on_a_telephone_nothing_lies_beside_the_page(files, tmp_path):
    things = {n: load(files / n) for n in ("muscle.toml", "fit.json", "motion.npz")}
    write_report(tmp_path / "r.html", {**things, "plant": pam.AntagonisticSlide("DMSP-20-200N")})
    (tmp_path / "frame.html").write_text(
        '<iframe id="f" src="r.html" style="width:390px;border:0"></iframe><p id="p"></p><script>'
        "f.onload = () => p.textContent = f.contentDocument.documentElement.scrollWidth</script>"
    )
    browser = [CHROMIUM, "--headless", "--no-sandbox", "--allow-file-access-from-files"]
    browser += ["--virtual-time-budget=5000", "--dump-dom", str(tmp_path / "frame.html")]
    page = subprocess.run(browser, capture_output=True, text=True, timeout=120, check=True).stdout
    assert 300 < int(re.search(r'<p id="p">(\d+)', page)[1]) <= 390


def test_columns_without_content_are_left_out_and_tables_keep_them():
    grid = Grid(("name", "start", "unit"), [("x", "", "mm"), ("y", "", "N")])
    assert re.findall("<th>(.*?)</th>", grid.html()) == ["name", "unit"]
    assert re.findall("<td.*?>(.*?)</td>", grid.html()) == ["x", "mm", "y", "N"]


def test_what_shows_nothing_is_refused(tmp_path):
    refused("ndarray", write_report, tmp_path / "r.html", {"numbers": np.zeros(3)})
    refused("empty", write_report, tmp_path / "r.html", {})
