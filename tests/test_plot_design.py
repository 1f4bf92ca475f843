"""Figures of designs, animations, annotations of arms; design files and the command that reads
them."""

import inspect
import json
import tomllib

import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
import tomli_w
from matplotlib.animation import FFMpegWriter

import vsr_jax as vsr
from vsr_jax.cli import main as cli
from vsr_jax.files.scene_file import load
from vsr_jax.optimization.descent import History
from vsr_jax.optimization.design_file import load_design
from vsr_jax.optimization.problem import Terms
from vsr_jax.viz import annotate, plot, plot_design
from vsr_jax.viz.animation import film

MODEL = vsr.StrainDependent(6)
PROBLEM = """
title = "A thread to one place"
inputs = [[2.0]]

[search]
steps = 4
starts = 2
candidates = 2

[scene]
free_strains = ["bending_z"]

[scene.rod]
length = 0.3
section = { type = "Circular", radius = 0.01 }
material = { young = 8e5, poisson = 0.45 }

[[scene.actuators]]
type = "Tendon"
routing = { type = "Parallel", y = 0.004, z = 0.0 }

[free]
"actuators[0].routing.y" = [0.001, 0.009]
inputs = [0.5, 4.0]

[[objectives]]
type = "TipError"
targets = [[0.28, 0.05, 0.0]]

[[objectives]]
type = "Tension"
weight = 1e-6
scale = 5.0

[[constraints]]
type = "Inside"
wall = 0.001
"""


@pytest.fixture(scope="module")
def eq():
    arm = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(8e5, poisson=0.45, density=1000.0))
    loads = [vsr.Gravity(), vsr.TipWrench(force=(0.0, 0.0, 0.02), frame="body")]
    return vsr.solve(
        vsr.Scene(arm, [vsr.Tendon(vsr.Parallel(0.005, 0.0))], loads), jnp.array([1.0]), model=MODEL
    )


@pytest.fixture
def problem(tmp_path):
    path = tmp_path / "problem.toml"
    path.write_text(PROBLEM)
    return path


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def arrows(ax):
    """Number of lines in each group of arrows in 3D axes."""
    return [len(bundle._segments3d) for bundle in ax.collections if hasattr(bundle, "_segments3d")]


@pytest.mark.slow
def test_frames_and_loads_are_drawn_onto_an_arm(eq):
    ax = annotate.frames(eq, plot.arm(eq, details=False), stations=5)
    assert arrows(ax) == [15, 15, 15]  # one shaft and two lines of the head per arrow
    loaded = annotate.loads(eq)
    assert len(loaded.collections) == 2  # twelve arrows of the weight, one at the tip
    assert loaded.zz_dataLim.x0 < -0.26  # the limits include all arrow heads
    assert loaded.zz_dataLim.x1 > -0.001
    weight, tip = annotate.rows_of(eq)
    assert (weight.unit, tip.unit) == ("N/m", "N")
    np.testing.assert_allclose(
        weight.vectors, [[0, 0, -9.81 * 1000 * np.pi * 1e-4]] * 12, rtol=1e-6
    )
    np.testing.assert_allclose(tip.vectors[0], 0.02 * np.asarray(eq.tip)[:3, 2], rtol=1e-6)
    texts = [text.get_text() for text in loaded.get_legend().get_texts()]
    assert texts == ["gravity: force 3.08 N/m", "follower tip wrench: force 0.02 N"]
    widths = [bundle.get_linewidth()[0] for bundle in loaded.collections]
    assert widths[0] < widths[1]  # a weight per length does not look like a force at a point


@pytest.mark.slow
def test_the_equilibrium_comes_before_the_axes(unchecked, eq):
    ax = plot.arm(eq)
    for draw in (annotate.loads, annotate.frames, plot.arm):
        names = list(inspect.signature(draw).parameters)
        assert names[:2] == ["eq", "ax"]
    with pytest.raises(ValueError, match=r"eq: got .*, need an Equilibrium, before the axes"):
        annotate.loads(ax, eq)


@pytest.mark.slow
def test_moments_and_loads_that_depend_on_the_pose_are_drawn(eq):
    loads = [
        vsr.TipWrench(moment=(0.0, 0.0, 1e-3)),
        vsr.Payload(0.01, X=0.3),
        vsr.DistributedWrench(force=(0.0, 0.1, 0.0), frame="body"),
    ]
    rod = eq.scene.rod
    arm = vsr.solve(vsr.Scene(rod, eq.scene.actuators, loads), [1.0], model=MODEL)
    moment, payload, along = annotate.rows_of(arm)
    np.testing.assert_allclose(moment.vectors, [[0.0, 0.0, 1e-3]])
    np.testing.assert_allclose(payload.vectors, [[0.0, 0.0, -0.0981]], rtol=1e-6, atol=1e-12)
    poses = np.asarray(arm.pose(jnp.linspace(0, 0.3, 12)))
    np.testing.assert_allclose(along.vectors, 0.1 * poses[:, :3, 1], atol=1e-9)
    assert [row.unit for row in (moment, payload, along)] == ["N m", "N", "N/m"]
    ax = annotate.loads(arm)
    styles = [line.get_linestyle() for line in ax.get_legend().get_lines()]
    assert styles == ["--", "-", "-"]


