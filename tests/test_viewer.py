"""The live view without a browser: the session behind it, what is drawn, playback, the command."""

import contextlib
import pathlib
import re
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import vsr_jax as vsr
from vsr_jax.cli import main as cli, view_commands
from vsr_jax.files.scene_file import parse_scene
from vsr_jax.models.base import Status
from vsr_jax.viewer import coloring, mesh, playback
from vsr_jax.viewer.description import shape_of
from vsr_jax.viewer.session import Session
from vsr_jax.viewer.sliders import input_sliders, number_sliders
from vsr_jax.viewer.worker import Worker
from vsr_jax.viz.annotate import Row

SOFT = vsr.Material(young=5.93e5, shear=2.00e5)
MODEL = vsr.StrainDependent(6)
RADIUS, LENGTH = 0.01, 0.3
HELIX = str(pathlib.Path(__file__).parents[1] / "notebooks" / "scenes" / "helix.toml")


def bare():
    rod = vsr.Rod(LENGTH, vsr.Circular(RADIUS), SOFT)
    return vsr.Scene(rod, [vsr.Tendon(vsr.Helix(0.005, pitch=0.4)), vsr.Tendon(_along(0.004, 0))])


def loaded():
    """Three tendons and a tip force."""
    rod = vsr.Rod(LENGTH, vsr.Circular(RADIUS), SOFT)
    angles = 2 * np.pi / 3 * np.arange(3)
    tendons = [vsr.Tendon(_along(0.007 * np.cos(a), 0.007 * np.sin(a))) for a in angles]
    return vsr.Scene(rod, tendons, [vsr.TipWrench(force=(0.0, 0.0, -0.05))])


def _along(y, z):
    return vsr.Parallel(y, z)


@contextlib.contextmanager
def traces():
    """Context that counts the programs which JAX traces."""
    seen = []

    def listen(name, seconds, **more):
        if name.endswith("jaxpr_trace_duration"):
            seen.append(name)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield seen
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


@pytest.fixture(scope="module", params=[bare, loaded], ids=["bare", "loaded"])
def session(request):
    scene = request.param()
    numbers = {"rod.length": (0.2, 0.4), "rod.material.young": None}
    if scene.loads:
        numbers["loads[0].force[2]"] = (-0.1, 0.1)
    inputs = [2.0, 1.0, 0.5][: len(scene.actuators)]
    made = Session(scene, inputs, numbers=numbers, model=MODEL, title="an arm")
    made.solve()
    return made


def expected(session):
    """The equilibrium of the session's setting, by the public functions, from nothing."""
    inputs, numbers = session.answer.setting
    return vsr.solve(session.scene.replace(numbers), inputs, model=MODEL)


@pytest.mark.slow
def test_an_answer_is_what_solve_finds(session):
    session.move({"inputs[0]": 3.0, "rod.length": 0.32, "rod.material.young": 8e5})
    answer = session.move({"inputs[1]": 0.4})
    eq, shape = expected(session), answer.shape
    assert float(eq.scene.rod.length) == 0.32
    np.testing.assert_array_equal(eq.inputs[:2], [3.0, 0.4])
    assert answer.failure is None
    np.testing.assert_allclose(shape.tip, eq.tip[:3, 3], atol=1e-9)
    X = shape.body.samples.X
    np.testing.assert_allclose(shape.body.samples.position, eq.position(X), atol=1e-9)
    np.testing.assert_allclose(shape.body.samples.threads[0], eq.thread(0, X), atol=1e-9)
    np.testing.assert_allclose(shape.body.tension, eq.inputs, atol=1e-12)
    np.testing.assert_allclose(shape.margin, eq.stability, atol=1e-6)


def test_moved_sliders_compile_nothing(session):
    session.solve()  # from a shape near by
    values = {x.name: session.value(x) for x in session.sliders}
    session.move({name: value + 0.02 * abs(value) for name, value in values.items()})
    with traces() as seen:
        for name, value in values.items():
            session.move({name: value + 0.01 * abs(value)})
            assert session.answer.failure is None
        session.move(values)
    assert seen == []


