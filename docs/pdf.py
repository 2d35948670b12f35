"""All pages of the documentation as one PDF: Sphinx's single page, printed by headless Chromium.

python docs/pdf.py [docs/_build/pam_ocp.pdf]

Where there is no Chromium, this says so.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
BUILD = HERE / "_build"


def with_places(text: str) -> str:
    """Every page's places and the links to them under the page's name: several have the same."""
    before, *parts = re.split(r'<span id="document-([^"]+)"></span>', text)
    found = [before]
    names = set(parts[::2])
    for name, part in zip(parts[::2], parts[1::2], strict=True):
        part = re.sub(r'\bid="([^"]+)"', rf'id="{name}--\1"', part)
        part = re.sub(r'href="#(?!document-)([^"]+)"', rf'href="#{name}--\1"', part)
        found.append(f'<span id="document-{name}"></span>{part}')
    text = re.sub(r'href="#document-([^"#]+)#([^"]+)"', r'href="#\1--\2"', "".join(found))
    return re.sub(r'href="#document-([^"]+)"', lambda m: m[0] if m[1] in names else "", text)


def with_chapters(text: str) -> str:
    """The list of pages, which stands in a bar at the side, behind the first page."""
    chapters = text[text.index("Table of Contents") :]
    chapters = chapters[chapters.index("<p") : chapters.index("</div>")]
    first = text.index('<div class="toctree-wrapper')
    return f'{text[:first]}<div class="chapters">{chapters}</div>{text[first:]}'


def single_page(folder: Path) -> Path:
    """The site on one page, for print: another theme, another style, answers open."""
    command = [sys.executable, "-m", "sphinx", "-q", "-b", "singlehtml", "-t", "print"]
    command += ["-d", str(BUILD / "print")]  # read anew: single names stand behind their room here
    command += ["-D", "html_theme=basic", "-D", "html_css_files=site.css,print.css"]
    subprocess.run([*command, str(HERE), str(folder)], check=True)
    page = folder / "index.html"
    text = with_places(with_chapters(page.read_text("utf-8")))
    page.write_text(re.sub(r"<details\b", "<details open", text), "utf-8")
    return page


def print_page(chromium: str, page: Path, target: Path) -> None:
    """One page as a PDF with an outline; Chromium numbers the sheets by the style."""
    with tempfile.TemporaryDirectory() as profile:
        subprocess.run(
            [
                chromium,
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-background-networking",
                f"--user-data-dir={profile}",
                "--no-pdf-header-footer",
                "--generate-pdf-document-outline",
                f"--print-to-pdf={target}",
                page.resolve().as_uri(),
            ],
            check=True,
            capture_output=True,
            timeout=900,
        )


def main(target: Path) -> int:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        print("SKIPPED: no Chromium here, so no PDF of the pages was made")
        return 0
    print_page(chromium, single_page(BUILD / "single"), target)
    print(f"{target}: {target.stat().st_size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else BUILD / "pam_ocp.pdf"))
