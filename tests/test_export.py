"""Files for the workshop: read back by other programs and compared with the scene."""

import contextlib
import csv
import io
import pathlib
import re
import runpy

import ezdxf
import jax
import jax.numpy as jnp
import manifold3d
import numpy as np
import pytest
import stl
import trimesh
from scipy.interpolate import BSpline
from scipy.sparse.csgraph import connected_components

import vsr_jax as vsr
from vsr_jax.cli import common as cli_common, main as cli

HELIX = str(pathlib.Path(__file__).parents[1] / "notebooks" / "scenes" / "helix.toml")
SOFT = vsr.Material(young=5.93e5, shear=2.00e5)
BORE = 1.2e-3
PITCH, RADIUS = 0.1, 0.006


def tapered():
    """A tapered disc: a helical tendon, a chamber that ends in the arm, an oblique tendon."""
    rod = vsr.Rod(0.3, vsr.Circular(vsr.Taper(0.012, 0.010)), SOFT)
    chamber = vsr.Chamber(vsr.Parallel(0.0, 0.0), np.pi / 4 * BORE**2, end=0.2)
    oblique = vsr.Tendon(vsr.Linear(-0.009, 0.0, 0.004, 0.0))
    return vsr.Scene(rod, [vsr.Tendon(vsr.Helix(RADIUS, pitch=PITCH)), chamber, oblique])


def tube():
    """A tube with three helical tendons."""
    rod = vsr.Rod(0.2, vsr.Annular(0.010, vsr.Taper(0.003, 0.004)), SOFT)
    phases = 2 * np.pi / 3 * np.arange(3)
    paths = [vsr.Helix(0.007, pitch=0.3, phase=phase, hand="left") for phase in phases]
    return vsr.Scene(rod, [vsr.Tendon(path) for path in paths])


def curved():
    """An ellipse along an arc."""
    section = vsr.Elliptic(0.008, vsr.Taper(0.006, 0.005))
    rod = vsr.Rod(0.2, section, SOFT, rest_strain=(0.5, 1.0, 6.0, 1.0, 0.0, 0.0))
    return vsr.Scene(rod, [vsr.Tendon(vsr.Parallel(0.005, 0.001))])


def stepped():
    """A tube, then a rectangle, which a channel ends on, then a disc that crosses it."""
    parts = [vsr.Annular(0.012, 0.004), vsr.Rectangular(0.012, 0.010), vsr.Circular(0.0055)]
    rod = vsr.Rod(0.3, vsr.Joined([0.1, 0.2], parts), SOFT)
    opened = vsr.Tendon(vsr.Parallel(0.009, 0.0), end=0.1)
    buried = vsr.Tendon(vsr.Parallel(0.0, 0.0), start=0.15, end=0.25)
    return vsr.Scene(rod, [opened, buried])


CASES = {"tapered": tapered, "bent": tube, "curved": curved, "stepped": stepped}
HANDLES = {"tapered": 2, "bent": 4, "curved": 1, "stepped": 0}
"""Holes through the body less cavities in it."""


def in_blocks(function, X):
    """A function of abscissas, called with 64 at a time."""
    blocks = np.split(np.pad(X, (0, -len(X) % 64), mode="edge"), -(-len(X) // 64))
    parts = [function(jnp.asarray(block)) for block in blocks]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(X)], *parts)