@pytest.mark.slow
def test_only_the_first_drag_compiles(session):
    said = []
    session.solve()
    session.compiling = said.append
    session.drag(session.answer.shape.tip + 1e-3)
    assert said == ["the drag of the tip", ""]
    with traces() as seen:
        session.drag(session.answer.shape.tip - 1e-3)
        session.move({"inputs[0]": 1.1})
    assert seen == []


@pytest.mark.slow
def test_a_dragged_tip_is_reached_with_the_least_change_of_inputs():
    session = Session(loaded(), [2.0, 1.0, 1.5], bounds=(0.0, 6.0), model=MODEL)
    start = session.solve()
    target = start.shape.tip + np.array([-0.002, 0.01, 0.01])
    answer = session.drag(target)
    np.testing.assert_allclose(answer.shape.tip, target, atol=1e-4 * LENGTH)
    assert answer.note == ""
    np.testing.assert_allclose(expected(session).tip[:3, 3], answer.shape.tip, atol=1e-9)
    free = vsr.reach(session.scene, target, (0.0, 6.0), model=MODEL)
    change = [
        np.linalg.norm(np.asarray(u) - start.setting.inputs)
        for u in (answer.setting.inputs, free.inputs)
    ]
    assert change[0] <= change[1] * (1 + 1e-9)  # the other search may find the same inputs

    away = session.drag(np.array([0.1, 0.3, 0.0]))
    assert re.fullmatch(r"out of reach, the tip is [\d.]+ mm away", away.note)
    assert np.all((away.setting.inputs >= 0) & (away.setting.inputs <= 6))
    assert away.failure is None


def test_a_collapsed_arm_says_so_and_keeps_its_last_shape():
    session = Session(bare(), [1.0, 1.0], bounds=(0.0, 1e4), model=MODEL)
    good = session.solve()
    failed = session.move({"inputs[1]": 1e4})
    assert failed.failure == Status.COLLAPSED.message
    assert failed.shape is good.shape
    np.testing.assert_array_equal(failed.setting.inputs, [1.0, 1e4])
    again = session.move({"inputs[1]": 1.2})
    assert again.failure is None
    np.testing.assert_allclose(again.shape.tip, expected(session).tip[:3, 3], atol=1e-9)


@pytest.mark.slow
def test_without_an_equilibrium_at_the_start_the_arm_at_rest_is_shown():
    session = Session(loaded(), [1e4, 0.0, 0.0], bounds=(0.0, 1e5), model=MODEL)
    answer = session.solve()
    assert answer.failure == vsr.solve(loaded(), [1e4, 0.0, 0.0], model=MODEL).message
    np.testing.assert_allclose(answer.shape.tip, [LENGTH, 0, 0], atol=1e-12)
    assert session.drag(np.array([0.2, 0.1, 0.0])) is answer
    assert session.move({"inputs[0]": 1.0}).failure is None


def test_numbers_that_no_scene_may_have_are_a_failure_in_words():
    name = "actuators[0].routing.radius"
    session = Session(bare(), [1.0, 1.0], numbers={name: (0.001, 0.02)}, model=MODEL)
    good = session.solve()
    failed = session.move({name: 0.015})
    assert "0.005 m outside the section" in failed.failure
    assert failed.shape is good.shape


def test_the_saved_scene_is_the_one_that_is_shown(session):
    session.move({"inputs[0]": 1.25, "rod.length": 0.29})
    saved = parse_scene(session.toml())
    assert saved.title == "an arm"
    np.testing.assert_array_equal(saved.inputs, session.answer.setting.inputs)
    eq = vsr.solve(saved.scene, saved.inputs, model=MODEL)
    np.testing.assert_allclose(eq.tip[:3, 3], session.answer.shape.tip, atol=1e-9)


