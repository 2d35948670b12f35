"""What the pages of docs/ and the README show runs as it stands there, block after block; names and
files that they speak of are there.
"""

import json
import logging
import re
import shutil
from pathlib import Path

import pytest

import pam_ocp as pam

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text("utf-8")
FRAGMENT = "<!-- a fragment -->\n"
BLOCK = re.compile(rf"({FRAGMENT})?^```python\n(.*?)^```", re.S | re.M)


def script(page):
    """The page's blocks as one script, at their lines; fragments left out."""
    text, lines = page.read_text("utf-8"), []
    for match in BLOCK.finditer(text):
        if match[1]:
            continue
        at = text.count("\n", 0, match.start(2))
        lines += [""] * (at - len(lines)) + match[2].splitlines()
    return "\n".join(lines)


ELSEWHERE = {"files", "fitting"}
"""Pages whose tests also look at what each block prints."""
SITE = {"fmu", "howto", "ladder", "planning", "problem_files", "tutorial", "vibration"}
"""Long pages, whose blocks run when the site is made; tests/site.py looks at what they printed."""
PAGES = {
    page.stem: code
    for page in sorted(DOCS.glob("*.md"))
    if (code := script(page)) and page.stem not in ELSEWHERE | SITE
}


LONG = {"dynamic_fits", "self_excited"}
SAID = {"dynamic_fits": ("the choice", "a prediction may fail here")}
"""Of what a page prints."""


@pytest.fixture
def logger():
    """The package's logger, whose level a page may change; as it was when the test ends."""
    found = logging.getLogger("pam_ocp")
    level = found.level
    yield found
    found.setLevel(level)


