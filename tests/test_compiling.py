"""Programs of the package: compiled quickly at first, better later, and kept on disk."""

import gc
import os
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.numerics import compiling, program_store
from vsr_jax.numerics.compiling import program
from vsr_jax.studies import paper

MAIN = "import sys; from vsr_jax.cli.main import main; sys.exit(main())"


@pytest.fixture
def as_installed(monkeypatch):
    """Without the compiler settings of the tests."""
    monkeypatch.setenv("XLA_FLAGS", "")


def run(folder, scene, *arguments):
    """A solve in a process of its own, as a user runs it."""
    environment = os.environ | {"VSR_JAX_CACHE": str(folder)}
    command = [sys.executable, "-c", MAIN, "solve", str(scene), *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return done.stdout


def programs(folder):
    return sorted(path.name for path in folder.iterdir())


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
    assert program_store.folder() == tmp_path
    monkeypatch.setenv("VSR_JAX_CACHE", "off")
    assert program_store.folder() is None
    monkeypatch.delenv("VSR_JAX_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "users"))
    monkeypatch.setattr(sys, "platform", "linux")
    assert program_store.folder() == tmp_path / "users" / "vsr_jax"


def made(shift=0.0):
    """A program, a new one each time."""

    @program("cube")
    def cube(x):
        return {"cube": x**3 + shift, "kind": "cube"}

    return cube


def compiled(monkeypatch):
    """The compiler options of each program that XLA compiles from now on."""
    seen, compile = [], jax.stages.Lowered.compile

    def counted(self, compiler_options=None, **more):
        seen.append(compiler_options)
        return compile(self, compiler_options, **more)

    monkeypatch.setattr(jax.stages.Lowered, "compile", counted)
    return seen


def test_a_program_is_kept_and_found_by_another_of_the_same_code(monkeypatch, tmp_path):
    monkeypatch.setenv("VSR_JAX_CACHE", str(tmp_path))
    seen, x = compiled(monkeypatch), jnp.arange(3.0)
    np.testing.assert_array_equal(made()(x)["cube"], x**3)
    assert len(programs(tmp_path)) == len(seen) == 1
    np.testing.assert_array_equal(made()(x)["cube"], x**3)
    assert len(seen) == 1
    np.testing.assert_array_equal(made(2.0)(x)["cube"], x**3 + 2)
    np.testing.assert_array_equal(made()(x.astype("float32"))["cube"], x**3)
    assert len(programs(tmp_path)) == len(seen) == 3
    assert jax.config.jax_compilation_cache_dir is None, "the cache of the user's programs"


def summed(size):
    table = jnp.full(4, size)
    return program("sum")(lambda x: x * table.sum())


def test_a_constant_of_the_function_is_part_of_the_program(monkeypatch, tmp_path):
    monkeypatch.setenv("VSR_JAX_CACHE", str(tmp_path))
    assert summed(1.0)(jnp.ones(())) == 4.0
    assert summed(2.0)(jnp.ones(())) == 8.0


def test_arguments_that_are_not_used_are_part_of_the_program(monkeypatch, tmp_path):
    monkeypatch.setenv("VSR_JAX_CACHE", str(tmp_path))
    one, three = jnp.array(1.0), jnp.array([3.0, 4.0, 5.0])
    assert program("first")(lambda a, b: 2 * a)(one, three) == 2.0
    assert program("second")(lambda b, a: 2 * a)(three, one) == 2.0
    assert program("third")(lambda a, b: 2 * b)(one, jnp.array(7.0)) == 14.0
    assert program("fourth")(lambda a, b: 2 * a)(one, jnp.array(7.0)) == 2.0


@pytest.mark.parametrize("content", [b"", b"no program", None])
def test_a_damaged_program_is_compiled_again(monkeypatch, tmp_path, content):
    monkeypatch.setenv("VSR_JAX_CACHE", str(tmp_path))
    x = jnp.arange(3.0)
    made()(x)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] if content is None else content)
    seen = compiled(monkeypatch)
    np.testing.assert_array_equal(made()(x)["cube"], x**3)
    assert len(seen) == 1
    assert path.stat().st_size == pytest.approx(len(whole), rel=0.01)