@pytest.mark.slow
def test_single_precision_stays_single():
    session = Session(bare().astype("float32"), jnp.ones(2, "float32"), model=MODEL)
    assert session.solve().shape.equilibrium.tip.dtype == np.float32
    assert session.move({"inputs[0]": 1.5}).shape.equilibrium.tip.dtype == np.float32


@pytest.mark.slow
def test_default_ranges_of_inputs():
    chamber = vsr.Chamber(_along(0.006, 0.0), 2e-5)
    length = vsr.Tendon(_along(0.0, 0.006), control="length")
    tendons = [vsr.Tendon(_along(0.006, 0.0)), vsr.Tendon(_along(-0.006, 0.0))]
    scene = vsr.Scene(bare().rod, [*tendons, vsr.Thread(_along(0, 0.006)), chamber, length])
    used = input_sliders(scene, np.array([3.0, 0.0, -5.0, 2e4, -0.01]))
    assert [(s.low, s.high) for s in used] == [(0, 6), (0, 6), (-10, 0), (0, 4e4), (-0.02, 0)]
    assert [s.name for s in used] == [f"inputs[{i}]" for i in range(5)]
    assert [s.unit for s in used] == ["N", "N", "N", "Pa", "m"]
    idle = input_sliders(scene, np.zeros(5))
    assert [s.low < 0 for s in idle] == [False, False, True, True, True]
    ends = [idle[0].high, idle[1].high, idle[2].low, idle[3].high, idle[4].low]
    for i, end in enumerate(ends):
        alone = vsr.Scene(scene.rod, [scene.actuators[i]])
        eq = vsr.solve(alone, [end], model=MODEL)
        assert 1.5 < np.arccos(np.clip(eq.tip[0, 0], -1, 1)) < 2.5  # 2 rad wanted


def test_default_ranges_of_numbers():
    rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(6e5, poisson=0.45))
    helix = vsr.Helix(0.006, angle=1.5)
    scene = vsr.Scene(rod, [vsr.Tendon(helix)], [vsr.TipWrench(force=(0.0, 0.0, -0.05))])
    names = ["rod.length", "rod.material.poisson", "actuators[*].routing.radius", "loads[0].force"]
    names += ["actuators[0].routing.phase", "rod.rest_strain[1]", "loads[0].moment[1]"]
    found = {s.name: s for s in number_sliders(scene, names)}
    ends = {name: (s.low, s.high) for name, s in found.items()}
    assert ends["rod.length"] == (0.15, 0.6)
    assert ends["rod.material.poisson"][0] == 0.225
    assert ends["rod.material.poisson"][1] == pytest.approx(0.5, abs=2e-3)
    assert ends["actuators[0].routing.radius"][1] == pytest.approx(0.01, abs=5e-5)
    assert [ends[f"loads[0].force[{i}]"] for i in range(3)] == [(-0.1, 0.1)] * 3
    assert ends["actuators[0].routing.phase"] == (-np.pi, np.pi)
    assert ends["rod.rest_strain[1]"] == pytest.approx((-np.pi / 0.3, np.pi / 0.3), rel=0.1)
    assert found["loads[0].moment[1]"].unit == "N m"
    assert ends["loads[0].moment[1]"][1] > 0
    for name, slider in found.items():
        for end in ends[name]:
            array = np.array(vsr.parameters(scene)[slider.of].value)
            array[slider.place] = end
            scene.replace(slider.of, array)  # a scene may have it


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"numbers": ["rod.lenght"]}, "rod.lenght: the scene has no such number; did you mean"),
        ({"numbers": {"rod.length": (0.4, 0.5)}}, "rod.length: got the range 0.4 to 0.5, need one"),
        ({"numbers": {"rod.length": (0.4,)}}, r"numbers\['rod.length'\]: got shape \(1,\)"),
        ({"numbers": [3]}, "numbers: got 3, need names"),
        ({"numbers": "rod.rest_strain[4]"}, "need a pair, the least and the greatest value"),
        ({"bounds": (2.0, 3.0)}, r"inputs\[0\]: got the range 2 to 3, need one that contains"),
        ({"bounds": (-1.0, 3.0)}, r"inputs\[0\]: got -1, need a finite number >= 0"),
        ({"inputs": [1.0]}, r"inputs: got shape \(1,\), need \(2,\)"),
        ({"model": "Continuum"}, "model: got 'Continuum'"),
    ],
)
def test_wrong_arguments(options, message, unchecked):
    with pytest.raises(ValueError, match=message):
        Session(bare(), **{"inputs": [1.0, 1.0]} | options)


