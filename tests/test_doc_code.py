"""The code of the pages in docs/: Python blocks run and print what the pages say, files load, and
commands are known. The blocks of extending.md are in `test_contributing`, that of fabrication.md in
`test_export`."""

import contextlib
import io
import pathlib
import re
import shlex
import shutil

import matplotlib
import matplotlib.pyplot as plt
import pytest

from vsr_jax.calibration.fit_file import load_fit
from vsr_jax.cli import main as cli
from vsr_jax.optimization.design_file import load_design

ROOT = pathlib.Path(__file__).parents[1]
DOCS = ROOT / "docs"
ELSEWHERE = {
    DOCS / "extending.md",
    DOCS / "fabrication.md",
    DOCS / "files.md",
    DOCS / "live_view.md",
}
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


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_the_code_of_a_page_runs(page, request, tmp_path, monkeypatch):
    matplotlib.use("Agg")
    continued = page.parent.name == "api"
    names = dict(request.getfixturevalue("quick_start")) if continued else {}
    monkeypatch.chdir(tmp_path)
    run(page, names)
    plt.close("all")


def test_the_files_of_the_page_of_formats_load(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = DOCS / "files.md"
    pattern = r"^```toml\n(.*?)^```$"
    files = re.findall(pattern, page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    for name, text in zip(("scene.toml", "problem.toml", "fit.toml"), files, strict=True):
        pathlib.Path(name).write_text(text, encoding="utf-8")
    run(page, {})
    assert pathlib.Path("copy.toml").exists()
    shutil.copyfile(ROOT / "notebooks/scenes/helix.toml", "helix.toml")
    assert load_design("problem.toml").title == "A helix that reaches out"
    shutil.copyfile("scene.toml", "arm.toml")
    columns = ["tension_1", "tension_2", "series"] + [f"p{i}_{x}" for i in (1, 2) for x in "xyz"]
    numbers = [1, 2, "A", 100, 0, 0, 200, 0, ""]
    rows = [columns, numbers]
    pathlib.Path("holds.csv").write_text("\n".join(",".join(map(str, row)) for row in rows))
    assert load_fit("fit.toml").title == "A hanging arm"


def commands():
    """Commands in the blocks of the pages."""
    for page in (ROOT / "README.md", *sorted(DOCS.rglob("*.md"))):
        yield from re.findall(r"^vsr-jax .*$", page.read_text("utf-8"), flags=re.MULTILINE)


def test_the_commands_of_the_pages_are_known():
    found = set(commands())
    assert len(found) > 10
    for command in found:
        _, *arguments = shlex.split(command)
        assert callable(cli._parser(arguments[:1]).parse_args(arguments).run), command
