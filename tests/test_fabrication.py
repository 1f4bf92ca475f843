"""Drilling plans, lengths, walls and channels against closed forms, and errors in one line."""

import re
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

import vsr_jax as vsr
from vsr_jax.fabrication.stations import stations_of

SOFT = vsr.Material(young=5.93e5, shear=2.00e5)
PITCH, RADIUS = 0.1, 0.006


def arc():
    """A twisted arc at rest."""
    rod = vsr.Rod(0.2, vsr.Circular(0.008), SOFT, rest_strain=(0.5, 1.0, 6.0, 1.0, 0.0, 0.0))
    return vsr.Scene(rod, [vsr.Tendon(vsr.Parallel(0.005, 0.001))])


@pytest.mark.slow
def test_drilling_plan_and_lengths():
    """The closed forms of a helix and of an oblique line."""
    discs, helix = [0.0, 0.02, 0.21, 0.3], vsr.Helix(RADIUS, pitch=PITCH)
    chamber = vsr.Chamber(vsr.Parallel(0.0, 0.0), np.pi / 4 * 1.2e-3**2, end=0.2)
    oblique = vsr.Tendon(vsr.Linear(-0.009, 0.0, 0.004, 0.0))
    rod = vsr.Rod(0.3, vsr.Circular(0.012), SOFT)
    scene = vsr.Scene(rod, [vsr.Tendon(helix), chamber, oblique])
    made = vsr.export(scene, discs=discs, bore=[None, None, 2e-3])
    assert made.bores.tolist() == pytest.approx([1e-3, 1.2e-3, 2e-3], rel=1e-4)
    plan = {
        (row[0], row[2]): dict(zip(made.holes.columns, row, strict=True)) for row in made.holes.rows
    }
    # the chamber ends at 0.2 m
    assert set(plan) == {(d, t) for d in range(4) for t in range(3)} - {(2, 1), (3, 1)}
    for (disc, thread), row in plan.items():
        assert row["X [mm]"] == pytest.approx(1e3 * discs[disc])
        if thread == 0:
            assert row["angle [deg]"] == pytest.approx(360 * discs[disc] / PITCH % 360, abs=1e-4)
            assert row["radius [mm]"] == pytest.approx(1e3 * RADIUS, abs=1e-4)
            tilt = np.degrees(np.arctan(2 * np.pi * RADIUS / PITCH))
            assert row["tilt [deg]"] == pytest.approx(tilt, abs=1e-4)
        if thread == 2:
            assert row["y [mm]"] == pytest.approx(1e3 * (0.004 * discs[disc] - 0.009), abs=1e-4)
            assert row["angle [deg]"] == pytest.approx(180)
            assert row["bore [mm]"] == pytest.approx(2)
    assert made.lengths.column("part") == ["cable", "tube", "cable"]
    expected = 300 * np.hypot(1, 2 * np.pi * RADIUS / PITCH), 200, 300 * np.hypot(1, 0.004)
    assert made.lengths.column("at rest [mm]") == pytest.approx(expected, abs=1e-4)
    assert made.lengths.column("to X [mm]") == pytest.approx((300, 200, 300))
    assert made.lengths.column("runs") == ["in a channel"] * 3
    assert "thinnest: the wall" in str(made)


def two_sections(thickness=None):
    """Three cables to the middle through ten discs, and three to the tip through all."""
    places = [*np.arange(1, 11) * 0.01, 0.12, 0.16, 0.19, 0.2]
    discs = vsr.Discs(places=places, radius=0.009, thickness=thickness)
    rod = vsr.Rod(0.2, vsr.Circular(5e-4), SOFT, discs=discs)
    ways = [(8e-3 * np.cos(a), 8e-3 * np.sin(a)) for a in np.arange(6) * np.pi / 3]
    paths = [vsr.Parallel(*way) for way in ways]
    inner = [vsr.Tendon(path, end=0.1, straight=True) for path in paths[::2]]
    return vsr.Scene(rod, [*inner, *(vsr.Tendon(path, straight=True) for path in paths[1::2])])


@pytest.mark.slow
def test_the_discs_of_the_tendons_are_drilled():
    made = vsr.export(two_sections())
    every = dict.fromkeys(made.holes.column("X [mm]"))
    expected = [*np.arange(11) * 10.0, 120, 160, 190, 200]
    np.testing.assert_allclose(list(every), expected, atol=1e-4)
    threads = [row[2] for row in made.holes.rows if row[0] == 11]
    assert threads == [3, 4, 5]  # beyond the others


