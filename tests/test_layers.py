"""The layout of the package: which package may import which, and what its face shows."""

import ast
import functools
import pathlib
import subprocess
import sys

import pytest

import vsr_jax as vsr

FOLDER = pathlib.Path(vsr.__file__).parent
PACKAGES = (
    "numerics",
    "chain",
    "arm",
    "mechanics",
    "elements",
    "models",
    "solution",
    "assembly",
    "files",
    "fabrication",
    "analysis",
    "optimization",
    "calibration",
    "viz",
    "viewer",
    "studies",
    "cli",
)
"""A module imports from its own package and from those before it; `typing` and `validation` serve
all."""
MODULES = sorted(path.relative_to(FOLDER).as_posix() for path in FOLDER.glob("*/**/*.py"))
FOLDERS = sorted({pathlib.PurePath(name).parent.as_posix() for name in MODULES})
"""The packages, and those in them."""


@functools.cache
def imports(path):
    """Places that a file imports from vsr_jax: ("arm", "scene", "Scene")."""
    return tuple(_imports(path))


def _imports(path):
    own = path.relative_to(FOLDER).parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.ImportFrom):
            continue
        parts = (node.module or "").split(".") if node.module else []
        if node.level == 0:
            if not parts or parts.pop(0) != "vsr_jax":
                continue
        else:
            parts = [*own[: len(own) + 1 - node.level], *parts]
        yield from ((*parts, alias.name) for alias in node.names)


def test_every_package_is_in_the_list():
    assert {path.parent.name for path in FOLDER.glob("*/*.py")} == set(PACKAGES)
    assert {path.stem for path in FOLDER.glob("*.py")} == {"__init__", "typing", "validation"}


@pytest.mark.parametrize("name", MODULES)
def test_imports_go_one_way(name):
    allowed = PACKAGES[: PACKAGES.index(name.split("/")[0]) + 1]
    for place in imports(FOLDER / name):
        assert place[0] in (*allowed, "typing", "validation", "__version__"), place


@pytest.mark.parametrize("package", FOLDERS)
def test_a_package_has_no_cycle(package):
    """Its modules, and packages in it, can be put in an order in which each imports only earlier
    ones."""
    folder, place = FOLDER / package, tuple(package.split("/"))
    files = {path.stem: [path] for path in folder.glob("*.py") if path.stem != "__init__"}
    files |= {path.parent.name: sorted(path.parent.glob("*.py")) for path in folder.glob("*/*.py")}

    def needed(name):
        own = [p[len(place) :] for f in files[name] for p in imports(f) if p[: len(place)] == place]
        return {part for rest in own for part in rest[:1] if part in files} - {name}

    needs = {name: needed(name) for name in files}
    while ready := {name for name, others in needs.items() if not others}:
        needs = {name: others - ready for name, others in needs.items() if name not in ready}
    assert needs == {}


@pytest.mark.parametrize("name", MODULES)
def test_nothing_private_is_imported(name):
    private = [
        place
        for place in imports(FOLDER / name)
        if any(part.startswith("_") and part != "__version__" for part in place)
    ]
    assert private == []


@pytest.mark.parametrize("name", MODULES)
def test_loops_are_those_of_numerics(name):
    """Those of `jax.lax` keep the carry's type, which `jax.shard_map` with its check refuses."""
    if name == "numerics/loops.py":
        return
    tree, loops = ast.parse((FOLDER / name).read_text()), {"while_loop", "fori_loop", "scan"}
    attributes = [n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)]
    imported = [
        alias.name
        for n in ast.walk(tree)
        if isinstance(n, ast.ImportFrom) and (n.module or "").startswith("jax")
        for alias in n.names
    ]
    assert loops.isdisjoint([*attributes, *imported])


def test_no_module_is_called_like_a_public_function():
    """`import vsr_jax.arm.load`, say, must not be mistaken for `vsr.load`."""
    modules = {path.stem for path in FOLDER.rglob("*.py")} | set(PACKAGES)
    functions = {name for name in vsr.__all__ if type(getattr(vsr, name)).__name__ == "function"}
    assert modules & functions == set()


def test_the_face_lists_what_it_has():
    assert [name for name in vsr.__all__ if not hasattr(vsr, name)] == []
    assert dir(vsr) == sorted([*vsr.__all__, "__version__"])


def test_the_face_imports_no_optimiser_ode_solver_or_picture():
    heavy = (
        "matplotlib",
        "diffrax",
        "optax",
        "optimistix",
        "zarr",
        "xarray",
        "trimesh",
        "ezdxf",
        "viser",
    )
    code = f"import sys, vsr_jax; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