@pytest.mark.slow
def test_arrows_of_point_forces_have_one_scale(eq):
    loads = [
        vsr.PointWrench(0.1, force=(0.0, 0.0, 0.02)),
        vsr.PointWrench(0.2, force=(0.0, 0.01, 0.0), frame="body"),
    ]
    arm = vsr.solve(vsr.Scene(eq.scene.rod, eq.scene.actuators, loads), [1.0], model=MODEL)
    ax = annotate.loads(arm)
    dead, follower = (np.asarray(bundle._segments3d)[0] for bundle in ax.collections)
    for shaft, share in ((dead, 0.16), (follower, 0.08)):
        np.testing.assert_allclose(np.linalg.norm(shaft[1] - shaft[0]), share * 0.3, rtol=1e-6)


def test_an_ellipsoid_has_its_semi_axes():
    ax = annotate.ellipsoid(
        vsr.Ellipsoid(jnp.array([1.0, 0.0, 0.0]), jnp.diag(jnp.array([0.5, 0.2, 0.1]))), scale=2.0
    )
    np.testing.assert_allclose(ax.xy_dataLim.intervalx, (0.0, 2.0), atol=1e-3)
    np.testing.assert_allclose(ax.xy_dataLim.intervaly, (-0.4, 0.4), atol=1e-3)


@pytest.mark.slow
def test_a_film_has_a_frame_for_each_arm(eq, tmp_path):
    moving = film([eq, eq, eq], tmp_path / "arm.gif", titles=["a", "b", "c"], seconds=1.0, dpi=30)
    assert moving is not None
    assert plt.imread(tmp_path / "arm.gif").ndim == 3
    axes = moving._fig.axes[0]
    assert [axes.get_xlabel(), axes.get_ylabel(), axes.get_zlabel()] == ["x [m]", "y [m]", "z [m]"]
    with pytest.raises(ValueError, match=r"path: got 'arm\.avi', need a name that ends in \.gif"):
        film([eq], "arm.avi")
    with pytest.raises(ValueError, match="equilibria: got none"):
        film([])
    with pytest.raises(ValueError, match="titles: got 1, need 2"):
        film([eq, eq], titles=["a"])


@pytest.mark.slow
def test_a_film_keeps_the_last_shape_where_a_solve_failed(eq, tmp_path):
    bare = vsr.Scene(eq.scene.rod, eq.scene.actuators)
    fine, failed = (vsr.solve(bare, [tension], model=MODEL) for tension in (1.0, 1e6))
    moving = film([fine, failed], tmp_path / "arm.gif", titles=["one", "two"], dpi=30)
    moving._func(1)
    axes = moving._fig.axes[0]
    assert moving._fig.get_suptitle() == "two: no equilibrium"
    last = np.array(axes.lines[-1].get_data_3d()).T
    np.testing.assert_allclose(last[-1], fine.tip[:3, 3], atol=1e-9)
    with pytest.raises(ValueError, match=r"equilibria\[0\]: got a solve that failed"):
        film([failed])


def test_an_mp4_needs_ffmpeg(eq, tmp_path, monkeypatch):
    monkeypatch.setitem(mpl.rcParams, "animation.ffmpeg_path", "no_such_program")
    with pytest.raises(ValueError, match=r"need ffmpeg for \.mp4, or a \.gif"):
        film([eq], tmp_path / "arm.mp4")


@pytest.mark.skipif(not FFMpegWriter.isAvailable(), reason="needs ffmpeg")
def test_a_film_as_mp4(eq, tmp_path):
    film([eq, eq], tmp_path / "arm.mp4", seconds=1.0, dpi=33)
    assert (tmp_path / "arm.mp4").read_bytes()[4:8] == b"ftyp"


@pytest.mark.slow
def test_a_design_is_drawn_for_every_set_of_inputs_with_its_targets(eq):
    scene = vsr.Scene(eq.scene.rod, eq.scene.actuators)
    none = History(np.zeros((0, 1)), np.zeros((0, 1)))
    targets = np.array([[0.28, 0.03, 0.0], [0.26, 0.07, 0.0]])
    objective = 0.5 * vsr.objective.TipError(targets) + vsr.objective.Tension(5.0)
    problem = Terms(scene, jnp.array([[0.5], [1.5]]), MODEL, objective, (), {})
    inputs = jnp.array([[1.0], [2.0]])
    found = vsr.Design(scene, inputs, 0.0, True, {}, (), (), 0, none, problem)
    for given, drawn in ((None, targets), (targets[:1], targets[:1])):
        ax = plot_design.before_after(found, targets=given)
        names = [text.get_text() for text in ax.get_legend().get_texts()]
        assert names == ["before", "after", "target"]
        ends = [np.array(line.get_data_3d())[:, -1] for line in ax.lines[1::2]]
        tips = [vsr.solve(scene, [u], model=MODEL).tip[:3, 3] for u in (0.5, 1.5, 1.0, 2.0)]
        np.testing.assert_allclose(ends, tips, atol=1e-9)
        crosses = np.transpose(ax.collections[-1]._offsets3d)
        np.testing.assert_allclose(crosses, drawn)


