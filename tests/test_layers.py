"""The layers of the package: a module imports only from those above it in this list."""

import ast
import pathlib

import pytest

import vsr_jax

FOLDER = pathlib.Path(vsr_jax.__file__).parent
LAYERS = """
_types _check bounded box fingerprint component implicit se3 quadrature profile section material routing actuator rod load scene
parameters newton lu batching balance kinematics resolution cable reaction elimination friction coupled coupled_tangent coupled_solve
basis model galerkin discrete strain_dependent estimate shooting continuum lanczos stability equilibrium plausible plan solve inverse
sensitivity objective constraint descent problem checkpoint optimize health continuation parallel labels archive sweep scenefile
designfile plot film annotate plot_design paper paper_figures reproduce report timing effects accuracy accuracy_figures cli_common
cli_scene cli_sweep cli_inverse cli_design cli_studies cli
""".split()  # noqa: SIM905


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.level == 1 or (node.module or "").startswith("vsr_jax")):
            module = (node.module or "").removeprefix("vsr_jax").lstrip(".").split(".")[0]
            yield from [module] if module else [alias.name for alias in node.names if (FOLDER / f"{alias.name}.py").exists()]


def test_every_module_has_its_layer():
    modules = {path.stem for path in FOLDER.glob("*.py")} - {"__init__"}
    assert modules == set(LAYERS)


@pytest.mark.parametrize("name", LAYERS)
def test_imports_go_upward(name):
    above = LAYERS[: LAYERS.index(name)]
    # `Scene.to_toml` looks its writer up when it is called: a scene knows how to save itself.
    later = ["scenefile"] if name == "scene" else []
    assert [module for module in imports(FOLDER / f"{name}.py") if module not in above + later] == []


def test_the_public_face_draws_nothing():
    import subprocess
    import sys

    code = "import sys, vsr_jax; print([m for m in ('matplotlib', 'diffrax', 'optax', 'optimistix') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
