"""The check of the site (tests/site.py) sees what is broken."""

import json
import shutil
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def check(monkeypatch):
    # not `import site`: the standard library has one
    from importlib.util import module_from_spec, spec_from_file_location

    spec = spec_from_file_location("site_check", ROOT / "tests" / "site.py")
    module = module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "site_check", module)
    spec.loader.exec_module(module)
    return module


def test_links_that_lead_nowhere_are_found(check, tmp_path):
    (tmp_path / "other.html").write_text('<p id="here">')
    links = (
        "other.html",
        "other.html#here",
        "other.html#gone",
        "missing.png",
        "https://a.org/b",
        "http:/x",
    )
    (tmp_path / "index.html").write_text("".join(f'<a href="{link}">' for link in links))
    found = "\n".join(check.broken(tmp_path))
    assert len(check.broken(tmp_path)) == 3
    for link in ("other.html#gone", "missing.png", "http:/x"):
        assert link in found


def test_what_a_page_does_not_print_or_draw_is_found(check, tmp_path):
    for page, texts in check.PRINTED.items():
        names = [f"{page}-1-{name}" for name in check.DRAWN[page]]
        for name in names:
            (tmp_path / name).write_bytes(bytes(check.LEAST))
        shown = [{"text": "\n".join(texts), "pictures": names}]
        (tmp_path / f"{page}.json").write_text(json.dumps({"shown": shown}))
    assert check.missing(tmp_path) == []
    (tmp_path / "planning-1-front.png").write_bytes(b"")
    (tmp_path / "tutorial.json").write_text(
        json.dumps({"shown": [{"text": "NOT VERIFIED: a3 all well", "pictures": []}]})
    )
    found = "\n".join(check.missing(tmp_path))
    for words in (
        "front.png has 0",
        "'verified'",
        "'Hz'",
        "tutorial: a plan is not",
        "fit.png has 0",
    ):
        assert words in found


@pytest.mark.slow
def test_what_a_page_says_on_the_console_is_found(check, tmp_path):
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium here")
    good, bad = tmp_path / "good.html", tmp_path / "bad.html"
    good.write_text("<!doctype html><html><body>fine</body></html>")
    bad.write_text("<!doctype html><html><body><script>nosuch();</script></body></html>")
    (said,) = check.opened(chromium, [good, bad])
    assert "nosuch is not defined" in said
    assert "bad.html" in said