@pytest.mark.slow
def test_the_command_designs_saves_and_draws(problem, tmp_path, capsys, monkeypatch):
    out, record, picture = (
        tmp_path / name for name in ("designed.toml", "design.json", "design.png")
    )
    code = cli.main(
        ["design", str(problem), "--out", str(out), "--json", str(record), "--plot", str(picture)]
    )
    said, bar = capsys.readouterr()
    assert code == 0
    assert bar.index("compiling:   0%") < bar.index("designing: 100%")
    assert "Inside(wall=0.001): satisfied" in said
    assert "actuators[0].routing.y = " in said
    kept, told = load(out), json.loads(record.read_text())
    assert float(kept.scene.actuators[0].routing.y) == pytest.approx(
        told["numbers"]["actuators[0].routing.y"]
    )
    assert kept.inputs.tolist() == pytest.approx(told["inputs"][0])
    assert told["feasible"]
    assert len(told["starts"]) == 2
    assert picture.stat().st_size > 10_000


def test_a_history_marks_the_best_start(problem):
    arguments = load_design(problem)._asdict()
    del arguments["title"]
    found = vsr.design(**arguments, progress=False)
    best = found.starts[found.best]
    assert (best.objective, best.violation) == (found.objective, 0)
    lines = plot_design.history(found).get_lines()
    assert [line.get_label() for line in lines][-1] == "best start"
    assert np.nanmin(lines[-1].get_ydata()) == pytest.approx(found.objective)


@pytest.mark.slow
def test_a_design_of_a_scene_without_equilibrium_is_drawn_alone(eq):
    none = History(np.zeros((0, 1)), np.zeros((0, 1)))
    for tension, names in ((1e6, ["after"]), (2.0, ["before", "after"])):
        objective = vsr.objective.Tension(5.0)
        problem = Terms(eq.scene, jnp.array([[tension]]), MODEL, objective, (), {})
        found = vsr.Design(eq.scene, eq.inputs[None], 0.0, True, {}, (), (), 0, none, problem)
        space = plot_design.before_after(found)
        assert [text.get_text() for text in space.get_legend().get_texts()] == names


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[free]", "[fre]", "unknown key 'fre'"),
        (
            'type = "TipError"',
            'type = "TipEror"',
            r"objectives\[0\]: unknown type 'TipEror'.*did you mean 'TipError'",
        ),
        ("wall = 0.001", "wal = 0.001", r"constraints\[0\]: unknown key 'wal'"),
        ("wall = 0.001", "wall = -1.0", r"constraints\[0\]: Inside.wall: got -1"),
        ("young = 8e5", "young = -8e5", "young"),
        ("inputs = [[2.0]]", "", "missing key 'inputs'"),
        ("steps = 4", "step = 4", r"search: unknown key 'step'.*did you mean 'steps'"),
        ("steps = 4", "steps = 0", r"search: Search.steps: got 0, need an integer >= 1"),
        ("steps = 4", "optimizer = 1", r"search: got .*, need a table of numbers"),
        ("inputs = [[2.0]]", "inputs = [[2.0]]\nuncertain = 3", "uncertain: got 3, need a table"),
        ('"TipError"\n', f'"TipError"\nweight = {10**400}\n', "factor: got 1000.*, need a finite"),
        ("= 5.0", f"= {10**400}", r"objectives\[1\]: Tension.scale: got 1000.*, need a finite"),
    ],
)
def test_errors_of_design_files_name_file_and_key(unchecked, problem, old, new, message):
    problem.write_text(PROBLEM.replace(old, new, 1))
    with pytest.raises(ValueError, match=rf"problem.toml: .*{message}"):
        load_design(problem)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("scene", r"scene: got 3, need a file or a table \[scene\]"),
        ("free", r"free: got 3, need a table \[free\] of bounds"),
    ],
)
def test_a_number_in_place_of_a_table_is_one_line(unchecked, problem, key, message):
    table = tomllib.loads(PROBLEM) | {key: 3}
    problem.write_text(tomli_w.dumps(table))
    with pytest.raises(ValueError, match=rf"problem.toml: {message}"):
        load_design(problem)


def test_errors_of_the_command_are_one_line(problem, capsys):
    problem.write_text(PROBLEM.replace("[0.001, 0.009]", "[0.009, 0.001]"))
    assert cli.main(["design", str(problem)]) == 2
    assert capsys.readouterr().err.startswith(
        "vsr-jax: free['actuators[0].routing.y']: got [0.009, 0.001], need the least value first"
    )