class Made:
    """A scene, its equilibrium at rest or bent, and its exported files."""

    def __init__(self, name, folder):
        self.name, self.scene = name, CASES[name]()
        bent = vsr.solve(self.scene, [0.8, 0.2, 0.0]) if name == "bent" else None
        self.eq = vsr.solve(vsr.Scene(self.scene.rod), []) if bent is None else bent
        arm = self.scene if bent is None else bent
        self.files = {kind: folder / f"arm.{kind}" for kind in ("stl", "step", "csv", "dxf")}
        self.made = vsr.export(arm, **self.files, bore=BORE)
        self.mesh = trimesh.load(self.files["stl"])
        self.length = float(self.scene.rod.length)

    def pose(self, X):
        """Poses at X [m], by the program that the export uses."""
        return in_blocks(self.eq.pose, X)

    def routing(self, i, X):
        """Position (y, z) [m] of thread i in the sections."""
        routing = jax.jit(jax.vmap(self.scene.actuators[i].routing))
        return np.stack(in_blocks(routing, X), axis=-1)

    def thread(self, i, X):
        """Where thread i crosses the sections at X [mm], by the scene's routing and the pose."""
        pose = self.pose(X)
        sideways = np.einsum("sij,sj->si", pose[:, :3, 1:3], self.routing(i, X))
        return 1e3 * (pose[:, :3, 3] + sideways)

    def areas(self, X):
        """Area [mm^2] of the section, and of each channel in its plane, shape (stations,)."""
        rod, x = self.scene.rod, jnp.asarray(X)
        rest = np.stack(jax.vmap(rod.rest)(x), axis=-1)
        holes = []
        for actuator in self.scene.actuators:
            path = jax.vmap(actuator.routing.path)(x)
            zero = np.zeros_like(x)
            d = np.stack((zero, path.y, path.z), axis=-1)
            slope = np.stack((zero, path.slope_y, path.slope_z), axis=-1)
            t = np.cross(rest[:, :3], d) + rest[:, 3:] + slope
            reach = None if actuator.reach(x[0]) is None else jax.vmap(actuator.reach)(x)
            here = np.ones_like(x) if reach is None else np.asarray(reach)
            across = np.pi / 4 * (1e3 * BORE) ** 2
            holes.append(here * across * np.linalg.norm(t, axis=-1) / t[:, 0])
        body = jax.vmap(lambda x: rod.section.geometry(x, rod.length).area)(x)
        return 1e6 * np.asarray(body), holes

    def volume(self):
        r"""$\int A u_x - \sum_i a_i e_x \cdot (k \times d_i + u)\,dX$ [mm^3], by the midpoint
        rule."""
        X = (np.arange(600) + 0.5) / 600 * self.length
        rest = jax.vmap(self.scene.rod.rest)
        xi = np.array((self.eq.strain(X)).T if self.name == "bent" else rest(jnp.asarray(X)))
        body, holes = self.areas(X)
        total = body * xi[3]
        for i, hole in enumerate(holes):
            y, z = self.routing(i, X).T
            total -= hole * (xi[3] + xi[1] * z - xi[2] * y)
        return 1e3 * np.mean(total) * self.length

    def loops(self, X):
        """Area [mm^2] and centroid (y, z) [mm] of each closed curve in which the section's plane
        cuts the surface, the largest first."""
        g = self.pose([X])[0]
        origin, axes = 1e3 * g[:3, 3], g[:3, 1:3]
        segments = (trimesh.intersections.mesh_plane(self.mesh, g[:3, 0], origin) - origin) @ axes
        corners, place = np.unique(segments.reshape(-1, 2).round(4), axis=0, return_inverse=True)
        pairs = place.reshape(-1, 2)
        graph = np.zeros((len(corners), len(corners)), bool)
        graph[pairs[:, 0], pairs[:, 1]] = True
        count, label = connected_components(graph, directed=False)
        found = [_polygon(corners[label == i]) for i in range(count)]
        return sorted(found, key=lambda loop: -loop[0])