def test_a_program_that_cannot_be_stored_runs(monkeypatch, tmp_path):
    monkeypatch.setenv("VSR_JAX_CACHE", str(tmp_path))

    @program("called")
    def called(x):
        return jax.pure_callback(lambda x: 2 * np.asarray(x), x, x)

    assert called(jnp.ones(())) == 2.0
    assert not programs(tmp_path)


def test_a_folder_that_cannot_be_written_is_not_used(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("VSR_JAX_CACHE", str(tmp_path / "file" / "folder"))
    assert made()(jnp.array(2.0))["cube"] == 8.0


@pytest.mark.parametrize(("most", "left"), [(25, ["b", "c"]), (100, ["a", "b", "c"]), (0, [])])
def test_the_programs_used_longest_ago_are_removed_first(tmp_path, most, left):
    for age, name in enumerate("cba"):
        path = tmp_path / f"{name}.program"
        path.write_bytes(bytes(10))
        os.utime(path, (1000 - age, 1000 - age))
    (tmp_path / "other").write_bytes(bytes(100))
    program_store.remove_oldest(tmp_path, most)
    assert sorted(path.stem for path in tmp_path.iterdir()) == [*left, "other"]


QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


def improver_is_done():
    for thread in threading.enumerate():
        if thread.name == "vsr_jax compiler":
            thread.join(60)


def test_a_program_that_runs_for_long_is_compiled_again(monkeypatch, as_installed):
    seen, x = compiled(monkeypatch), jnp.arange(3.0)
    monkeypatch.setattr(compiling, "LONG", 1e9)
    made()(x)
    improver_is_done()
    assert seen == [QUICK]
    seen.clear()
    monkeypatch.setattr(compiling, "LONG", -1.0)
    cube = made()
    first = cube(x)
    improver_is_done()
    assert seen == [QUICK, {}]
    np.testing.assert_allclose(cube(x)["cube"], first["cube"], rtol=1e-15)
    improver_is_done()
    assert seen == [QUICK, {}]


def test_the_better_of_two_kept_programs_is_used(monkeypatch, tmp_path, as_installed):
    monkeypatch.setenv("VSR_JAX_CACHE", str(tmp_path))
    monkeypatch.setattr(compiling, "LONG", -1.0)
    seen, x = compiled(monkeypatch), jnp.arange(3.0)
    made()(x)
    improver_is_done()
    made()(x)
    improver_is_done()
    assert seen == [QUICK, {}]


def test_a_second_compilation_that_fails_leaves_the_first_one_and_others(monkeypatch, as_installed):
    def fails(kind):
        raise RuntimeError("no memory")

    monkeypatch.setattr(compiling, "LONG", -1.0)
    x, cube = jnp.arange(3.0), made()
    with monkeypatch.context() as broken:
        broken.setattr(compiling._Kind, "improve", fails)
        cube(x)
        improver_is_done()
    np.testing.assert_array_equal(cube(x)["cube"], x**3)
    seen = compiled(monkeypatch)
    made()(x)
    improver_is_done()
    assert seen == [QUICK, {}]


def test_one_tier_has_the_defaults_of_the_compiler(monkeypatch, as_installed):
    monkeypatch.setenv("VSR_JAX_TIERS", "off")
    seen = compiled(monkeypatch)
    monkeypatch.setattr(compiling, "LONG", -1.0)
    made()(jnp.arange(3.0))
    improver_is_done()
    assert seen == [{}]


def test_a_process_ends_while_a_program_is_compiled_again():
    """Quietly, with all that was printed, after the program at work and not the others."""
    script = """
import jax, time, jax.numpy as jnp
from vsr_jax.numerics import compiling
compiling.LONG = -1.0
slow = compiling._Kind.improve
def improve(self):
    time.sleep(0.5)
    slow(self)
    print("improved", flush=True)
compiling._Kind.improve = improve
for n in range(3):
    compiling.program("cube")(lambda x: x**3 + n)(jnp.ones(2))
print("done")
"""
    environment = os.environ | {"XLA_FLAGS": "", "VSR_JAX_CACHE": "off"}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split() == ["done", "improved"]


@pytest.mark.parametrize("silent", [0.0, 10.0])
def test_a_program_says_that_it_compiles_if_that_takes_long(monkeypatch, capsys, silent):
    monkeypatch.setattr(compiling, "SILENT", silent)

    @program("reach")
    def slow(x):
        time.sleep(0.3)
        return x

    slow(jnp.ones(2))
    assert capsys.readouterr().err == ("" if silent else "vsr_jax: compiling reach\n")
    slow(jnp.ones(2))
    with compiling.messages(False):
        slow(jnp.ones(3))
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("enabled", [True, False])
def test_nothing_looks_for_garbage_while_a_program_is_traced(enabled):
    """Afterwards as before, also where tracing fails."""
    seen = []

    @program("traced")
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
    jax.jit(traced)(jnp.ones((1, 1)))
    assert seen == [False, False, False]


def test_a_program_goes_through_all_transformations():
    calls = []

    @program("cube")
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


def test_a_static_function_may_close_over_traced_numbers():
    @program("applied")
    def applied(function, x):
        return function(x)

    def cube(size):
        return applied(lambda x: size * x**3, jnp.array(2.0))

    assert jax.grad(cube)(5.0) == jax.jit(jax.grad(cube))(5.0) == 8.0
    np.testing.assert_array_equal(jax.vmap(cube)(jnp.arange(3.0)), [0.0, 8.0, 16.0])
    assert cube(3.0) == 24.0


def test_a_program_is_that_of_the_arguments_and_settings():
    @program("scaled")
    def scaled(x, factor, more):
        return x * factor + jnp.arange(3).sum() * more["one"]

    x = jnp.ones(2)
    assert scaled(x, 2, {"one": 1.0}).dtype == x.dtype
    np.testing.assert_array_equal(scaled(x, 3, {"one": 1.0}), [6.0, 6.0])
    np.testing.assert_array_equal(scaled(x, 3, {"one": jnp.array(2.0)}), [9.0, 9.0])
    assert scaled(x.astype("float32"), 3.0, {"one": 1}).dtype == "float32"
    jax.config.update("jax_enable_x64", False)
    try:
        assert scaled(jnp.ones(2), 2, {"one": 1.0}).dtype == "float32"
    finally:
        jax.config.update("jax_enable_x64", True)
    with jax.disable_jit():
        np.testing.assert_array_equal(scaled(x, 3, {"one": 1.0}), [6.0, 6.0])


def test_a_method_is_a_program_of_its_object():
    class Box:
        def __init__(self, size):
            self.size = size

        @program("volume")
        def volume(self, x):
            return x * self.size

    assert Box(2.0).volume(jnp.ones(())) == 2.0
    assert Box(3.0).volume(jnp.ones(())) == 3.0


def test_errors_of_a_program_are_its_own():
    @program("refuses")
    def refuses(x):
        raise ValueError("x: got a number, need none")

    with pytest.raises(ValueError, match="need none"):
        refuses(jnp.zeros(()))


def test_quick_options_are_taken_and_leave_what_a_user_has_set(monkeypatch):
    options, level = vsr.quick_compilation, "xla_backend_optimization_level"
    known = jax.default_backend() == "cpu"
    assert jax.jit(lambda x: x + 1, compiler_options=options())(1.0) == 2.0
    for flags, expected in ((f"--{level}=0", False), ("", known)):
        monkeypatch.setenv("XLA_FLAGS", flags)
        assert (level in options()) == expected
    assert jax.jit(lambda x: x + 2, compiler_options=options())(1.0) == 3.0
    options().clear()
    assert options() or not known, "a user's changes reach the package"


@pytest.mark.slow
def test_both_tiers_solve_alike(monkeypatch, as_installed):
    """The catheter under loads, as a user runs it."""
    arm = vsr.Rod(0.3, vsr.Circular(0.001), vsr.Material(60e6, poisson=0.4, density=1100.0))
    tendons = [vsr.Tendon(vsr.Parallel(0.0008, 0.0)), vsr.Tendon(vsr.Parallel(0.0, 0.0008))]
    scene = vsr.Scene(arm, tendons, loads=[vsr.Gravity(), vsr.TipWrench(force=(0.0, 1e-3, 0.0))])
    seen = compiled(monkeypatch)
    monkeypatch.setattr(compiling, "LONG", -1.0)
    quick = vsr.solve(scene, [0.1, 0.2])
    improver_is_done()
    assert {} in seen
    best = vsr.solve(scene, [0.1, 0.2])
    np.testing.assert_allclose(best.tip, quick.tip, atol=1e-12)
    assert best.steps == quick.steps