def test_a_matrix_has_no_slider():
    rod = vsr.Rod(0.3, vsr.Circular(0.01), SOFT, base=vsr.pose(pointing="down"))
    with pytest.raises(ValueError, match="an entry of a matrix"):
        Session(vsr.Scene(rod), [], numbers=["rod.base"])


def test_sliders_are_shown_with_a_prefix():
    rod = vsr.Rod(0.3, vsr.Circular(0.0007), vsr.Material(54e9, poisson=0.3))
    scene = vsr.Scene(rod)
    names = ["rod.length", "rod.section.radius", "rod.material.young", "rod.material.poisson"]
    shown = [slider.shown_unit for slider in number_sliders(scene, names)]
    assert shown == [(1e-3, "mm"), (1e-3, "mm"), (1e9, "GPa"), (1.0, "-")]
    radius = number_sliders(scene, names)[1]
    assert radius.in_si(0.7) == 0.0007


@pytest.mark.slow
def test_strain_and_stress_of_the_wall_in_closed_form():
    r"""Moment M: $\epsilon = M z / EI$; torque: $\sqrt 3 M r / J$; force along the arm: F / A."""
    rod = vsr.Rod(LENGTH, vsr.Circular(RADIUS), SOFT)
    inertia, area = np.pi * RADIUS**4 / 4, np.pi * RADIUS**2
    force, moment = 0.2, 1e-3

    def shape(**wrench):
        scene = vsr.Scene(rod, [], [vsr.TipWrench(frame="body", **wrench)])
        return shape_of(vsr.solve(scene, [], model=MODEL))

    angle = np.linspace(0, 2 * np.pi, 25)
    bent = shape(moment=(0.0, moment, 0.0))
    strain = moment * RADIUS * np.sin(angle) / (5.93e5 * inertia)
    np.testing.assert_allclose(bent.strain, np.tile(strain, (61, 1)), atol=1e-9)
    np.testing.assert_allclose(bent.stress, 5.93e5 * np.abs(bent.strain), rtol=1e-9, atol=1e-3)
    twisted = shape(moment=(moment, 0.0, 0.0))
    np.testing.assert_allclose(twisted.strain, 0, atol=1e-9)
    np.testing.assert_allclose(
        twisted.stress, np.sqrt(3) * moment * RADIUS / (2 * inertia), rtol=1e-6
    )
    pulled = shape(force=(force, 0.0, 0.0))
    np.testing.assert_allclose(pulled.stress, force / area, rtol=1e-6)
    np.testing.assert_allclose(pulled.strain, force / (5.93e5 * area), rtol=1e-6)


def test_the_tube_is_closed_and_its_faces_look_outward():
    shape = shape_of(vsr.solve(bare(), [2.0, 1.0], model=MODEL))
    tube = mesh.tube(shape.body.samples.wall)
    body = trimesh.Trimesh(*tube, process=False)
    assert body.is_watertight
    polygon = 24 / 2 * np.sin(2 * np.pi / 24) * RADIUS**2
    along = np.trapezoid(shape.body.samples.strain[:, 3], shape.body.samples.X)
    assert body.volume == pytest.approx(polygon * along, rel=0.01)
    level = np.arange(len(tube.triangles)) % 7
    parts = mesh.bands(tube, level, 7)
    areas = [trimesh.Trimesh(*part, process=False).area for part in parts]
    assert sum(areas) == pytest.approx(body.area)