def _polygon(corners):
    """Area and centroid of a convex polygon."""
    middle = corners.mean(axis=0)
    order = np.argsort(np.arctan2(*(corners - middle).T[::-1]))
    a = corners[order] - middle
    b = np.roll(a, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = cross.sum() / 2
    return area, middle + (cross[:, None] * (a + b)).sum(axis=0) / (6 * area)


@pytest.fixture(scope="module", params=CASES)
def made(request, tmp_path_factory):
    return Made(request.param, tmp_path_factory.mktemp("export"))


@pytest.mark.slow
def test_other_readers_find_a_closed_body_of_the_scenes_volume(made):
    assert made.mesh.is_watertight
    assert made.mesh.is_winding_consistent
    read = stl.Mesh.from_file(str(made.files["stl"]))
    assert bool(read.is_closed(exact=True))
    volume = float(read.get_mass_properties()[0])
    np.testing.assert_allclose(volume, made.volume(), rtol=5e-3)
    np.testing.assert_allclose(made.made.body().volume, volume, rtol=1e-5)
    vertices, faces = np.asarray(made.mesh.vertices, np.float32), np.asarray(made.mesh.faces)
    solid = manifold3d.Manifold(manifold3d.Mesh(vertices, faces.astype(np.uint32)))
    assert (solid.status(), solid.genus()) == (manifold3d.Error.NoError, HANDLES[made.name])


@pytest.mark.slow
def test_sections_and_channels_are_where_the_scene_says(made):
    """At ten abscissas, by cutting the mesh."""
    X = np.linspace(0.013, 0.987, 10) * made.length
    areas, holes = made.areas(X)
    section, length = made.scene.rod.section, made.scene.rod.length
    hollow = jax.vmap(lambda x: section.inner_radius(x, length))(jnp.asarray(X)) > 0
    for k, x in enumerate(X):
        (outer, _), *inner = made.loops(x)
        here = [i for i, hole in enumerate(holes) if hole[k] > 0]
        assert len(inner) == len(here) + bool(hollow[k])
        cut = outer - sum(size for size, _ in inner)
        np.testing.assert_allclose(cut, areas[k] - sum(holes[i][k] for i in here), rtol=5e-3)
        for i in here:
            centre = 1e3 * made.routing(i, X[k : k + 1])[0]
            near = min(inner, key=lambda loop: np.linalg.norm(loop[1] - centre))
            assert np.linalg.norm(near[1] - centre) < 0.05
            np.testing.assert_allclose(near[0], holes[i][k], rtol=2e-3)


def test_paths_are_those_of_the_equilibrium(made):
    with open(made.files["csv"], newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for i, actuator in enumerate(made.scene.actuators):
        own = [row for row in rows if row["thread"] == str(i)]
        X = np.array([float(row["X [mm]"]) for row in own])
        assert np.all(np.diff(X) > 0)
        ends = [0.0 if actuator.start is None else actuator.start]
        ends.append(made.length if actuator.end is None else actuator.end)
        np.testing.assert_allclose(X[[0, -1]], 1e3 * np.array(ends), atol=1e-6)
        found = np.array([[float(row[f"{axis} [mm]"]) for axis in "xyz"] for row in own])
        np.testing.assert_allclose(found, made.thread(i, X / 1e3), atol=2e-6)
        if made.name == "bent" and i == 1:
            np.testing.assert_allclose(found, 1e3 * made.eq.thread(i, X / 1e3), atol=2e-6)
        for row in own:
            turn, radius = np.radians(float(row["angle [deg]"])), float(row["radius [mm]"])
            place = float(row["section y [mm]"]), float(row["section z [mm]"])
            np.testing.assert_allclose(
                place, (radius * np.cos(turn), radius * np.sin(turn)), atol=2e-6
            )


def _curves(path):
    """Curves of a STEP file by name, as functions of their parameter."""
    text = pathlib.Path(path).read_text(encoding="ascii")
    assert text.startswith("ISO-10303-21;")
    entities = dict(re.findall(r"^#(\d+)=(.*);$", text, flags=re.MULTILINE))
    number = r"[-+\d.E]+"
    curves = {}
    for body in entities.values():
        found = re.fullmatch(
            r"B_SPLINE_CURVE_WITH_KNOTS\('(.*)',3,\((.*?)\),.*?,\(([\d,]+)\),\((.*)\),.*\)", body
        )
        if found:
            name, places, counts, knots = found.groups()
            controls = [
                re.findall(number, entities[p[1:]].split("''")[1]) for p in places.split(",")
            ]
            knots = np.repeat(
                [float(knot) for knot in knots.split(",")], [int(c) for c in counts.split(",")]
            )
            curves[name] = BSpline(knots, np.array(controls, float), 3)
    return curves


def test_step_curves_are_the_threads(made):
    curves = _curves(made.files["step"])
    assert len(curves) == 1 + len(made.scene.actuators)
    for name, curve in curves.items():
        X = np.linspace(curve.t[0], curve.t[-1], 101)
        if name == "axis":
            expected = 1e3 * made.pose(X / 1e3)[:, :3, 3]
        else:
            expected = made.thread(int(name.split()[1]), X / 1e3)
        np.testing.assert_allclose(curve(X), expected, atol=5e-3)


def test_step_file_opens_in_a_cad_kernel(made):
    """Open CASCADE, as gmsh has it."""
    try:
        import gmsh
    except OSError as error:
        pytest.skip(f"gmsh cannot be loaded: {error}")
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        tags = gmsh.model.occ.importShapes(str(made.files["step"]))
        gmsh.model.occ.synchronize()
        assert [dimension for dimension, _ in tags] == [1] * (1 + len(made.scene.actuators))
        for i, (_, tag) in enumerate(tags[1:]):
            low, high = (float(end[0]) for end in gmsh.model.getParametrizationBounds(1, tag))
            X = np.linspace(low, high, 31)
            found = np.reshape(gmsh.model.getValue(1, tag, X), (-1, 3))
            np.testing.assert_allclose(found, made.thread(i, X / 1e3), atol=5e-3)
    finally:
        gmsh.finalize()


def test_the_flat_pattern_of_a_helix_is_straight(made):
    drawing = ezdxf.readfile(made.files["dxf"])
    assert drawing.units == ezdxf.units.MM
    space = drawing.modelspace()
    for i, actuator in enumerate(made.scene.actuators):
        parts = [np.array(e.get_points("xy")) for e in space.query(f'*[layer=="thread {i}"]')]
        assert parts
        if not isinstance(actuator.routing, vsr.Helix):
            continue
        radius, turn = 1e3 * float(actuator.routing.radius), 2 * np.pi
        length = sum(np.linalg.norm(np.diff(part, axis=0), axis=1).sum() for part in parts)
        expected = made.made.lengths.column("at rest [mm]")[i]
        np.testing.assert_allclose(length, expected, rtol=1e-6)
        across = np.concatenate(parts)[:, 1]
        assert np.ptp(across) <= turn * radius * (1 + 1e-9)
        x, y = np.concatenate(parts).T
        place = radius * np.stack((np.cos(y / radius), np.sin(y / radius)), axis=-1)
        np.testing.assert_allclose(place, 1e3 * made.routing(i, x / 1e3), atol=1e-6)


def test_lengths_of_a_bent_arm(made):
    bent = made.made.lengths.column("as exported [mm]")
    expected = (
        1e3 * np.asarray(made.eq.lengths)
        if made.eq.scene.actuators
        else made.made.lengths.column("at rest [mm]")
    )
    np.testing.assert_allclose(bent, expected, atol=1e-4)


@pytest.mark.slow
def test_the_guide_runs(tmp_path, monkeypatch):
    page = pathlib.Path(__file__).parents[1] / "docs" / "fabrication.md"
    (code,) = re.findall(r"^```python\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    pathlib.Path("guide.py").write_text(code, encoding="utf-8")
    with contextlib.redirect_stdout(io.StringIO()) as out:
        runpy.run_path("guide.py")
    assert "thinnest: the wall between" in out.getvalue()
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"guide.py", "arm.step", "holes.csv", "bent.csv"}


def run(*arguments):
    """Exit code and what was printed."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main(["export", HELIX, *map(str, arguments)])
    return code, out.getvalue(), err.getvalue()


def test_the_command_writes_what_it_is_asked_for(tmp_path):
    kinds = ("stl", "step", "csv", "dxf", "holes", "lengths")
    files = {kind: tmp_path / f"arm.{kind}" for kind in kinds}
    options = [part for kind, path in files.items() for part in (f"--{kind}", path)]
    code, out, err = run(*options, "--bore", 0.001, "--wall", 0.005, "--discs", 0, 0.5)
    assert code == cli_common.DONE
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in files.values()}
    assert trimesh.load(files["stl"]).is_watertight
    # the paper's helix: alpha = 1.529, r = 5 mm
    assert "One helical thread" in out
    angle = np.degrees(0.5 / (0.005 * np.tan(1.529))) % 360
    holes = files["holes"].read_text(encoding="utf-8").splitlines()
    assert len(holes) == 3
    assert float(holes[2].split(",")[3]) == pytest.approx(angle, abs=1e-3)
    assert re.search(r"^vsr-jax: warning: the wall between .* less than 5 mm$", err, re.MULTILINE)


@pytest.mark.slow
def test_the_command_bends_the_arm_and_says_what_is_wrong(tmp_path):
    step = tmp_path / "arm.step"
    assert run("--inputs", -15, "--step", step)[0] == cli_common.DONE
    tip = _curves(step)["axis"](750.0)
    scene = vsr.load(HELIX).scene
    np.testing.assert_allclose(tip, 1e3 * vsr.solve(scene, [-15.0]).tip[:3, 3], atol=1e-5)
    assert run("--inputs", -5e3)[0] == cli_common.NOT_CONVERGED
    for wrong in (("--steps", 8), ("--stl", tmp_path / "none" / "arm.stl"), ("--bore", -1)):
        code, _, err = run(*wrong)
        assert (code, err.count("\n")) == (cli_common.BAD_USAGE, 1)
