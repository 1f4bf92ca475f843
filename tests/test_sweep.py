"""Sweeps: the same numbers as one solve after the other, whatever the chunks, devices, processes and interruptions."""

import os
import signal
import socket
import subprocess
import sys
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax import archive

MODEL = vsr.StrainDependent(2)
SETUP = """
import os
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import vsr_jax as vsr

def arm(radius):
    rod = vsr.Rod(0.2, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45))
    return vsr.Scene(rod, [vsr.Tendon(vsr.Helix(radius, pitch=0.3)), vsr.Chamber(vsr.Parallel(y=0.0, z=-0.005), area=1e-5)])

model = vsr.StrainDependent(2)
inputs = np.random.default_rng(0).uniform(0, (5, 1e5), (23, 2))
"""
exec(SETUP)


@pytest.fixture(scope="module")
def expected():
    """Poses of the tip by a sweep in one piece."""
    return vsr.sweep(arm(0.006), inputs, model=MODEL, progress=False)["tip"]


def test_a_sweep_is_what_solve_says(expected):
    solved = jax.jit(jax.vmap(lambda u: vsr.solve(arm(0.006), u, model=MODEL).tip))(jnp.asarray(inputs))
    np.testing.assert_allclose(expected, solved, rtol=1e-14, atol=1e-16)


def test_chunks_change_no_bit(expected):
    result = vsr.sweep(arm(0.006), inputs, model=MODEL, chunk=5, progress=False)
    np.testing.assert_array_equal(result["tip"], expected)
    assert result.converged.all()
    assert result.counts == {"converged": 23}
    assert repr(result) == "Sweep(23 converged; tip (23, 4, 4))"


def test_a_bad_sample_changes_no_other(expected):
    bad = inputs.copy()
    bad[3], bad[11], bad[12] = (1e4, 0), (np.nan, 1), (-1, 0)
    result = vsr.sweep(arm(0.006), bad, model=MODEL, progress=False)
    others = np.setdiff1d(np.arange(23), [3, 11, 12])
    np.testing.assert_array_equal(result["tip"][others], expected[others])
    assert np.all(np.isnan(result["tip"][[3, 11, 12]]))
    assert [vsr.Status(int(s)).name for s in result.status[[3, 11, 12]]] == ["COLLAPSED", "NOT_FINITE", "INADMISSIBLE"]


def test_outputs_by_name_and_by_function(expected):
    named = vsr.sweep(arm(0.006), inputs, outputs=("lengths", "stability"), model=MODEL, progress=False)
    assert {name: x.shape for name, x in named.items()} == {"lengths": (23, 2), "stability": (23,)}
    made = vsr.sweep(arm(0.006), inputs, outputs=lambda eq: {"end": eq.tip[:3, 3], "middle": eq.position(0.1)}, model=MODEL, progress=False)
    np.testing.assert_allclose(made["end"], expected[:, :3, 3], rtol=1e-13)  # another program, which may round otherwise
    assert made["middle"].shape == (23, 3)


def test_scenes_may_change_from_sample_to_sample():
    samples = {"radius": np.linspace(0.001, 0.008, 23), "inputs": inputs}
    result = vsr.sweep(lambda s: (arm(s["radius"]), s["inputs"]), samples, model=MODEL, progress=False)
    alone = vsr.solve(arm(samples["radius"][20]), inputs[20], model=MODEL)
    np.testing.assert_allclose(result["tip"][20], alone.tip, atol=1e-14)


def test_single_precision():
    result = vsr.sweep(arm(0.006).astype("float32"), inputs.astype("float32"), model=MODEL, progress=False)
    assert result["tip"].dtype == np.float32
    assert result.converged.all()


def test_fewer_samples_side_by_side_where_memory_is_short(expected):
    result = vsr.sweep(arm(0.006), inputs, model=MODEL, memory=400_000, progress=False)
    np.testing.assert_allclose(result["tip"], expected, rtol=1e-14, atol=1e-16)
    with pytest.raises(ValueError, match="memory: got 10 bytes, need at least"):
        vsr.sweep(arm(0.006), inputs, model=MODEL, memory=10, progress=False)