@pytest.mark.slow
def test_the_wall_of_a_rigid_piece_is_apart():
    rod = bare().rod
    held = vsr.Rod(rod.length, rod.section, rod.material, rigid=vsr.RigidPiece(0.153))
    shape = shape_of(vsr.solve(vsr.Scene(held, vsr.Tendon(_along(0.005, 0.0))), [2.0], model=MODEL))
    X, rings = shape.body.samples.X, shape.body.samples.wall
    np.testing.assert_array_equal(shape.body.rigid, X[1:] > 0.153)
    tube = mesh.tube(rings)
    rigid = mesh.tube_parts(shape.body.rigid, rings.shape[1])
    assert rigid.shape == tube.triangles.shape[:1]
    bends, stiff = mesh.bands(tube, rigid.astype(int), 2)
    first = np.searchsorted(X, 0.153)
    np.testing.assert_allclose(X[first], 0.153, rtol=1e-12)
    drawn = np.unique(stiff.vertices, axis=0)
    tip = rings[-1, :-1].mean(axis=0)
    there = np.unique(np.concatenate([rings[first:, :-1].reshape(-1, 3), tip[None]]), axis=0)
    np.testing.assert_allclose(drawn, there, atol=1e-15)
    assert len(bends.triangles) + len(stiff.triangles) == len(tube.triangles)
    assert not np.any(shape.strain[first:])


@pytest.mark.slow
def test_threads_end_where_they_are_tied_and_slack_ones_are_dashed():
    scene = vsr.Scene(
        bare().rod,
        [vsr.Tendon(_along(0.005, 0.0), end=0.15), vsr.Tendon(_along(-0.005, 0.0))],
    )
    shape = shape_of(vsr.solve(scene, [1.0, 0.0], model=MODEL))
    points, thread = mesh.segments(shape.body.samples.threads, shape.body.slack)
    assert np.all(np.isfinite(points))
    assert np.sum(thread == 0) == pytest.approx(30, abs=1)
    assert np.sum(thread == 1) == 30  # every other one of 60


def test_arrows_keep_their_scale():
    def row(force):
        return Row("tip wrench", "N", np.zeros((1, 3)), np.array([[0.0, 0.0, force]]))

    scale = mesh.ArrowScale()
    for force, length in ((0.2, 0.16), (0.4, 0.32), (0.1, 0.08), (1.0, 0.4), (0.5, 0.2)):
        (arrow,) = scale.arrows([row(force)], 1.0)
        np.testing.assert_allclose(arrow, [[[0, 0, 0], [0, 0, length]]], atol=1e-12)