@pytest.mark.slow
def test_the_body_of_a_robot_has_its_discs_and_their_holes(tmp_path):
    """The STL file cut in, before and behind each disc, within 0.01 mm of what is declared."""
    path, thickness, bore = tmp_path / "robot.stl", 2e-3, 1e-3
    scene = two_sections(thickness)
    made = vsr.export(scene, stl=path, bore=bore)
    mesh = trimesh.load(path)
    assert mesh.is_watertight

    def rings(X):
        """Centre (y, z) and radius [mm] of each outline at X [mm]."""
        cut = mesh.section(plane_origin=[X, 0, 0], plane_normal=[1, 0, 0])
        outlines = [cut.vertices[entity.points[1:], 1:] for entity in cut.entities]
        middles = [0.5 * (points.max(axis=0) + points.min(axis=0)) for points in outlines]
        return {
            tuple(np.round(middle, 1) + 0.0): (
                middle,
                np.mean(np.linalg.norm(points - middle, axis=1)),
            )
            for middle, points in zip(middles, outlines, strict=True)
        }

    for X in 1e3 * np.asarray(scene.rod.discs.along(scene.rod.length)):
        for outside in (X - 2.01, *([X + 0.01] if X < 199 else [])):
            ((middle, radius),) = rings(outside).values()
            np.testing.assert_allclose((*middle, radius), (0, 0, 0.5), atol=0.01)
        for inside in (X - 1.99, X - 0.01):
            found = rings(inside)
            np.testing.assert_allclose(found.pop((0.0, 0.0))[1], 9.0, atol=0.01)
            drilled = [row for row in made.holes.rows if abs(row[1] - X) < 1e-3]
            places = [tuple(np.round(row[5:7], 1) + 0.0) for row in drilled]
            assert sorted(found) == sorted(places)
            for row, place in zip(drilled, places, strict=True):
                np.testing.assert_allclose(found[place][0], row[5:7], atol=0.01)
                np.testing.assert_allclose(found[place][1], 1e3 * bore / 2, atol=0.01)


def crossing(start=0.002):
    """Two threads that approach each other towards the tip, on an arm whose wall approaches
    one."""
    rod = vsr.Rod(0.1, vsr.Circular(vsr.Taper(0.010, 0.0066)), SOFT)
    still = vsr.Tendon(vsr.Parallel(0.0055, 0.0))
    return vsr.Scene(rod, [still, vsr.Tendon(vsr.Linear(start, 0.0, 0.015, 0.0))])


@pytest.mark.slow
def test_thin_walls_are_named():
    with pytest.warns(UserWarning, match="the wall") as told:
        made = vsr.export(crossing(), bore=1e-3, wall=1.2e-3)
    sentences = [str(warning.message) for warning in told]
    assert sentences == list(made.warnings)
    assert all("\n" not in sentence for sentence in sentences)
    assert sentences[0] == (
        "the wall between the channel of thread 0 and the outside is 0.599 mm at X = 0.1 m, less "
        "than 1.2 mm"
    )
    assert re.fullmatch(
        r"the wall between the channel of thread 0 and the channel of thread 1 is 1 mm at "
        r"X = 0\.1 m, less than 1\.2 mm",
        sentences[1],
    )
    assert len(sentences) == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert vsr.export(crossing(), bore=1e-3, wall=5e-4).warnings == ()


def test_walls_between_helices_are_measured_across_them():
    """Two helices of slope 1 a quarter turn apart: their least distance is shorter than that in the
    section."""
    rod = vsr.Rod(0.1, vsr.Circular(0.012), SOFT)
    paths = [vsr.Helix(0.008, pitch=2 * np.pi * 0.008, phase=phase) for phase in (0.0, 0.8)]
    found = vsr.export(vsr.Scene(rod, [vsr.Tendon(path) for path in paths]), bore=1e-3).walls
    shift = np.linspace(-2, 2, 100_001)
    distance = 0.008 * np.sqrt(2 - 2 * np.cos(0.8 + shift) + shift**2)
    thickness = next(wall.thickness for wall in found if "thread 1" in wall.other)
    np.testing.assert_allclose(thickness, distance.min() - 1e-3, atol=2e-5)
    assert distance.min() < 0.75 * distance[50_000]


def steep(pitch):
    """A helical thread of the given pitch."""
    rod = vsr.Rod(0.1, vsr.Circular(0.012), SOFT)
    return vsr.Scene(rod, [vsr.Tendon(vsr.Helix(0.008, pitch=pitch))])


def test_oblique_channels_are_round():
    """A helix of 60 degrees: every corner of its channel is at the radius of the bore from it."""
    pitch, bore = 2 * np.pi * 0.008 / np.tan(np.pi / 3), 2e-3
    made = vsr.export(steep(pitch), bore=bore)
    points = made.body().vertices
    X = np.linspace(-0.01, 0.11, 400_001)
    turn = 2 * np.pi * X / pitch
    helix = 1e3 * np.stack((X, 0.008 * np.cos(turn), 0.008 * np.sin(turn)), axis=-1)
    wall = (np.hypot(*points[:, 1:].T) < 11.5) & (points[:, 0] > 2) & (points[:, 0] < 98)
    far, _ = KDTree(helix).query(points[wall])
    assert far.size > 1000
    # 32 corners of the area of the circle, 0.3 % outside of it
    np.testing.assert_allclose(far, 1e3 * bore / 2, atol=5e-3)


