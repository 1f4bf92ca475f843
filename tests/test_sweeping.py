"""Sweeps: the same numbers as one solve after the other, whatever the chunks, devices, processes
and interruptions."""

import os
import pathlib
import shutil
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
from vsr_jax.analysis import sweep_program, sweep_store as archive, sweeping
from vsr_jax.analysis.sweep_labels import labels
from vsr_jax.analysis.sweep_program import Task
from vsr_jax.files.scene_file import parse_scene

MODEL = vsr.StrainDependent(2)
SETUP = """
import os
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import vsr_jax as vsr

def arm(radius):
    rod = vsr.Rod(0.2, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45))
    tendon = vsr.Tendon(vsr.Helix(radius, pitch=0.3))
    chamber = vsr.Chamber(vsr.Parallel(y=0.0, z=-0.005), area=1e-5)
    return vsr.Scene(rod, [tendon, chamber])

model = vsr.StrainDependent(2)
inputs = np.random.default_rng(0).uniform(0, (5, 1e5), (23, 2))
"""
exec(SETUP)


@pytest.fixture(scope="module")
def expected():
    """Poses of the tip by a sweep in one piece."""
    return vsr.sweep(arm(0.006), inputs, model=MODEL, progress=False)["tip"]


def test_a_sweep_is_what_solve_says(expected):
    solved = jax.jit(jax.vmap(lambda u: vsr.solve(arm(0.006), u, model=MODEL).tip))(
        jnp.asarray(inputs)
    )
    np.testing.assert_allclose(expected, solved, rtol=1e-14, atol=1e-16)


def test_chunks_change_no_bit(expected):
    result = vsr.sweep(arm(0.006), inputs, model=MODEL, chunk=5, progress=False)
    np.testing.assert_array_equal(result["tip"], expected)
    assert result.converged.all()
    assert result.counts == {"converged": 23}
    assert repr(result) == "Sweep(23 converged; tip (23, 4, 4))"


@pytest.mark.slow
def test_cores_change_no_bit(monkeypatch):
    monkeypatch.setattr(sweep_program, "BATCH_SIZE", 4)
    tips = []
    for cores in (1, 3):
        monkeypatch.setattr(sweep_program, "cores", lambda cores=cores: cores)
        result = vsr.sweep(arm(0.006), inputs, model=MODEL, chunk=9, progress=False)
        assert result.converged.all()
        tips.append(result["tip"])
    np.testing.assert_array_equal(*tips)


def test_the_bar_says_compiling_and_advances_within_a_chunk(monkeypatch, capsys):
    steps = []

    class Bar(sweeping.tqdm):
        def update(self, n=1):
            steps.append((self.desc, n))
            return super().update(n)

    monkeypatch.setattr(sweeping, "tqdm", Bar)
    monkeypatch.setattr(sweep_program, "BATCH_SIZE", 4)
    vsr.sweep(arm(0.006), inputs, model=MODEL)
    shown = capsys.readouterr().err.strip().split("\r")
    assert shown[0].startswith("compiling: 0.00 shapes")
    assert "100%" in shown[-1]
    assert "23.0/23.0" in shown[-1]
    assert steps[0] == ("", 4)  # the first part is one batch
    assert sum(number for _, number in steps) == 23


def test_an_error_in_a_thread_ends_the_sweep(monkeypatch):
    def broken(self, samples, count):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(sweep_program.Program, "_solve", broken)
    with pytest.raises(RuntimeError, match="out of memory"):
        vsr.sweep(arm(0.006), inputs, model=MODEL, chunk=5, progress=False)


def test_a_bad_sample_changes_no_other(expected):
    bad = inputs.copy()
    bad[3], bad[11], bad[12] = (1e4, 0), (np.nan, 1), (-1, 0)
    result = vsr.sweep(arm(0.006), bad, model=MODEL, progress=False)
    others = np.setdiff1d(np.arange(23), [3, 11, 12])
    np.testing.assert_array_equal(result["tip"][others], expected[others])
    assert np.all(np.isnan(result["tip"][[3, 11, 12]]))
    assert [vsr.Status(int(s)).name for s in result.status[[3, 11, 12]]] == [
        "COLLAPSED",
        "NOT_FINITE",
        "INADMISSIBLE",
    ]


@pytest.mark.slow
def test_outputs_by_name_and_by_function(expected):
    named = vsr.sweep(
        arm(0.006), inputs, outputs=("lengths", "stability"), model=MODEL, progress=False
    )
    assert {name: x.shape for name, x in named.items()} == {"lengths": (23, 2), "stability": (23,)}
    made = vsr.sweep(
        arm(0.006),
        inputs,
        outputs=lambda eq: {"end": eq.tip[:3, 3], "middle": eq.position(0.1)},
        model=MODEL,
        progress=False,
    )
    np.testing.assert_allclose(
        made["end"], expected[:, :3, 3], rtol=1e-13
    )  # another program, which may round otherwise
    assert made["middle"].shape == (23, 3)


