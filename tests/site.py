"""The site that sphinx-build made: no broken link, no console error in a browser, and pages that
printed and drew what they promise.

python tests/site.py docs/_build/html [FOLDER FOR SCREENSHOTS]

Links within the site must lead to a page and, with #, to a place on it. Links to the world are
looked at as text only: nothing here uses the network. Every page but those of single names (of
which some) is opened in headless Chromium; where there is none, this says so.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

WORLD = re.compile(r"https?://[a-z0-9.-]+\.[a-z]{2,}(/[^\s<>\"]*)?$|mailto:\S+@\S+$", re.I)
CONSOLE = re.compile(r"CONSOLE.*?\] (\".*?\", source: .*?) \(\d+\)$", re.S | re.M)
OUTPUTS = Path(__file__).parents[1] / "docs" / "outputs"
"""What the pages' blocks printed and drew when the site was made."""
PRINTED = {
    "planning": (
        "The most violated constraint is",
        "x of 200 plants unseen",
        "verified: of unseen ones",
    ),
    "tutorial": ("verified", "all well", "a3", "Hz"),
}
DRAWN = {
    "planning": ("plan.png", "robust.png", "front.png", "costates.png", "motion.gif"),
    "tutorial": ("fit.png", "step.png", "plan.png", "bode.png"),
}
LEAST = 5_000
"""Bytes of a picture that shows something."""
SOME = 10
"""Of the pages of single names."""
AT_ONCE = 12
"""Pages that one browser opens side by side, each in a frame."""


class Page(HTMLParser):
    """Where a page links to, and the places that it has."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.places: set[str] = {"", "top"}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value is not None}
        self.places |= {given[n] for n in ("id", "name") if n in given}
        self.links += [given[n] for n in ("href", "src") if n in given]


def broken(site: Path) -> list[str]:
    """Links that lead nowhere."""
    pages = {path: Page(path.read_text("utf-8")) for path in sorted(site.rglob("*.html"))}
    found = []
    for path, page in pages.items():
        for link in set(page.links):
            parts = urlsplit(link)
            if parts.scheme or link.startswith("//"):
                if parts.scheme != "data" and not WORLD.match(link):
                    found.append(f"{path.relative_to(site)}: {link}")
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.exists():
                found.append(f"{path.relative_to(site)}: {link}")
            elif target in pages and unquote(parts.fragment) not in pages[target].places:
                found.append(f"{path.relative_to(site)}: {link} (no such place)")
    return found


def browse(chromium: str, page: Path, *arguments: str) -> list[str]:
    """What the console says when a page is opened."""
    with tempfile.TemporaryDirectory() as profile:
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
        options += ["--disable-background-networking", "--virtual-time-budget=3000"]
        options += [f"--user-data-dir={profile}", *arguments, page.resolve().as_uri()]
        done = subprocess.run(
            [chromium, *options], capture_output=True, text=True, timeout=300, check=False
        )
    said = CONSOLE.findall(done.stderr)
    if done.returncode or ("--dump-dom" in arguments and "</html>" not in done.stdout):
        said.append(f"{page}: not opened, exit code {done.returncode}: {done.stderr[-300:]}")
    return said


def opened(chromium: str, pages: list[Path]) -> list[str]:
    """What the console says of pages, several in one window."""
    said = []
    for begin in range(0, len(pages), AT_ONCE):
        part = pages[begin : begin + AT_ONCE]
        frames = "".join(f'<iframe src="{page.resolve().as_uri()}"></iframe>' for page in part)
        with tempfile.TemporaryDirectory() as folder:
            window = Path(folder) / "window.html"
            window.write_text(f"<!doctype html><html><body>{frames}</body></html>", "utf-8")
            said += browse(chromium, window, "--dump-dom")
    return said


def missing(outputs: Path) -> list[str]:
    """What pages do not print or draw, or say that they must not."""
    found = []
    for page, texts in PRINTED.items():
        blocks = json.loads((outputs / f"{page}.json").read_text("utf-8"))["shown"]
        said = "\n".join(block["text"] for block in blocks)
        found += [f"{page}: nothing printed {text!r}" for text in texts if text not in said]
        found += [f"{page}: a plan is not verified"] * ("not verified" in said.lower())
        sizes = {
            n.split("-", 2)[2]: (outputs / n).stat().st_size for b in blocks for n in b["pictures"]
        }
        for name in DRAWN[page]:
            if sizes.get(name, 0) < LEAST:
                found.append(f"{page}: {name} has {sizes.get(name, 0)} bytes")
    return found


def pictures(chromium: str, site: Path, folder: Path) -> None:
    """Screenshots to be looked at: wide, narrow, dark."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("index", "tutorial", "gallery/index", "gallery/own_load", "model"):
        for kind, more in {
            "wide": ["--window-size=1300,1400"],
            "narrow": ["--window-size=520,1000"],
            "dark": ["--window-size=1300,1000", "--force-dark-mode"],
        }.items():
            target = folder / f"{name.replace('/', '_')}_{kind}.png"
            browse(chromium, site / f"{name}.html", f"--screenshot={target}", *more)


def main(site: Path, folder: Path | None = None) -> int:
    findings = broken(site) + missing(OUTPUTS)
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    single = sorted((site / "api" / "generated").glob("*.html"))
    chosen = [p for p in sorted(site.rglob("*.html")) if p not in single and p.name[0] != "_"]
    chosen += single[:: max(1, len(single) // SOME)]
    if chromium is None:
        print("SKIPPED: no Chromium here, so no page was opened in a browser")
    else:
        findings += opened(chromium, chosen)
        print(f"{len(chosen)} pages opened in {Path(chromium).name}")
        if folder is not None:
            pictures(chromium, site, folder)
    print("\n".join(findings) or "no broken link, no word on the console")
    return 1 if findings else 0


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None))