@pytest.mark.usefixtures("logger")
@pytest.mark.parametrize(
    "page", [pytest.param(p, marks=pytest.mark.slow) if p in LONG else p for p in PAGES]
)
def test_every_block_of_a_page_runs(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    exec(compile(PAGES[page], f"docs/{page}.md", "exec"), {"__name__": "__main__"})
    shown = capsys.readouterr().out
    assert all(words in shown for words in SAID.get(page, ()))


@pytest.fixture
def gallery(monkeypatch):
    pytest.importorskip("nbclient")
    monkeypatch.syspath_prepend(str(DOCS))
    import gallery

    return gallery


def test_every_long_page_is_run_for_the_site(gallery):
    assert set(gallery.PAGES) >= SITE


def test_every_command_line_is_run_for_the_site_or_is_a_fragment(gallery):
    for page in DOCS.glob("*.md"):
        kinds = {kind for _, kind, _ in gallery.blocks(page.read_text("utf-8"))}
        assert page.stem in gallery.PAGES or "sh" not in kinds, page.name


@pytest.mark.slow
def test_the_blocks_on_campaigns_and_holds_run_one_after_another(tmp_path, monkeypatch, capsys):
    section = sections((DOCS / "fitting.md").read_text("utf-8"), "##")["Static campaigns and holds"]
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for _, block in BLOCK.findall(section):
        exec(compile(block, "docs/fitting.md", "exec"), names)
    shown = capsys.readouterr().out
    for part in ("[[Diameter 20 mm]]", "hysteresis", "[[Holds]]", "left out"):
        assert part in shown
    assert (tmp_path / "campaign" / "table.csv").exists()


def sections(text, mark):
    """{heading: what stands below it} of the headings that begin with the mark."""
    parts = re.split(rf"(?m)^{mark} (.*)$", text)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


# ---- the README ----------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_ten_lines_of_python_run(tmp_path, monkeypatch, capsys):
    ((_, code),) = BLOCK.findall(README)
    assert len(code.strip().splitlines()) <= 12
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    shown = capsys.readouterr().out
    assert "RMSE 6.196 N" in shown
    assert "all well" in shown


def test_the_readme_is_short_and_cites_this_version():
    assert len(README.split()) <= 500
    assert f"version = {{{pam.__version__}}}" in README


# ---- the tutorial --------------------------------------------------------------------------------
def test_the_tutorial_has_commands_files_and_python():
    text = (DOCS / "tutorial.md").read_text("utf-8")
    assert set(re.findall(r"(?m)^```(\w+)$", text)) >= {"sh", "toml", "python"}


def test_the_workbook_is_the_one_that_its_script_makes(tmp_path, monkeypatch):
    from openpyxl import load_workbook

    monkeypatch.syspath_prepend(str(DOCS))
    import rig

    rig.main(tmp_path / "rig.xlsx")
    made, kept = (
        [list(row) for row in load_workbook(path)["Readings"].values]
        for path in (tmp_path / "rig.xlsx", DOCS / "rig.xlsx")
    )
    assert made == kept


# ---- the newcomer's walks ------------------------------------------------------------------------
HOUSE = (DOCS / "architecture.md").read_text("utf-8")
FILE = re.compile(r"`((?:[A-Za-z0-9_]+/)*[A-Za-z0-9_]+\.(?:py|toml|c|h|md))`")
WALKS = sections(sections(HOUSE, "##")["Five walks through the code"], "###")


def gone(names):
    """Files that do not exist."""
    return {n for n in names if not any((b / n).is_file() for b in (ROOT, ROOT / "pam_ocp"))}


def test_there_are_the_five_walks():
    names = [name.split(",")[0] for name in WALKS]
    assert names == ["Pressure", "A plan", "A new loss", "A fit", "A bug report"]


@pytest.mark.parametrize("walk", WALKS)
def test_the_files_of_a_walk_exist(walk):
    named = FILE.findall(WALKS[walk])
    assert len(set(named)) >= 8
    assert gone(named) == set()


def test_files_that_the_rest_of_the_page_names_exist():
    assert gone(FILE.findall(HOUSE)) <= set().union(*(map(FILE.findall, WALKS.values())))


# ---- what the site is made of --------------------------------------------------------------------
PNG = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAQAAAC1HAwCAAAAC0lEQVR42mNkYAAAAAYAAjCB0C8AAAAASUVORK5CYII="
PAGE = f"""# A page

```python
print("six")
```

<!-- a fragment -->
```python
raise SystemExit
```

```toml
# some.toml
a = 1
```

```sh
cat some.toml
base64 -d > some.png <<< {PNG}
```
"""


def test_under_a_block_stands_what_it_printed_and_drew(gallery, tmp_path, monkeypatch):
    pytest.importorskip("ipykernel")
    (tmp_path / "page.md").write_text(PAGE)
    shutil.copy(DOCS / "rig.xlsx", tmp_path)
    monkeypatch.setattr(gallery, "HERE", tmp_path)
    made = json.loads(gallery.run_page("page", tmp_path).read_text("utf-8"))
    assert [block["text"] for block in made["shown"]] == ["six", "", "# some.toml\na = 1"]
    shown = gallery.with_shown(PAGE, made["shown"])
    six, some = shown.index("\n\nsix\n"), shown.index("\na = 1\n`````")
    assert shown.index('print("six")') < six < shown.index("a fragment") < some
    assert "(outputs/page-3-some.png)" in shown[some:]
    assert (tmp_path / "page-3-some.png").is_file()


def test_what_the_site_shows_is_of_examples_and_blocks_as_they_stand(gallery):
    """What ran is in the repository; after a change ``python docs/gallery.py`` runs it again."""
    for group in gallery.groups().values():
        for name in group:
            kept = json.loads((DOCS / "gallery" / f"{name}.ipynb").read_text("utf-8"))
            now = gallery.notebook(DOCS.parent / "examples" / f"{name}.py")
            assert kept["metadata"]["source"] == now.metadata.source, name
    for name in gallery.PAGES:
        kept = json.loads((DOCS / "outputs" / f"{name}.json").read_text("utf-8"))
        assert kept["source"] == gallery.source_of(gallery.blocks_of(name)), name


def test_pages_with_blocks_are_found():
    assert {"control", "rig"} <= set(PAGES)
    for page in ELSEWHERE | SITE:
        assert script(DOCS / f"{page}.md")


def test_a_page_has_at_most_2500_words():
    pages = set(DOCS.glob("*.md")) - {DOCS / "components.md"}  # the registries'
    long = {p.name: len(p.read_text("utf-8").split()) for p in pages}
    assert {name: count for name, count in long.items() if count > 2500} == {}


def test_the_5_minute_path_is_short(gallery):
    page = (DOCS / "index.md").read_text("utf-8")
    (path,) = re.findall(r"^## The 5-minute path\n(.*?)^```\{toctree\}", page, re.S | re.M)
    assert len(gallery.BLOCK.sub("", path).split()) <= 150


def test_names_that_pages_speak_of_exist():
    pages = {ROOT / "README.md", *DOCS.glob("*.md")} - {DOCS / "migration.md"}  # of former names
    for page in pages:
        for name in re.findall(r"`pam\.([a-z_A-Z.]*[a-zA-Z])", page.read_text("utf-8")):
            place = pam
            for part in name.split("."):
                assert hasattr(place, part), (page.name, name)
                place = getattr(place, part)


SINGLE = """<div class="toctree-wrapper"><span id="document-one"></span><section id="same">
<a href="#same">here</a> <a href="#document-two#same">there</a> <a href="#document-gone">gone</a>
</section><span id="document-two"></span><section id="same"><a href="#document-one">up</a></section>
</div><h3>Table of Contents</h3><p>Guides</p><a href="#document-two">two</a></div>"""


@pytest.fixture
def pdf(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    import pdf

    return pdf


def test_in_the_pdf_every_link_leads_to_its_own_page(pdf):
    made = pdf.with_places(pdf.with_chapters(SINGLE))
    places = re.findall(r'id="([^"]+)"', made)
    assert places == ["document-one", "one--same", "document-two", "two--same"]
    links = re.findall(r'href="#([^"]+)"', made)
    assert links == ["document-two", "one--same", "two--same", "document-one", "document-two"]
    assert made.index("Guides") < made.index("document-one")


def test_without_a_browser_there_is_no_pdf_and_it_is_said(pdf, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pdf.shutil, "which", lambda name: None)
    assert pdf.main(tmp_path / "pages.pdf") == 0
    assert capsys.readouterr().out.startswith("SKIPPED")
    assert not any(tmp_path.iterdir())
