"""The code blocks of the pages in docs/ run, and print what the pages say. Those of extending.md
are in `test_contributing`, that of fabrication.md in `test_export`."""

import contextlib
import io
import pathlib
import re

import matplotlib
import matplotlib.pyplot as plt
import pytest

ROOT = pathlib.Path(__file__).parents[1]
DOCS = ROOT / "docs"
ELSEWHERE = {DOCS / "extending.md", DOCS / "fabrication.md"}
SLOW: set[pathlib.Path] = set()
BLOCK = re.compile(
    r"^```python\n(?P<code>.*?)^```$(?:\n\n^```text\n(?P<output>.*?)^```$)?",
    flags=re.MULTILINE | re.DOTALL,
)


def blocks(page):
    return [(m["code"], m["output"]) for m in BLOCK.finditer(page.read_text(encoding="utf-8"))]


PAGES = [page for page in sorted(DOCS.rglob("*.md")) if blocks(page) and page not in ELSEWHERE]


def run(page, names):
    """Runs the blocks of a page one after another; what a block prints is the text block after
    it."""
    for i, (code, output) in enumerate(blocks(page)):
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            exec(compile(code, f"{page.name}, block {i}", "exec"), names)
        assert printed.getvalue() == (output or ""), page.name


@pytest.fixture(scope="module")
def quick_start():
    """The names that the README defines before its gradient: the pages of api/ continue it."""
    names: dict = {}
    with contextlib.redirect_stdout(io.StringIO()):
        exec(blocks(ROOT / "README.md")[0][0].split("slope =")[0], names)
    return names


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.stem, marks=[pytest.mark.slow] if page in SLOW else [])
        for page in PAGES
    ],
)
def test_the_code_of_a_page_runs(page, request, tmp_path, monkeypatch):
    matplotlib.use("Agg")
    continued = page.parent.name == "api"
    names = dict(request.getfixturevalue("quick_start")) if continued else {}
    monkeypatch.chdir(tmp_path)
    run(page, names)
    plt.close("all")
