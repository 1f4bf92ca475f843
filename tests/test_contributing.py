"""What CONTRIBUTING.md and CITATION.cff say: the examples run, the drawing of the layout is true,
the version is the package's."""

import pathlib
import re
import runpy

import pytest
from test_layers import FOLDER, LAYERS, imports

import vsr_jax

ROOT = pathlib.Path(__file__).parents[1]
MOST_LINES = 30
MARGIN = 24
HEADINGS = ["A load", "A routing", "A basis", "A model", "An objective and a constraint"]


def blocks(language):
    """Code blocks of a language, each with the heading it stands under."""
    parts = re.split(
        r"^## (.+)\n", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    for heading, text in zip(parts[1::2], parts[2::2], strict=True):
        yield from (
            (heading, code)
            for code in re.findall(
                rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL
            )
        )


EXAMPLES = list(blocks("python"))


def test_there_is_one_example_of_each():
    assert [heading for heading, _ in EXAMPLES] == HEADINGS


@pytest.mark.parametrize("code", [pytest.param(code, id=heading) for heading, code in EXAMPLES])
def test_an_example_is_short_and_true(code, tmp_path):
    lines = code.splitlines()
    assert len(lines) < MOST_LINES
    assert lines[-1].startswith("assert ")
    file = tmp_path / "example.py"
    file.write_text(code, encoding="utf-8")
    runpy.run_path(str(file))


def boxes():
    """Modules of each box of the drawing, from the top; remarks in parentheses and what flows
    between boxes left out."""
    found = []
    for line in dict(blocks("text"))["Layout"].splitlines():
        if "|" not in line:
            found += [[]] if line[:MARGIN].strip() else []
            found[-1] += re.sub(r"\(.*?\)", "", line[MARGIN:]).split()
    return found


def test_the_drawing_holds_modules_that_exist_once_each():
    drawn = [module for box in boxes() for module in box]
    assert len(boxes()) == 8
    assert len(drawn) == len(set(drawn))
    assert set(drawn) <= set(LAYERS)


def test_no_box_of_the_drawing_imports_from_one_below():
    places = {module: i for i, box in enumerate(boxes()) for module in box}
    upward = {
        (module, other)
        for module in places
        for other in imports(FOLDER / f"{module}.py")
        if places.get(other, 0) > places[module]
    }
    assert upward == {
        ("scene", "scenefile")
    }  # looked up when it is called: a scene knows how to save itself


def test_the_citation_has_the_version_of_the_package():
    assert f"\nversion: {vsr_jax.__version__}\n" in (ROOT / "CITATION.cff").read_text(
        encoding="utf-8"
    )
