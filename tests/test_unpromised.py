"""What the package uses of JAX beyond what its makers promise to keep, named one by one: a test
fails for each that a new version lacks, and for each new use that is not named here."""

import ast
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from xla_flags import FLAGS

PACKAGE = Path(__file__).parent.parent / "vsr_jax"

USED = {
    # operations of our own, which XLA computes once or as small products
    "jax.extend.core": {
        "Primitive": "numerics/once.py numerics/small_product.py",
        "Literal": "numerics/fingerprint.py",
    },
    "jax.interpreters": {
        "ad": "numerics/once.py numerics/small_product.py",
        "batching": "numerics/once.py numerics/small_product.py",
        "mlir": "numerics/once.py numerics/small_product.py",
    },
    "jax.core": {
        "ShapedArray": "numerics/small_product.py",
        "Tracer": "numerics/compiling.py validation.py",
    },
    "jax.custom_batching": {"custom_vmap": "numerics/batching.py"},
    "jax.custom_derivatives": {"SymbolicZero": "numerics/implicit.py"},
    # compiled programs on disk
    "jax.experimental": {
        "serialize_executable": "numerics/program_store.py",
        "multihost_utils": "analysis/sweep_store.py",
    },
}

PROMISED = {"jax", "jax.numpy", "jax.lax", "jax.typing", "jax.stages", "jax.sharding"}
PROMISED |= {"jax.flatten_util", "jax.scipy.sparse.linalg"}


def imports():
    """Module, name and file of all that the package imports from JAX."""
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "jax":
                for alias in node.names:
                    yield node.module, alias.name, str(path.relative_to(PACKAGE).as_posix())
            elif isinstance(node, ast.Import):
                for alias in node.names:
                    if alias.name.startswith("jax.") and alias.name not in PROMISED:
                        yield alias.name, "", str(path.relative_to(PACKAGE).as_posix())


def test_every_use_is_named():
    found: dict = {}
    for module, name, file in imports():
        if module not in PROMISED:
            found.setdefault(module, {}).setdefault(name, set()).add(file)
    named = {m: {n: set(files.split()) for n, files in names.items()} for m, names in USED.items()}
    assert found == named


@pytest.mark.parametrize(("module", "name"), [(m, n) for m in USED for n in USED[m]])
def test_jax_has_it(module, name):
    assert hasattr(import_module(module), name) or import_module(f"{module}.{name}")


def test_the_type_of_an_array_names_the_mesh_axes_over_which_it_varies():
    """The words by which `numerics.loops` casts arrays inside `jax.shard_map`."""
    of = jax.typeof(jnp.ones(2))
    assert (of.vma if hasattr(of, "vma") else of.mat.varying) == frozenset()
    assert not jax.sharding.get_abstract_mesh().manual_axes
    assert hasattr(jax.lax, "pcast") or hasattr(jax.lax, "pvary")


def test_settings_that_programs_depend_on_exist():
    from vsr_jax.numerics.compiling import _SETTINGS

    for name in _SETTINGS:
        getattr(jax.config, name)


def test_xla_knows_the_options_of_quick_compilation():
    options = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
    program = jax.jit(lambda x: 2 * x).lower(jnp.ones(2))
    np.testing.assert_array_equal(program.compile(compiler_options=options)(jnp.ones(2)), [2, 2])


def test_xla_knows_the_flags_of_the_tests():
    """Otherwise it ends every process of the tests, without a word of which flag."""
    environment = os.environ | {"XLA_FLAGS": " ".join(FLAGS)}
    command = [sys.executable, "-c", "import jax; print(jax.numpy.ones(2).sum())"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_traced_program_has_equations_constants_and_literals():
    """The words by which `numerics.fingerprint` walks through a program."""
    table = jnp.arange(3.0)
    program = jax.make_jaxpr(lambda x: jax.jit(lambda x: x * table.sum() + 0.5)(x))(1.0)
    assert program.eqns
    inner = program.eqns[0].params["jaxpr"]
    assert [np.asarray(x).tolist() for x in inner.consts] == [[0.0, 1.0, 2.0]]
    assert 0.5 in [getattr(x, "val", None) for equation in inner.eqns for x in equation.invars]
