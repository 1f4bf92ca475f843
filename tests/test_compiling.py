"""Compiled programs kept between runs of the command."""

import argparse
import gc
import os
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.analysis import progress
from vsr_jax.cli import compiling
from vsr_jax.numerics.compiling import quick_jit
from vsr_jax.studies import paper

MAIN = "import sys; from vsr_jax.cli.main import main; sys.exit(main())"


def run(folder, scene, *arguments):
    """A solve in a process of its own, as a user runs it."""
    environment = os.environ | {"VSR_JAX_CACHE": str(folder)}
    command = [sys.executable, "-c", MAIN, "solve", str(scene), *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return done.stdout


def programs(folder):
    return sorted(path.name for path in folder.iterdir() if path.name.endswith("-cache"))


@pytest.mark.slow
def test_a_second_run_adds_no_program_and_says_the_same(tmp_path):
    folder, scene = tmp_path / "cache", tmp_path / "arm.toml"
    vsr.save(paper.scene("A1"), scene, [-1.0])
    first = run(folder, scene)
    kept = programs(folder)
    assert kept
    assert run(folder, scene) == first
    assert programs(folder) == kept
    run(folder, scene, "--no-cache", "--steps", "7")
    assert programs(folder) == kept


def test_the_folder_is_that_of_the_variable_or_the_users(monkeypatch, tmp_path):
    monkeypatch.setenv("VSR_JAX_CACHE", str(tmp_path))
    assert compiling.cache_folder() == tmp_path
    monkeypatch.setenv("VSR_JAX_CACHE", "off")
    assert compiling.cache_folder() is None
    monkeypatch.delenv("VSR_JAX_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "users"))
    monkeypatch.setattr(sys, "platform", "linux")
    assert compiling.cache_folder() == tmp_path / "users" / "vsr_jax"


@pytest.mark.parametrize("enabled", [True, False])
def test_nothing_looks_for_garbage_while_a_program_is_traced(enabled):
    """Afterwards as before, also where tracing fails."""
    seen = []

    @quick_jit
    def traced(x):
        seen.append(gc.isenabled())
        return x.reshape(1)

    (gc.enable if enabled else gc.disable)()
    try:
        traced(jnp.ones(1))
        assert gc.isenabled() == enabled
        with pytest.raises(TypeError):
            traced(jnp.ones(2))
        assert gc.isenabled() == enabled
    finally:
        gc.enable()
    assert seen == [False, False]


@pytest.mark.parametrize(("most", "left"), [(25, ["b", "c"]), (100, ["a", "b", "c"]), (0, [])])
def test_the_programs_used_longest_ago_are_removed_first(tmp_path, most, left):
    for age, name in enumerate("cba"):
        (tmp_path / name).write_bytes(bytes(10))
        os.utime(tmp_path / name, (1000 - age, 1000 - age))
    compiling.remove_oldest(tmp_path, most)
    assert sorted(path.name for path in tmp_path.iterdir()) == left


def test_a_command_that_was_silent_for_long_says_that_it_compiles(monkeypatch, capsys):
    with compiling.compiling(argparse.Namespace(no_cache=True)):
        time.sleep(0.05)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(progress, "SILENT", 0.0)
    with compiling.compiling(argparse.Namespace(no_cache=True)):
        time.sleep(0.5)
    assert capsys.readouterr().err == "vsr-jax: compiling\n"


def test_a_command_with_a_progress_bar_says_nothing_beside_it(monkeypatch, capsys):
    monkeypatch.setattr(progress, "SILENT", 0.0)
    with compiling.compiling(argparse.Namespace(no_cache=True, progress_bar=True)):
        time.sleep(0.3)
    assert capsys.readouterr().err == ""


def reached(scene, target, **options):
    return vsr.reach(scene, target, (0.0, 12.0), model=vsr.StrainDependent(4), **options)


@pytest.mark.slow
def test_reach_says_that_it_compiles_but_not_the_second_time(monkeypatch, capsys):
    monkeypatch.setattr(progress, "SILENT", 0.0)
    arm = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(8e5, poisson=0.45))
    scene = vsr.Scene(arm, [vsr.Tendon(vsr.Parallel(0.005, 0.0))])
    target = vsr.solve(scene, [3.0]).tip[:3, 3]
    reached(scene, target)
    assert capsys.readouterr().err == "vsr_jax.reach: compiling\n"
    found = reached(scene, target)
    assert capsys.readouterr().err == ""
    np.testing.assert_allclose(found.tip[:3, 3], target, atol=1e-4)
    np.testing.assert_array_equal(found.tip, found.equilibrium.tip)
    jax.clear_caches()
    reached(scene, target, progress=False)
    assert capsys.readouterr().err == ""


def test_a_quick_program_goes_through_all_transformations():
    calls = []

    @quick_jit
    def cube(x, shift=0.0):
        calls.append(1)
        return x**3 + shift

    x = jnp.array(2.0)
    assert cube(x) == cube(jnp.array(2.0), shift=0.0) == 8.0
    assert len(calls) <= 2, "it compiled again for the same kind of arguments"
    assert jax.jit(lambda: cube(x))() == 8.0  # known arguments, traced around
    assert jax.jit(cube)(x) == 8.0
    assert jax.grad(cube)(x) == jax.jit(jax.grad(cube))(x) == 12.0
    np.testing.assert_allclose(jax.vmap(cube)(jnp.arange(3.0)), [0.0, 1.0, 8.0])


def test_errors_of_a_quick_program_are_its_own():
    @quick_jit
    def refuses(x):
        raise ValueError("x: got a number, need none")

    with pytest.raises(ValueError, match="need none"):
        refuses(jnp.zeros(()))


def test_quick_options_are_taken_and_leave_what_a_user_has_set(monkeypatch):
    options, level = vsr.quick_compilation, "xla_backend_optimization_level"
    known = jax.default_backend() == "cpu" and jax.__version_info__ < (0, 11)
    assert jax.jit(lambda x: x + 1, compiler_options=options())(1.0) == 2.0
    for flags, expected in ((f"--{level}=0", False), ("", known)):
        monkeypatch.setenv("XLA_FLAGS", flags)
        assert (level in options()) == expected
    options().clear()
    assert options() or not known, "a user's changes reach the package"