def test_scales_of_colours_are_round_and_follow_slowly():
    scale = coloring.Scale(coloring.COLORINGS["strain"])
    for greatest, high in ((0.025, 0.03), (-0.03, 0.03), (0.07, 0.08), (0.05, 0.08), (0.019, 0.02)):
        scale.cover(np.array([0.0, greatest]))
        assert scale.high == pytest.approx(high)
        assert scale.low == -scale.high
    levels = scale.levels(np.linspace(-0.02, 0.02, 101))
    assert levels[0] == 0
    assert levels[-1] == coloring.BANDS - 1
    assert np.all(np.diff(levels) >= 0)
    red, _, blue = scale.colors()[[0, -1]].T
    assert red[0] < red[1]
    assert blue[0] > blue[1]
    assert "0.02 long" in scale.html()
    stress = coloring.Scale(coloring.COLORINGS["stress"])
    stress.cover(np.array([3.1e4]))
    assert (stress.low, stress.high) == (0.0, 4e4)
    assert "40 kPa" in stress.html()
    tension = coloring.Scale(coloring.COLORINGS["tension"])
    tension.cover(np.zeros(2))
    assert set(tension.levels(np.zeros(2))) == {coloring.BANDS // 2}


def test_chambers_are_coloured_by_pressure_and_other_threads_by_tension():
    at = vsr.Parallel(0.0, 0.005)
    tendon, chamber = vsr.Tendon(at), vsr.Chamber(at, area=2e-5)
    rod = vsr.Rod(LENGTH, vsr.Circular(RADIUS), SOFT)
    for actuators, more in (
        ([tendon], {"tension"}),
        ([chamber], {"pressure"}),
        ([tendon, chamber], {"tension", "pressure"}),
        ([], set()),
    ):
        scene = vsr.Scene(rod, actuators)
        assert set(coloring.colorings_of(scene)) == {"strain", "stress"} | more
    pressure = coloring.Scale(coloring.COLORINGS["pressure"])
    pressure.cover(np.array([np.nan, 4e4]))
    assert "40 kPa pushes" in pressure.html()
    assert np.argmax(pressure.colors()[-1]) == 2  # blue, as of a thread that pushes


def test_a_sweep_is_solved_frame_by_frame(session):
    session.move({"inputs[0]": 1.0, "rod.length": 0.3})
    slider = session.sliders[0]
    track = playback.sweep_of(session, slider)
    answer = track.show(session, len(track.frames) - 1)
    assert answer.setting.inputs[0] == slider.high
    np.testing.assert_allclose(answer.shape.tip, expected(session).tip[:3, 3], atol=1e-8)


def test_rows_of_inputs_are_played(session):
    rows = np.array([[1.0, 0.5, 0.2], [2.0, 0.5, 0.1]])[:, : len(session.scene.actuators)]
    (track,) = playback.tracks_of(session, rows)
    track.show(session, 1)
    np.testing.assert_array_equal(session.answer.setting.inputs, rows[1])
    for play, message in ((rows[0], "need .samples, "), (-rows, "need a finite number >= 0")):
        with pytest.raises(ValueError, match=message):
            playback.tracks_of(session, play)
    with pytest.raises(ValueError, match="need one batch axis"):
        playback.tracks_of(session, vsr.solve(session.scene, rows[0], model=MODEL))


@pytest.mark.slow
def test_a_path_with_friction_is_played_with_its_memory():
    tendon = vsr.Tendon(vsr.Helix(0.005, pitch=0.3), friction=0.3)
    session = Session(vsr.Scene(bare().rod, [tendon]), [2.0], bounds=(0.0, 3.0), model=MODEL)
    session.solve()
    track = playback.path_of(session, session.sliders[0])
    there, back = 20, 2 * playback.FRAMES - 1 - 20
    tips = []
    for i in (there, back):
        answer = track.show(session, i)
        assert answer.setting.inputs[0] == pytest.approx(1.0)
        tips.append(answer.shape.tip)
    way = np.linspace(0, 3, playback.FRAMES)
    path = vsr.follow(session.scene, np.concatenate([way, way[::-1]])[:, None], model=MODEL)
    known = jax.vmap(lambda eq: eq.tip[:3, 3])(path)
    np.testing.assert_allclose(tips, known[jnp.array([there, back])], atol=1e-9)
    assert np.linalg.norm(tips[0] - tips[1]) > 1e-3
    (given,) = playback.tracks_of(session, path)
    np.testing.assert_allclose(given.show(session, there).shape.tip, tips[0], atol=1e-9)


@pytest.mark.slow
def test_the_steps_of_a_design_are_played():
    """Each frame has the objective that the history has there."""
    scene = vsr.Scene(bare().rod, [vsr.Tendon(vsr.Helix(0.005, angle=1.45))])
    target = jnp.array([[0.26, 0.02, 0.09]])
    found = vsr.design(
        scene,
        {"actuators[0].routing.radius": (0.002, 0.009), "inputs": (0.5, 6.0)},
        vsr.objective.TipError(target),
        [[2.0]],
        model=MODEL,
        search=vsr.Search(starts=2, steps=30, candidates=2),
        progress=False,
    )
    assert {name: x.shape for name, x in found.history.numbers.items()} == {
        "actuators[0].routing.radius": (30, 2),
        "inputs": (30, 2, 1, 1),
    }
    session = Session(scene, [2.0], model=MODEL)
    (track,) = playback.tracks_of(session, found)
    assert len(track.frames) == 31
    for i in (0, 7, 29):
        tip = track.show(session, i).shape.tip
        off = np.sum((tip - target[0]) ** 2) / LENGTH**2
        assert off == pytest.approx(found.history.objective[i, found.best], rel=1e-6)
    last = track.show(session, 30)
    assert last.setting.inputs == pytest.approx(np.asarray(found.inputs[0]))
    eq = vsr.solve(found.scene, found.inputs[0], model=MODEL)
    np.testing.assert_allclose(last.shape.tip, eq.tip[:3, 3], atol=1e-9)


def test_a_job_that_waits_is_replaced_by_a_newer_one_of_its_kind():
    worker, gate, done = Worker(), threading.Event(), []
    worker.post("slow", gate.wait)
    waiting = [worker.post("move", lambda i=i: done.append(i)) for i in range(5)]
    other = worker.post("frame", lambda: done.append("frame"))
    gate.set()
    for event in (*waiting, other):
        assert event.wait(10)
    assert done == [4, "frame"]
    worker.close()


def test_a_missing_library_is_one_line(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    text = 'view: viser is not installed, need pip install "vsr-jax[viewer]"'
    with pytest.raises(ImportError, match=re.escape(text)):
        vsr.view(bare())
    assert cli.main(["view", HELIX]) == 2
    assert capsys.readouterr().err == f"vsr-jax: {text}\n"


def test_the_command_passes_its_arguments(tmp_path, monkeypatch):
    pytest.importorskip("viser")
    rows, called = tmp_path / "rows.csv", {}
    rows.write_text("-1\n-2\n")
    monkeypatch.setattr(
        "vsr_jax.viewer.page.view", lambda *given, **options: called.update(options, given=given)
    )
    text = "--number rod.length 0.5 0.9 --number rod.material.young --inputs -3 --low -6 --high 1"
    text += f" --play {rows} --theme dark --port 8090 --host 0.0.0.0 --no-browser --steps 9"
    assert cli.main(["view", HELIX, *text.split()]) == 0
    scene, inputs = called.pop("given")
    assert float(scene.rod.length) == 0.75
    np.testing.assert_array_equal(inputs, [-3.0])
    np.testing.assert_array_equal(np.ravel(called.pop("bounds")), [-6.0, 1.0])
    np.testing.assert_array_equal(called.pop("play"), [[-1.0], [-2.0]])
    assert called == {
        "numbers": {"rod.length": [0.5, 0.9], "rod.material.young": None},
        "model": vsr.StrainDependent(9),
        "title": "One helical thread (case B1 of the paper)",
        "theme": "dark",
        "host": "0.0.0.0",
        "port": 8090,
        "browser": False,
        "block": True,
    }


def test_the_command_starts_at_rest_without_inputs(tmp_path, monkeypatch):
    pytest.importorskip("viser")
    path, called = tmp_path / "arm.toml", []
    path.write_text(re.sub("inputs = .*", "", pathlib.Path(HELIX).read_text()))
    monkeypatch.setattr("vsr_jax.viewer.page.view", lambda *given, **options: called.extend(given))
    assert cli.main(["view", str(path)]) == 0
    np.testing.assert_array_equal(called[1], [0.0])


def test_errors_of_the_command_are_one_line(tmp_path, capsys):
    pytest.importorskip("viser")
    bad = tmp_path / "rows.csv"
    bad.write_text("1, two\n")
    for arguments, message in (
        (["--number", "rod.length", "1"], "--number: got rod.length 1, need a name, or a name and"),
        (["--number", "rod.lenght"], "rod.lenght: the scene has no such number; did you mean"),
        (["--play", "nowhere.csv"], "nowhere.csv: "),
        (["--play", str(bad)], f"{bad}: "),
    ):
        assert cli.main(["view", HELIX, "--no-browser", *arguments]) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"vsr-jax: {message}")
        assert error.count("\n") == 1


def test_rows_of_a_file_with_one_column(tmp_path):
    file = tmp_path / "rows.csv"
    file.write_text("1\n2\n3\n")
    assert view_commands.rows_of(str(file)).shape == (3, 1)