@pytest.mark.slow
def test_threads_in_the_open_have_no_channel():
    """On discs outside a tube, and in its lumen."""
    section = vsr.Annular(0.004, 0.0037)
    rod = vsr.Rod(0.1, section, SOFT, discs=vsr.Discs(10, radius=0.006))  # a thin wall
    paths = [vsr.Parallel(0.0, 0.005), vsr.Parallel(0.001, 0.0)]
    made = vsr.export(vsr.Scene(rod, [vsr.Tendon(path) for path in paths]))
    area = float(section.geometry(jnp.asarray(0.05), rod.length).area)
    np.testing.assert_allclose(made.body().volume, 1e9 * area * 0.1, rtol=2e-3)
    assert made.lengths.column("runs") == ["in the open"] * 2
    assert made.walls == ()
    assert made.holes.column("radius [mm]")[:2] == [5.0, 1.0]


@pytest.mark.slow
def test_stations_meet_the_tolerance():
    """Chords of an arc and of a helix: the sagitta is h^2 kappa / 8."""
    scene = arc()
    eq = vsr.solve(vsr.Scene(scene.rod), [])
    numbers = []
    for tolerance in (1e-4, 1e-5):
        found = stations_of(eq, scene, tolerance)
        numbers.append(found.X.size)
        middle = 0.5 * (found.X[1:] + found.X[:-1])
        chord = 0.5 * (found.pose[1:, :3, 3] + found.pose[:-1, :3, 3])
        far = np.linalg.norm(np.asarray(eq.position(middle)) - chord, axis=1)
        assert far.max() < 1.02 * tolerance
    assert 1.5 < numbers[1] / numbers[0] < 4


def test_sharp_bends_are_told():
    rod = vsr.Rod(0.1, vsr.Circular(0.010), SOFT, rest_strain=(0, 0, 120.0, 1, 0, 0))
    with pytest.warns(UserWarning, match="sections cross each other at X = 0 m"):
        vsr.export(vsr.Scene(rod))


def broken():
    """A path that is NaN between two abscissas at which a scene checks its paths."""
    return vsr.Function(lambda X: (jnp.where((X > 0.1035) & (X < 0.106), jnp.nan, 0.001), 0.0))


def _batch():
    return jax.tree.map(lambda leaf: jnp.stack((leaf, leaf)), vsr.solve(crossing(), [1.0, 0.0]))


BAD = {
    "arm": (lambda: vsr.export(3.0), r"arm: got 3\.0, need a Scene or an Equilibrium"),
    "batch": (lambda: vsr.export(_batch()), r"batch of shape \(2,\)"),
    "failed": (
        lambda: vsr.export(vsr.solve(crossing(), [1e9, 0.0])),
        "arm: got a solve that failed",
    ),
    "bore": (lambda: vsr.export(crossing(), bore=-1e-3), r"bore\[0\]: got -0.001, need .* > 0"),
    "bores": (lambda: vsr.export(crossing(), bore=[1e-3] * 3), "bore: got .* 2, one per actuator"),
    "wall": (lambda: vsr.export(crossing(), wall=0.0), "wall: got 0.0, need a finite number > 0"),
    "discs": (lambda: vsr.export(crossing(), discs=[0.0, 0.2]), "discs: got 0.2 m, need 0 to 0.1"),
    "one disc": (lambda: vsr.export(crossing(), discs=1), "discs: got 1, need an integer >= 2"),
    "tolerance": (
        lambda: vsr.export(crossing(), tolerance=0),
        "tolerance: got 0, need a finite number > 0",
    ),
    "fine": (
        lambda: vsr.export(arc(), tolerance=1e-14),
        "tolerance: got 1e-14 m, which needs more than 20000 stations",
    ),
    "meeting": (
        lambda: vsr.export(crossing(0.0045), bore=1e-3, stl="never.stl"),
        r"bore: got 1 mm, .* thread 0 and the channel of thread 1 is -1 mm at X = 0\.0",
    ),
    "coil": (
        lambda: vsr.export(steep(0.003), bore=1e-3, stl="never.stl"),
        "bore: got 1 mm for thread 0, which winds too steeply",
    ),
    "nan": (
        lambda: vsr.export(vsr.Scene(arc().rod, [vsr.Tendon(broken())])),
        r"arm: got a shape or a path that is NaN near X = 0\.1",
    ),
    "traced": (
        lambda: jax.jit(lambda s: vsr.export(s).bores)(crossing()),
        "arm: got traced numbers",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BAD)
@pytest.mark.usefixtures("unchecked")
@pytest.mark.filterwarnings("ignore:the wall")
def test_errors_have_one_line(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, message = BAD[name]
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("kind", "missing"), [("stl", "manifold3d"), ("dxf", "ezdxf")])
def test_a_missing_library_names_the_extra(kind, missing, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=rf'{missing} is not installed.*"vsr-jax\[fabrication\]"'):
        vsr.export(crossing(), **{kind: tmp_path / "arm"}, bore=1e-3)
    assert list(tmp_path.iterdir()) == []
