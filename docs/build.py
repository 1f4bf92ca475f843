"""Builds the site of the documentation into build/site; a warning is an error.

    pip install -e ".[site]" && python docs/build.py [--execute] [--out build]

Collects README.md, the pages of docs/, the notebooks and all files that they link to below
build/pages; a link to a file that does not exist ends the build. Then zensical builds the site,
with the docstrings by mkdocstrings. Formulas become MathML, which browsers draw without a script.
Notebooks are stored without outputs; `--execute` runs them first, which takes minutes and needs the
extra `notebooks`.
"""

import argparse
import html
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from latex2mathml.converter import convert
from nbconvert import MarkdownExporter
from nbconvert.preprocessors import ExecutePreprocessor
from traitlets.config import Config

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
LINK = re.compile(r"(\]\()([^)\s#]+)((?:#[^)\s]*)?\))")
CODE = re.compile(r"(^```.*?^```$|`[^`\n]*`)", re.MULTILINE | re.DOTALL)
FORMULA = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)
ROW = re.compile(r"^\| `(\w+)` \|", re.MULTILINE)


def place(path: Path) -> Path:
    """Place of a file on the site: docs/ is the root, README.md the start, notebooks are pages."""
    if path == ROOT / "README.md":
        return Path("index.md")
    path = path.relative_to(DOCS if path.is_relative_to(DOCS) else ROOT)
    return path.with_suffix(".md") if path.suffix == ".ipynb" else path


class Pages:
    """The sources of the site in one folder: pages, and all files that they link to."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.added: set[Path] = set()
        shutil.rmtree(folder, ignore_errors=True)

    def add(self, file: Path) -> None:
        """Adds a file once. The links of a page become those of the site."""
        if file in self.added or file.suffix == ".ipynb":
            return
        self.added.add(file)
        if file.suffix != ".md":
            self.write(place(file), file.read_bytes())
            return
        text = self.with_links(file, file.read_text(encoding="utf-8"))
        text = with_entries(text) if file == DOCS / "api.md" else text
        self.write(place(file), text.encode())

    def with_links(self, page: Path, text: str) -> str:
        """The text of a page with its links, but for those in code, as they are on the site."""
        parts = CODE.split(text)
        parts[::2] = [LINK.sub(lambda link: self.linked(page, link), part) for part in parts[::2]]
        return "".join(parts)

    def linked(self, page: Path, link: re.Match) -> str:
        """A link of a page, as it is on the site; adds what it leads to. A figure `NAME_light.png`
        stands beside `NAME_dark.png`, and the theme shows one of them."""
        before, target, after = link.groups()
        if target.startswith(("http://", "https://", "data:")):
            return link.group()
        file = (page.parent / target).resolve()
        if not file.is_file():
            sys.exit(f"{page.relative_to(ROOT)}: got a link to {target}, need a file")
        self.add(file)
        new = os.path.relpath(place(file), place(page).parent)
        if not new.endswith("_light.png"):
            return before + new + after
        self.add(file.with_name(file.name.replace("_light", "_dark")))
        return f"{before}{new}#only-light)![]({new.replace('_light', '_dark')}#only-dark)"

    def add_notebook(self, path: Path, execute: bool) -> None:
        """Adds a notebook as a page that contains its figures, data in the place of a link."""
        config = Config()
        config.ExtractOutputPreprocessor.enabled = False
        if execute:
            config.MarkdownExporter.preprocessors = [ExecutePreprocessor(timeout=600)]
        resources = {"metadata": {"path": str(path.parent)}}
        text, _ = MarkdownExporter(config=config).from_filename(str(path), resources)
        self.write(place(path), self.with_links(path, text).encode())

    def write(self, path: Path, data: bytes) -> None:
        (self.folder / path).parent.mkdir(parents=True, exist_ok=True)
        (self.folder / path).write_bytes(data)


def with_entries(overview: str) -> str:
    """The list of public names, each linked to its entry in the pages of api/."""
    entries = {
        name: page.name
        for page in (DOCS / "api").glob("*.md")
        for name in re.findall(r"^::: vsr_jax\.(\w+)$", page.read_text(), flags=re.MULTILINE)
    }
    return ROW.sub(lambda m: f"| [`{m[1]}`](api/{entries[m[1]]}#vsr_jax.{m[1]}) |", overview)


def collect(folder: Path, execute: bool) -> None:
    """Writes the sources of the site."""
    pages = Pages(folder)
    for page in (ROOT / "README.md", DOCS / "style.css", *sorted(DOCS.rglob("*.md"))):
        pages.add(page)
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        pages.add_notebook(notebook, execute)


def draw_formulas(site: Path) -> None:
    """Replaces the TeX of formulas by MathML."""

    def mathml(found: re.Match) -> str:
        tex = html.unescape(found[2]).strip().removeprefix("\\(").removeprefix("\\[")
        tex = tex.removesuffix("\\)").removesuffix("\\]")
        tex = tex.replace("'", r"\prime ")  # not raised twice
        return convert(tex, display="inline" if found[1] == "span" else "block")

    for page in site.rglob("*.html"):
        page.write_text(FORMULA.sub(mathml, page.read_text("utf-8")), encoding="utf-8")


def main() -> None:
    """Builds the site."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--execute", action="store_true", help="run the notebooks first")
    parser.add_argument("--out", metavar="FOLDER", type=Path, default=ROOT / "build")
    options = parser.parse_args()
    config = options.out / "zensical.toml"
    shutil.rmtree(options.out / "site", ignore_errors=True)
    collect(options.out / "pages", options.execute)
    text = (DOCS / "zensical.toml").read_text(encoding="utf-8")
    config.write_text(text.replace("@ROOT@", ROOT.as_posix()), encoding="utf-8")
    command = ["zensical", "build", "--strict", "--clean", "--config-file", str(config)]
    if (code := subprocess.run(command, check=False).returncode) != 0:
        sys.exit(code)
    draw_formulas(options.out / "site")


if __name__ == "__main__":
    main()
