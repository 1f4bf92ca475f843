"""Shared by all tests: double precision on, shapes checked at run time, tolerances by precision,
and the paper's helix.

Nearly all of the suite's time is XLA's compiler, and each program runs only a few times on little
data: so it runs without its optimisations, without some passes over loops and branches, and without
threads of its own beside the two test processes, which is two to three times faster or more. Set
XLA_FLAGS yourself (to nothing, say) to test what users run. Shapes are checked where functions are
called; SHAPE_CHECKS=off does without, which takes a fifth less time.
"""

import gc
import os
from pathlib import Path

import jax
from xla_flags import FLAGS

os.environ.setdefault("XLA_FLAGS", " ".join(FLAGS))

os.environ.setdefault("VSR_JAX_CACHE", "off")  # commands run here leave nothing behind

import jaxtyping

with jaxtyping.install_import_hook(
    "vsr_jax" if os.environ.get("SHAPE_CHECKS") != "off" else (), "beartype.beartype"
):
    import vsr_jax

    for name in vsr_jax.__all__:  # the face imports its modules when their names are first used
        getattr(vsr_jax, name)

import jax.numpy as jnp
import numpy as np
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_traceback_in_locations_limit", 0)  # nobody reads them, and they take time

# Traced programs are millions of small objects that stay: looking for garbage among them at
# Python's usual pace takes a tenth of the time, and more the longer a process runs.
gc.freeze()
gc.set_threshold(200_000, 50, 1000)

from vsr_jax.numerics import compiling  # noqa: E402
from vsr_jax.studies import paper  # noqa: E402

# On a slow machine programs would say that they compile wherever a test reads what they print.
compiling.SILENT = 1e6


def pytest_configure(config):
    # scenes of tests have any size; here for the import hook above, which pyproject.toml precedes
    config.addinivalue_line("filterwarnings", "ignore::vsr_jax.UnitWarning")


def epsilon(dtype) -> float:
    """Machine epsilon: tolerances are written as multiples of it."""
    return float(jnp.finfo(dtype).eps)


def central_differences(function, size):
    """Derivative at zero of a function of a vector of `size` numbers, by steps of one, of fourth
    order."""

    def change(unit):
        return (
            8 * (function(unit) - function(-unit)) - (function(2 * unit) - function(-2 * unit))
        ) / 12

    return np.stack([change(unit) for unit in np.eye(size)])


def with_derivative(function):
    """A function of an array, and its derivative by forward mode, as one program: it is compiled
    once for both, also where only its values are asked for."""
    return jax.jit(lambda x: jax.jacfwd(lambda x: (function(x),) * 2, has_aux=True)(x)[::-1])


def checked_derivative(function, p, scale, *, rtol=1e-5, atol=1e-10, zero=0.0):
    """A function of an array as a program, with its derivative, and that derivative at `p`, which
    is compared with differences by steps of `scale`, and with reverse mode; `zero` is what is
    rounding in that."""
    solve = with_derivative(function)
    forward, reverse = solve(p)[1], jax.jit(jax.jacrev(function))(p)
    differences = central_differences(lambda unit: solve(p + scale * unit)[0], p.size).T
    np.testing.assert_allclose(forward * scale, differences, rtol=rtol, atol=atol)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8, atol=zero)
    return solve, forward


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    return jnp.dtype(request.param)


@pytest.fixture(scope="session")
def helix():
    """Scene B1 of the paper: one helical thread."""
    return paper.scene("B1")


@pytest.fixture(scope="module", autouse=True)
def earlier_programs_are_dropped():
    """Linux allows a process 65530 memory maps (vm.max_map_count). A compiled program keeps up to
    hundreds of them, and XLA ends with a segmentation fault when there are no more."""
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 20_000:
        jax.clear_caches()
        compiling.drop_programs()
        gc.collect()


@pytest.fixture
def unchecked():
    """What a user meets: without the run-time type checks of the tests, bad arguments reach the
    package's own checks."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