def test_scenes_may_change_from_sample_to_sample():
    samples = {"radius": np.linspace(0.001, 0.008, 23), "inputs": inputs}
    result = vsr.sweep(
        lambda s: (arm(s["radius"]), s["inputs"]), samples, model=MODEL, progress=False
    )
    alone = vsr.solve(arm(samples["radius"][20]), inputs[20], model=MODEL)
    np.testing.assert_allclose(result["tip"][20], alone.tip, atol=1e-14)


def test_single_precision():
    result = vsr.sweep(
        arm(0.006).astype("float32"), inputs.astype("float32"), model=MODEL, progress=False
    )
    assert result["tip"].dtype == np.float32
    assert result.converged.all()


@pytest.mark.slow
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
    monkeypatch.setattr(
        archive.Archive,
        "write",
        lambda self, index, arrays: (written.append(index), write(self, index, arrays)),
    )
    result = vsr.sweep(
        arm(0.006), inputs, model=MODEL, out=path, progress=False
    )  # keeps its chunks of 4
    np.testing.assert_array_equal(result["tip"][:], expected)
    assert written == [0, 1, 2, 3, 4, 5]
    vsr.sweep(arm(0.006), inputs, model=MODEL, out=path, progress=False)
    assert len(written) == 6


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A finished sweep on disk, of six chunks."""
    path = tmp_path_factory.mktemp("store") / "sweep.zarr"
    vsr.sweep(arm(0.006), inputs, model=MODEL, out=path, chunk=4, progress=False)
    return path


def again(path):
    return vsr.sweep(arm(0.006), inputs, model=MODEL, out=path, progress=False)


def contents(path):
    return {
        str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()
    }


def flipped(file):
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 4
    file.write_bytes(data)


DAMAGE = {
    "deleted": lambda file: file.unlink(),
    "flipped": flipped,
    "truncated": lambda file: file.write_bytes(file.read_bytes()[:-7]),
    "emptied": lambda file: file.write_bytes(b""),
}


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [2, 5])
@pytest.mark.parametrize("name", ["tip", "status", "inputs"])
@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_chunk_is_made_again(tmp_path, store, expected, damage, name, chunk):
    path = shutil.copytree(store, tmp_path / "sweep.zarr")
    DAMAGE[damage](
        path / name / "c" / str(chunk) / "/".join("0" * {"tip": 2, "status": 0, "inputs": 1}[name])
    )
    with pytest.warns(
        UserWarning,
        match=rf"missing or damaged chunks, .*: {name}\[{4 * chunk}:{min(4 * chunk + 4, 23)}\]$",
    ):
        result = again(path)
    np.testing.assert_array_equal(result["tip"][:], expected)
    assert contents(path) == contents(store)
    again(path)  # without a warning, which would be an error


def test_damage_is_found_before_a_sweep_has_ended(tmp_path, store, monkeypatch):
    path, write = tmp_path / "sweep.zarr", archive.Archive.write

    def interrupted(self, index, arrays):
        if index == 4:
            raise KeyboardInterrupt
        write(self, index, arrays)

    monkeypatch.setattr(archive.Archive, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        vsr.sweep(arm(0.006), inputs, model=MODEL, out=path, chunk=4, progress=False)
    monkeypatch.undo()
    flipped(path / "tip" / "c" / "1" / "0" / "0")
    (path / "tip" / "c" / "3" / "0" / "0").unlink()
    flipped(path / "inputs" / "c" / "5" / "0")
    flipped(path / "actuator_type" / "c" / "0")
    with pytest.warns(
        UserWarning,
        match=r"computed again\): actuator_type\[0:2\], tip\[4:8\], tip\[12:16\], inputs\[20:23\]$",
    ):
        again(path)
    assert contents(path) == contents(store)


def test_a_chunk_in_which_every_sample_failed_is_no_damage(tmp_path):
    bad = np.where(np.arange(23)[:, None] // 4 == 2, np.nan, inputs)
    for _ in range(2):
        result = vsr.sweep(
            arm(0.006), bad, model=MODEL, out=tmp_path / "sweep.zarr", chunk=4, progress=False
        )
    assert result.counts == {"converged": 19, "not_finite": 4}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize(
    "file", ["zarr.json", "tip/zarr.json", "status/zarr.json", "actuator/zarr.json"]
)
def test_damaged_metadata_is_one_line(tmp_path, store, file, damage):
    path = shutil.copytree(store, tmp_path / "sweep.zarr")
    DAMAGE[damage](path / file)
    needed = (
        r"holds no sweep \(no zarr.json\)"
        if (file, damage) == ("zarr.json", "deleted")
        else "metadata in .* are damaged"
    )
    with pytest.raises(ValueError, match=f"sweep.out: .*{needed}"):
        again(path)


def test_two_sweeps_do_not_write_at_once(tmp_path, store, monkeypatch):
    path, write, refused = tmp_path / "sweep.zarr", archive.Archive.write, []

    def disturbed(self, index, arrays):
        if not refused:
            with pytest.raises(ValueError, match="another sweep is writing to") as error:
                again(path)
            refused.append(error)
        write(self, index, arrays)

    monkeypatch.setattr(archive.Archive, "write", disturbed)
    vsr.sweep(arm(0.006), inputs, model=MODEL, out=path, chunk=4, progress=False)
    assert refused
    assert contents(path) == contents(store)


def test_two_sweeps_make_one_folder_at_once(tmp_path, store, monkeypatch):
    path, rename = tmp_path / "sweep.zarr", pathlib.Path.rename

    def overtaken(draft, target):
        if not path.exists():
            shutil.copytree(store, path)
        return rename(draft, target)

    monkeypatch.setattr(pathlib.Path, "rename", overtaken)
    again(path)
    assert contents(path) == contents(store)
    assert [file.name for file in tmp_path.iterdir()] == ["sweep.zarr"]


def test_xarray_reads_a_sweep(tmp_path, expected):
    xarray, path = pytest.importorskip("xarray"), tmp_path / "sweep.zarr"
    vsr.sweep(
        arm(0.006),
        inputs,
        model=MODEL,
        outputs=("tip", "lengths", "q", "steps"),
        out=path,
        chunk=4,
        progress=False,
    )
    data = xarray.open_zarr(path)  # without a warning, which would be an error
    np.testing.assert_array_equal(data["inputs"], inputs)
    np.testing.assert_array_equal(
        data["tip"].sel(column="position", row=["x", "y", "z"]), expected[:, :3, 3]
    )
    dims = {
        "inputs": ("actuator",),
        "tip": ("row", "column"),
        "lengths": ("actuator",),
        "q": ("actuator",),
        "steps": (),
        "status": (),
    }
    assert {name: x.dims for name, x in data.data_vars.items()} == {
        name: ("sample", *more) for name, more in dims.items()
    }
    assert set(data.coords) == {
        "actuator",
        "actuator_type",
        "input_units",
        "row",
        "column",
        "column_units",
    }
    units = {
        "inputs": "see input_units",
        "tip": "see column_units",
        "lengths": "m",
        "q": "N",
        "steps": "1",
        "status": None,
    }
    assert {name: x.attrs.get("units") for name, x in data.data_vars.items()} == units
    assert all(x.attrs["long_name"] for x in data.variables.values())
    assert list(data["input_units"].values) == ["N", "Pa"]
    assert list(data["actuator_type"].values) == ["Tendon", "Chamber"]
    assert list(data["column_units"].values) == ["1", "1", "1", "m"]
    assert data["status"].attrs["flag_meanings"].startswith("converged not_converged unstable")
    assert data.attrs["source"] == f"vsr_jax {vsr.__version__}"
    assert (data.attrs["model"], data.attrs["precision"]) == (
        "StrainDependent(steps=2, order=6)",
        "float64",
    )
    assert eqx.tree_equal(parse_scene(data.attrs["scene"]).scene, arm(0.006))


def labelled(scene, samples, outputs, model=MODEL):
    task = Task(scene, model, outputs)
    samples = jax.tree.map(np.asarray, samples)
    like = jax.eval_shape(jax.vmap(lambda sample: task(sample)), samples)
    return labels(
        task,
        like,
        samples,
        {f"inputs_{name}": x for name, x in samples.items()}
        if isinstance(samples, dict)
        else {"inputs": samples},
    )


def test_labels_of_coordinates_and_of_what_a_function_returns():
    basis = vsr.Basis({"elongation": vsr.Legendre(0), "bending_y": vsr.Monomial(1)})
    found = labelled(arm(0.006), inputs, ("q",), vsr.Prescribed(basis))
    assert found.arrays["q"].dims == ("sample", "dof")
    assert list(found.coordinates["dof"]) == ["bending_y_0", "bending_y_1", "elongation_0"]
    assert list(found.coordinates["dof_units"]) == ["1/m", "1/m", "1"]
    samples = {"radius": np.full(23, 0.006), "u": inputs}
    found = labelled(
        lambda s: (arm(s["radius"]), s["u"]),
        samples,
        lambda eq: {"tip": eq.tip[:3], "l": eq.lengths},
    )
    dims = {name: found.arrays[name].dims for name in ("inputs_u", "tip")}
    assert dims == {
        "inputs_u": ("sample", "inputs_u_dim_1"),
        "tip": ("sample", "tip_dim_1", "tip_dim_2"),
    }
    assert list(found.coordinates["input_units"]) == ["N", "Pa"]
    assert "scene" not in found.attributes
    for name in ("actuator", "sample", "a/b"):
        with pytest.raises(
            ValueError,
            match=f"sweep.outputs: got '{name}', need a name without / and other than a",
        ):
            labelled(arm(0.006), inputs, lambda eq, name=name: {name: eq.tip})


def test_an_arm_without_actuators_and_outputs_of_any_kind(tmp_path):
    xarray, scene = pytest.importorskip("xarray"), vsr.Scene(arm(0.006).rod)
    for _ in range(2):
        result = vsr.sweep(
            scene,
            np.zeros((3, 0)),
            outputs=lambda eq: {
                "lengths": eq.lengths,
                "right": eq.converged,
                "small": eq.steps.astype("uint8"),
            },
            model=MODEL,
            out=tmp_path / "sweep.zarr",
            chunk=2,
            progress=False,
        )
    assert result["lengths"].shape == (3, 0)
    assert xarray.open_zarr(tmp_path / "sweep.zarr")["right"].values.tolist() == [True] * 3


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
        vsr.sweep(
            arm(0.006), inputs, model=MODEL, out=tmp_path / "no" / "sweep.zarr", progress=False
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inputs": inputs[0]}, r"sweep.inputs: got shape \(2,\), need \(samples, 2\)"),
        ({"inputs": inputs[:, :1]}, r"got shape \(23, 1\), need \(samples, 2\)"),
        ({"inputs": inputs[:0]}, "need arrays with the same number of samples"),
        (
            {"scene": lambda s: s, "inputs": {"a": inputs, "b": inputs[:3]}},
            r"a \(23,\), inputs_b \(3,\), need",
        ),
        ({"scene": "arm"}, "sweep.scene: got 'arm', need a Scene"),
        ({"outputs": "height"}, "sweep.outputs: got 'height', need names from tip, stability"),
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


simulated = pytest.mark.skipif(
    jax.default_backend() != "cpu", reason="several devices are simulated on a CPU"
)


def started(code, **environment):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    return subprocess.Popen(
        [sys.executable, "-c", SETUP + code], env=environment, stderr=subprocess.PIPE, text=True
    )


def finished(process):
    _, said = process.communicate(timeout=200)
    assert process.returncode == 0, said


@pytest.mark.slow
@simulated
def test_eight_devices_give_the_same(tmp_path, expected):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    code = """
assert jax.device_count() == 8
np.save(os.environ["TO"], vsr.sweep(arm(0.006), inputs, model=model, progress=False)["tip"])
"""
    finished(started(code, XLA_FLAGS=flags, TO=str(tmp_path / "tip.npy")))
    np.testing.assert_allclose(
        np.load(tmp_path / "tip.npy"), expected, rtol=1e-14, atol=1e-16
    )  # another program, rounded otherwise


@pytest.mark.slow
@simulated
def test_two_processes_give_the_same_in_memory_and_on_disk(tmp_path, expected):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    code = """
import warnings
from jax.experimental import multihost_utils
number, folder = int(os.environ["NUMBER"]), os.environ["TO"]
jax.distributed.initialize(os.environ["ADDRESS"], num_processes=2, process_id=number)
result = vsr.sweep(arm(0.006), inputs, model=model, chunk=5, progress=False)
np.save(f"{folder}/{number}.npy", result["tip"])
vsr.sweep(arm(0.006), inputs, model=model, chunk=5, out=f"{folder}/sweep.zarr", progress=False)
multihost_utils.sync_global_devices("written")
os.remove(f"{folder}/sweep.zarr/tip/c/{2 + number}/0/0")  # each finds damage in its own chunks
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    vsr.sweep(arm(0.006), inputs, model=model, out=f"{folder}/sweep.zarr", progress=False)
found = [str(x.message).split(": ")[-1] for x in said if "computed again" in str(x.message)]
assert found == [f"tip[{10 + 5 * number}:{15 + 5 * number}]"]
"""
    both = [
        started(code, NUMBER=str(number), ADDRESS=address, TO=str(tmp_path)) for number in (0, 1)
    ]
    for process in both:
        finished(process)
    for number in (0, 1):
        np.testing.assert_array_equal(np.load(tmp_path / f"{number}.npy"), expected)
    kept = vsr.sweep(arm(0.006), inputs, model=MODEL, out=tmp_path / "sweep.zarr", progress=False)
    np.testing.assert_array_equal(kept["tip"][:], expected)


@pytest.mark.slow
def test_a_killed_sweep_goes_on_with_the_same_result(tmp_path):
    zarr = pytest.importorskip("zarr")
    code = (
        "vsr.sweep(arm(0.006), np.tile(inputs, (200, 1)), model=model, chunk=200, "
        "out=os.environ['TO'], progress=False)"
    )
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
