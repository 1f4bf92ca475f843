"""What CONTRIBUTING.md, docs/extending.md and CITATION.cff say: the examples run, the layout is
that of the package, the version is the package's."""

import pathlib
import re
import runpy
from unittest import mock

import pytest
from test_layers import PACKAGES

import vsr_jax
from vsr_jax.solution import QUANTITIES

ROOT = pathlib.Path(__file__).parents[1]
MOST_LINES = 30
HEADINGS = [
    "A load",
    "A load that depends on the pose",
    "A support",
    "An obstacle",
    "An actuator",
    "A section law",
    "A routing",
    "A basis",
    "A model",
    "A quantity",
    "An objective and a constraint",
]


def blocks(file, language):
    """Code blocks of a language, each with the heading it stands under."""
    parts = re.split(r"^## (.+)\n", (ROOT / file).read_text(encoding="utf-8"), flags=re.MULTILINE)
    for heading, text in zip(parts[1::2], parts[2::2], strict=True):
        for code in re.findall(
            rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL
        ):
            yield heading, code


EXAMPLES = [*blocks("docs/extending.md", "python"), *blocks("CONTRIBUTING.md", "python")]


def test_there_is_one_example_of_each():
    assert [heading for heading, _ in EXAMPLES] == HEADINGS


@pytest.mark.slow
@pytest.mark.parametrize("code", [pytest.param(code, id=heading) for heading, code in EXAMPLES])
def test_an_example_is_short_and_true(code, tmp_path):
    lines = code.splitlines()
    assert len([line for line in lines if line]) < MOST_LINES  # of code
    assert max(map(len, lines)) <= 100
    assert lines[-1].startswith("assert ")
    file = tmp_path / "example.py"
    file.write_text(code, encoding="utf-8")
    with mock.patch.dict(QUANTITIES):  # an example may add to the table
        runpy.run_path(str(file))


@pytest.mark.parametrize("code", [pytest.param(code, id=heading) for heading, code in EXAMPLES])
def test_an_example_uses_public_names_only(code):
    lines = code.splitlines()
    imported = " ".join(line for line in lines if line.startswith(("from ", "import ")))
    assert not re.search(r"[\s.]_[a-z]", imported)
    assert not re.search(r"\._[a-z]", code)


def test_the_layout_lists_the_packages_in_their_order():
    layout = dict(blocks("CONTRIBUTING.md", "text"))["Layout"]
    assert tuple(re.findall(r"^  (\w+)/ ", layout, flags=re.MULTILINE)) == PACKAGES
    assert re.findall(r"^  (\w+)  ", layout, flags=re.MULTILINE) == ["typing", "validation"]


def test_the_citation_has_the_version_of_the_package():
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {vsr_jax.__version__}\n" in text
