"""README.md and docs/: the list of public names is complete, links lead to files and headings that
exist, the quick start prints what it says, signatures are short."""

import inspect
import pathlib
import re
import runpy

import pytest

import vsr_jax as vsr
from vsr_jax.solution.quantities import QUANTITIES, AlongArm

ROOT = pathlib.Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
PAGES += sorted((ROOT / "docs").rglob("*.md"))
LONGEST_README = 800


def read(page):
    return page.read_text(encoding="utf-8")


def without_code(text):
    return re.sub(r"^```.*?^```$|`[^`\n]*`", "", text, flags=re.MULTILINE | re.DOTALL)


def anchors(page):
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", without_code(read(page)), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", read(page), flags=re.MULTILINE | re.DOTALL)


def test_the_list_of_public_names_is_complete():
    listed = re.findall(r"^\| `(\w+)` \|", read(ROOT / "docs/api.md"), flags=re.MULTILINE)
    assert sorted(listed) == sorted(vsr.__all__)


def test_the_list_of_quantities_is_the_table():
    rows = [
        f"| `eq.{name}{'(X)' if isinstance(entry, AlongArm) else ''}` | {entry.unit} "
        f"| {entry.description} |"
        for name, entry in QUANTITIES.items()
    ]
    text = read(ROOT / "docs/api.md")
    assert [line for line in text.splitlines() if line.startswith("| `eq.")] == rows


def signatures(name):
    """Signatures of a public name, of its methods if it is a class, of its functions if it is a
    module."""
    thing = getattr(vsr, name)
    found = [] if inspect.ismodule(thing) else [thing]
    found += [
        part
        for label, part in inspect.getmembers(
            thing, lambda x: inspect.isfunction(x) or inspect.isclass(x)
        )
        if label[0] != "_" or label == "__call__"
    ]
    return [str(inspect.signature(x)) for x in found if x.__module__.startswith("vsr_jax.")]


@pytest.mark.parametrize("name", sorted({*vsr.__all__} - {"SolveError", "UnitWarning"}))
def test_signatures_name_what_is_like_an_array(name):
    """Exceptions have none."""
    assert not [text for text in signatures(name) if "numpy.number" in text]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\(([^)\s]+)\)", without_code(read(page)))
    for link in links:
        if link.startswith(("http://", "https://")):
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.is_relative_to(ROOT), link
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_names_in_the_text_exist(page):
    """`vsr.solve` and the like, in the text and in code."""
    names = set(re.findall(r"\bvsr\.([a-zA-Z]\w*)", read(page)))
    # the changelog names what is no more
    assert page.name == "CHANGELOG.md" or names <= set(vsr.__all__)


def test_the_readme_is_short():
    assert len(read(ROOT / "README.md").split()) < LONGEST_README


def test_the_quick_start_prints_what_it_says(tmp_path, capsys):
    page = ROOT / "README.md"
    (code,), (output,) = blocks(page, "python"), blocks(page, "text")
    file = tmp_path / "quick_start.py"
    file.write_text(code, encoding="utf-8")
    runpy.run_path(str(file))
    assert capsys.readouterr().out == output
