"""Notebooks: that they are stored without outputs, begin with a title, hold Python that compiles,
and use only names that the package has. Running them takes minutes: `benchmarks/run_notebooks.py`
does."""

import ast
import json
from functools import reduce
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def read(path):
    return json.loads(path.read_text(encoding="utf-8"))


def text_of(cell):
    return "".join(cell["source"])


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_are_stripped(path):
    notebook = read(path)
    assert notebook["nbformat"] == 4
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert code
    for cell in code:
        assert cell["outputs"] == []
        assert cell["execution_count"] is None


def code_of(path):
    """Syntax tree of each code cell, without the commands of the notebook."""
    trees = []
    for cell in read(path)["cells"]:
        if cell["cell_type"] == "code":
            lines = text_of(cell).splitlines()
            code = "\n".join(line for line in lines if not line.lstrip().startswith(("%", "!")))
            trees.append(ast.parse(code))
    return trees


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_code_compiles(path):
    assert code_of(path)


def dotted(node):
    """The names of `a.b.c`, or None for other expressions."""
    names = []
    while isinstance(node, ast.Attribute):
        names.append(node.attr)
        node = node.value
    return (node.id, *reversed(names)) if isinstance(node, ast.Name) else None


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_name_of_the_package_exists(path):
    nodes, imported = [node for tree in code_of(path) for node in ast.walk(tree)], {}
    for node in nodes:
        if isinstance(node, ast.Import | ast.ImportFrom) and "vsr_jax" in ast.unparse(node):
            exec(compile(ast.Module([node], []), path.name, "exec"), imported)
    assert imported
    for node in nodes:
        names = dotted(node) if isinstance(node, ast.Attribute) else None
        if names and names[0] in imported:
            reduce(getattr, names[1:], imported[names[0]])


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_begins_with_a_title(path):
    first = read(path)["cells"][0]
    assert first["cell_type"] == "markdown"
    assert text_of(first).startswith("# ")