def test_an_interrupted_sweep_goes_on_where_it_stopped(tmp_path, expected, monkeypatch):
    path, write, written = tmp_path / "sweep.zarr", archive.Archive.write, []

    def interrupted(self, index, arrays):
        if len(written) == 3:
            raise KeyboardInterrupt
        written.append(index)
        write(self, index, arrays)

    monkeypatch.setattr(archive.Archive, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        vsr.sweep(arm(0.006), inputs, model=MODEL, out=path, chunk=4, progress=False)
    monkeypatch.setattr(archive.Archive, "write", lambda self, index, arrays: (written.append(index), write(self, index, arrays)))
    result = vsr.sweep(arm(0.006), inputs, model=MODEL, out=path, progress=False)  # keeps its chunks of 4
    np.testing.assert_array_equal(result["tip"][:], expected)
    assert written == [0, 1, 2, 3, 4, 5]
    vsr.sweep(arm(0.006), inputs, model=MODEL, out=path, progress=False)
    assert len(written) == 6


def test_xarray_reads_a_sweep(tmp_path, expected):
    xarray = pytest.importorskip("xarray")
    vsr.sweep(arm(0.006), inputs, model=MODEL, outputs=("tip", "lengths"), out=tmp_path / "sweep.zarr", chunk=4, progress=False)
    data = xarray.open_zarr(tmp_path / "sweep.zarr", consolidated=False)
    np.testing.assert_array_equal(data["tip"], expected)
    np.testing.assert_array_equal(data["inputs"], inputs)
    assert data["lengths"].attrs["units"] == "m"
    assert data["status"].attrs["flag_meanings"].startswith("converged max_steps unstable")
    assert data["tip"].dims[0] == data["status"].dims[0] == "sample"


def test_another_sweep_is_refused(tmp_path):
    path = tmp_path / "sweep.zarr"
    vsr.sweep(arm(0.006), inputs, model=MODEL, out=path, progress=False)
    for scene, samples, model in (
        (arm(0.005), inputs, MODEL),
        (arm(0.006), inputs + 1e-9, MODEL),
        (arm(0.006), inputs, vsr.StrainDependent(3)),
    ):
        with pytest.raises(ValueError, match="holds another sweep"):
            vsr.sweep(scene, samples, model=model, out=path, progress=False)
    (tmp_path / "folder").mkdir()
    with pytest.raises(ValueError, match="holds no sweep"):
        vsr.sweep(arm(0.006), inputs, model=MODEL, out=tmp_path / "folder", progress=False)
    with pytest.raises(ValueError, match="there is no folder"):
        vsr.sweep(arm(0.006), inputs, model=MODEL, out=tmp_path / "no" / "sweep.zarr", progress=False)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inputs": inputs[0]}, r"sweep.inputs: got shape \(2,\), need \(samples, 2\)"),
        ({"inputs": inputs[:, :1]}, r"got shape \(23, 1\), need \(samples, 2\)"),
        ({"inputs": inputs[:0]}, "need arrays with one first axis"),
        ({"scene": lambda s: s, "inputs": {"a": inputs, "b": inputs[:3]}}, r"a \(23,\), inputs_b \(3,\), need"),
        ({"scene": "arm"}, "sweep.scene: got 'arm', need a Scene"),
        ({"outputs": "height"}, "sweep.outputs: got 'height', need some of tip, lengths"),
        ({"outputs": lambda eq: eq.tip}, "need arrays by name"),
        ({"outputs": lambda eq: {"status": eq.status}}, "need other names than status"),
        ({"chunk": 0}, "sweep.chunk: got 0, need an integer >= 1"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_is_refused(change, message):
    arguments = {"scene": arm(0.006), "inputs": inputs, "model": MODEL, **change}
    with pytest.raises(ValueError, match=message):
        vsr.sweep(arguments.pop("scene"), arguments.pop("inputs"), progress=False, **arguments)


def started(code, **environment):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    return subprocess.Popen([sys.executable, "-c", SETUP + code], env=environment, stderr=subprocess.PIPE, text=True)


def finished(process):
    _, said = process.communicate(timeout=200)
    assert process.returncode == 0, said


def test_eight_devices_give_the_same(tmp_path, expected):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    code = """
assert jax.device_count() == 8
np.save(os.environ["TO"], vsr.sweep(arm(0.006), inputs, model=model, progress=False)["tip"])
"""
    finished(started(code, XLA_FLAGS=flags, TO=str(tmp_path / "tip.npy")))
    np.testing.assert_allclose(np.load(tmp_path / "tip.npy"), expected, rtol=1e-14, atol=1e-16)  # another program, rounded otherwise


def test_two_processes_give_the_same_in_memory_and_on_disk(tmp_path, expected):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    code = """
number, folder = int(os.environ["NUMBER"]), os.environ["TO"]
jax.distributed.initialize(os.environ["ADDRESS"], num_processes=2, process_id=number)
result = vsr.sweep(arm(0.006), inputs, model=model, chunk=5, progress=False)
np.save(f"{folder}/{number}.npy", result["tip"])
vsr.sweep(arm(0.006), inputs, model=model, chunk=5, out=f"{folder}/sweep.zarr", progress=False)
"""
    both = [started(code, NUMBER=str(number), ADDRESS=address, TO=str(tmp_path)) for number in (0, 1)]
    for process in both:
        finished(process)
    for number in (0, 1):
        np.testing.assert_array_equal(np.load(tmp_path / f"{number}.npy"), expected)
    kept = vsr.sweep(arm(0.006), inputs, model=MODEL, out=tmp_path / "sweep.zarr", progress=False)
    np.testing.assert_array_equal(kept["tip"][:], expected)


def test_a_killed_sweep_goes_on_with_the_same_result(tmp_path):
    zarr = pytest.importorskip("zarr")
    code = "vsr.sweep(arm(0.006), np.tile(inputs, (200, 1)), model=model, chunk=200, out=os.environ['TO'], progress=False)"
    many, path = np.tile(inputs, (200, 1)), tmp_path / "sweep.zarr"
    process = started(code, TO=str(path))
    while not (path / "status" / "c" / "7").exists():
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    left = np.asarray(zarr.open_group(path, mode="r")["status"])
    assert 0 < np.count_nonzero(left == -1) < len(many)
    result = vsr.sweep(arm(0.006), many, model=MODEL, out=path, progress=False)
    whole = vsr.sweep(arm(0.006), many, model=MODEL, chunk=200, progress=False)
    np.testing.assert_array_equal(result["tip"][:], whole["tip"])
    np.testing.assert_array_equal(result.status[:], whole.status)


def test_a_scene_of_traced_numbers_is_a_scene():
    changed = eqx.tree_at(lambda s: s.rod.length, arm(0.006), jnp.array(0.25))
    longer = vsr.sweep(changed, inputs[:2], model=MODEL, progress=False)
    assert longer["tip"][0, 0, 3] > 0.2
