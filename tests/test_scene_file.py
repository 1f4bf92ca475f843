"""Scene files: what is written is read back to the last bit, and every mistake in a file is named
with its place."""

import pathlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.arm.rod import STRAINS
from vsr_jax.files import scene_file as scenefile
from vsr_jax.files.scene_file import load, parse_scene, to_toml
from vsr_jax.studies import paper

EXAMPLES = sorted((pathlib.Path(__file__).parents[1] / "notebooks" / "scenes").glob("*.toml"))
MATERIAL = vsr.Material(1e6, poisson=0.5)
HELIX = """\
title = "Case B1"
inputs = [-5.0]
actuators = [
    { type = "Thread", routing = { type = "Helix", radius = 0.005, angle = 1.529 } },
]

[rod]
length = 0.75

[rod.section]
type = "Circular"
radius = 0.01

[rod.material]
young = 593000.0
shear = 200000.0
"""


def same(a, b) -> bool:
    """Equal structure, and equal bits in every number."""
    leaves = [
        (np.asarray(x), np.asarray(y))
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    ]
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        x.dtype == y.dtype and x.tobytes() == y.tobytes() for x, y in leaves
    )


def full_scene() -> vsr.Scene:
    """A scene that holds every class a file can hold but for the materials in OTHER_MATERIALS."""
    wave = vsr.SplineProfile([0.0, 0.1, 0.3, 0.4, 0.5], [0.0, 1 / 3, -2e-17, 1e5 / 7, 0.2])
    radius = vsr.Piecewise(
        [0.05, 0.1], [vsr.Taper(0.021, 0.02), 0.02, vsr.PolynomialProfile([0.02, -1e-3])]
    )
    wide = [
        vsr.Annular(0.02, 0.004),
        vsr.Rectangular(0.04, 0.05, torsion="polar"),
        vsr.Elliptic(0.03, 0.02, shear_correction=[0.9, 0.8]),
    ]
    rod = vsr.Rod(
        0.5,
        vsr.Joined([0.1, 0.2, 0.3], [vsr.Circular(radius), *wide]),
        vsr.Material(vsr.Taper(1e6, 2e6 / 3), shear=vsr.PolynomialProfile([3e5, 1.0]), density=1e3),
        rest_strain=(0.1, -0.0, wave, 1.0, 0.0, vsr.Constant(1e-9)),
        base=vsr.se3.exp(jnp.array([1 / 3, -0.7, 2.0, 0.1, 0.2, -1 / 7])),
        rigid=[vsr.RigidPiece(end=1 / 30), vsr.RigidPiece(0.25, 0.3)],
    )
    actuators = [
        vsr.Thread(vsr.Helix(0.005, pitch=0.3, hand="left"), start=0.1 + 0.2),
        vsr.Tendon(
            vsr.Linear(0.0, 0.005, slope_z=-1 / 300), end=0.4, control="length", stiffness=2e4
        ),
        vsr.Tendon(
            vsr.Spline([0.0, 0.2, 0.5], [0.0, 0.003, 0.001], [0.0, 0.0, 0.004]),
            friction=0.1,
            motion="release",
        ),
        vsr.Chamber(vsr.Polynomial([0.001, 0.01], [-0.004]), area=2e-5),
        vsr.Chamber(vsr.Parallel(-0.0, 0.007), vsr.Constant(3e-5).value),
    ]
    loads = [
        vsr.Gravity((0.0, 0.1, -9.8)),
        vsr.TipWrench(moment=(0.0, 1e-3, 0.0), frame="body"),
        vsr.PointWrench(0.2, force=(0.1, 0.2, 0.3)),
        vsr.DistributedWrench((0.1, vsr.Taper(0.1, 0.2), -0.3)),
        vsr.Spring((0.1, 1 / 3, 0.0), 2.0, 0.2, length=0.1, kind="cord"),
        vsr.Payload(0.1, offset=(0.0, 0.01, -1 / 70), volume=1e-5, fluid_density=1000.0),
        vsr.MagneticMoment((0.0, 0.1, 0.2), (0.0, 0.0, 0.1)),
        vsr.MagneticDensity((vsr.Taper(0.1, 0.2), 0.0, 0.1), (0.0, 1 / 3, 0.0)),
        vsr.Spinning((0.0, 0.0, 2 / 3)),
    ]
    away = vsr.pose((3.0, 1 / 3, 0.0), pointing=(1.0, 2.0, 3.0))
    obstacles = [
        vsr.Plane((0.0, 1.0, 1 / 3), (0.0, -3.0, 0.0)),
        vsr.Sphere((2.0, 0.0, 1 / 3), 1 / 7),
        vsr.Cylinder(0.1, length=1 / 3, pose=away),
        vsr.Box((0.1, 0.2, 1 / 3), pose=away, rounding=0.01),
        vsr.Tube(vsr.Taper(5.0, 4.0), [[-1.0, 0.0, 0.0], [0.0, 1 / 3, 0.0], [2.0, 0.0, 1.0]]),
    ]
    free = ("bending_y", "bending_z", "elongation")
    return vsr.Scene(rod, actuators, loads, free_strains=free, obstacles=obstacles)


OTHER_MATERIALS = (
    vsr.NeoHookean(vsr.Taper(1e6, 2e6 / 3), density=1e3 / 7),
    vsr.Ogden((1e6 / 3, -1e4 / 7), (2.0, -2 / 3), density=1e3 / 7),
    vsr.Composite(
        vsr.Material(1e6 / 3, poisson=1 / 3),
        [
            vsr.Inclusion(vsr.Parallel(1e-3 / 3, 0.0), vsr.Taper(1e-3, 2e-3 / 3), end=0.1 / 3),
            vsr.Inclusion(
                vsr.Parallel(-6e-3, 0.0),
                2e-3 / 3,
                vsr.Composite(
                    vsr.Material(2e7 / 3, shear=1e7 / 7),
                    vsr.Inclusion(vsr.Parallel(-6e-3, 0.0), 1e-3 / 3),
                ),
            ),
        ],
    ),
    vsr.Stiffness(1 / 3, vsr.Taper(1.0, 2 / 3), EA=1e3 / 7, mass=1 / 7),
    vsr.Stiffness(matrix=np.diag([1 / 3, 0.1, 0.2, 1e3 / 7, 30.0, 40.0])),
)


@pytest.mark.slow
def test_every_class_comes_back_to_the_last_bit():
    scene = full_scene()
    text = to_toml(scene, [1.0, -0.001, 0.5, 1e4, 2e4], title='A "test"\nof \\ all')
    groups = [group for group in scenefile._GROUPS.values() if len(group) > 1]
    assert scenefile._GROUPS["rigid"] == {"RigidPiece": vsr.RigidPiece}
    assert "rigid = [" in text
    others = [vsr.Scene(vsr.Rod(0.1, vsr.Circular(0.01), x)) for x in OTHER_MATERIALS]
    texts = "".join([text, *map(to_toml, others)])
    assert [
        name
        for group in groups
        for name, kind in group.items()
        if f'type = "{name}"' not in texts and kind not in scenefile._USUAL
    ] == []
    assert all(same(parse_scene(to_toml(other)).scene, other) for other in others)
    assert {"Taper", "PolynomialProfile", "SplineProfile", "Piecewise", "Constant"} == set(
        scenefile._PROFILES
    )
    read = parse_scene(text)
    assert same(read.scene, scene)
    assert read.title == 'A "test"\nof \\ all'
    np.testing.assert_array_equal(read.inputs, [1.0, -0.001, 0.5, 1e4, 2e4])
    assert to_toml(*read) == text


def test_text_is_short_and_defaults_are_left_out():
    scene = paper.scene("B1")
    short = eqx.tree_at(lambda s: s.rod.section.radius, scene, vsr.Constant(0.01))
    assert to_toml(short, [-5.0], "Case B1") == HELIX
    assert "inputs" not in to_toml(short)
    assert "title" not in to_toml(short)


def test_a_diameter_is_read_and_kept_as_a_radius():
    with_diameter = HELIX.replace("radius = 0.01\n", "diameter = 0.02\n")
    assert same(parse_scene(with_diameter), parse_scene(HELIX))
    assert to_toml(*parse_scene(with_diameter)) == HELIX


def test_single_precision_is_written_in_its_own_decimals():
    scene = paper.scene("C1").astype(jnp.float32)
    text = to_toml(scene, np.float32([-0.1, 0.0, 0.3]))
    assert "base = 0.012\n" in text
    assert "inputs = [-0.1, 0.0, 0.3]" in text
    assert same(parse_scene(text).scene.astype(jnp.float32), scene)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_load_and_come_back(path):
    read = load(path)
    assert read.title
    assert read.inputs is not None
    assert same(parse_scene(to_toml(*read)), read)


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_converge(path):
    read = load(path)
    assert vsr.solve(read.scene, read.inputs).message == "converged"


def test_there_are_examples():
    stems = {path.stem for path in EXAMPLES}
    assert stems == {"helix", "catheter", "finger", "pneumatic", "payload", "pillar", "vessel"}


class Zigzag(vsr.Parallel):
    pass


@pytest.mark.parametrize(
    ("where", "part", "message"),
    [
        (
            lambda s: s.rod.section.radius,
            vsr.FunctionProfile(lambda x: 0.01 + x),
            r"^rod\.section\.radius: a FunctionProfile cannot be stored in a scene file; need one "
            r"of Constant, Piecewise, .*, Taper$",
        ),
        (
            lambda s: s.rod,
            vsr.Rod(0.75, vsr.Circular(0.01), MATERIAL, rest_strain=lambda x: (0, 0, x, 1, 0, 0)),
            r"^rod\.rest_strain: a Func",
        ),
        (
            lambda s: s.actuators[0].routing,
            vsr.Function(lambda x: (x, x)),
            r"^actuators\[0\]\.routing: a Function cannot be stored",
        ),
        (
            lambda s: s.actuators[0].routing,
            Zigzag(0.0, 0.0),
            r"^actuators\[0\]\.routing: a Zigzag cannot be stored",
        ),
    ],
    ids=["profile", "rest strain", "routing", "own class"],
)
def test_python_functions_and_own_classes_cannot_be_written(helix, where, part, message):
    with pytest.raises(ValueError, match=message):
        to_toml(eqx.tree_at(where, helix, part))


def test_traced_scenes_and_wrong_inputs_cannot_be_written(helix):
    with pytest.raises(ValueError, match=r"rod\.length: a traced value cannot be stored"):
        eqx.filter_jit(to_toml)(helix)
    with pytest.raises(ValueError, match=r"inputs: got shape \(2,\), need \(1,\)"):
        to_toml(helix, [1.0, 2.0])


KNOWN_SECTIONS = "known are Annular, Circular, Elliptic, Joined, Rectangular"
MISTAKES = [
    (
        "angle",
        "raduis",
        r"^actuators\[0\]\.routing: unknown key 'raduis', known are angle, hand, phase, pitch, "
        r"radius; did you mean 'radius'\?$",
    ),
    (
        "[rod]",
        "[road]",
        r"^unknown key 'road', known are actuators, driven, free_strains, held, inputs, loads, "
        r"obstacles, rod, title; did you mean 'rod'\?$",
    ),
    (
        '"Circular"',
        '"circle"',
        rf"^rod\.section: unknown type 'circle', {KNOWN_SECTIONS}; did you mean 'Circular'\?$",
    ),
    ('"Circular"', '"Helix"', rf"^rod\.section: unknown type 'Helix', {KNOWN_SECTIONS}$"),
    ('"Circular"', "3", rf"^rod\.section: unknown type 3, {KNOWN_SECTIONS}$"),
    (
        'type = "Circular"\n',
        "",
        "^rod.section: missing key 'type', known types are Annular, Circular",
    ),
    (
        "radius = 0.01\n",
        "",
        r"^rod\.section: Circular: got radius=None and diameter=None, need one of the two$",
    ),
    (
        "radius = 0.01\n",
        "diametre = 0.02\n",
        r"^rod\.section: unknown key 'diametre', known are diameter, .*; did you mean "
        r"'diameter'\?$",
    ),
    (
        "radius = 0.01\n",
        "radius = 0.01\ndiameter = 0.02\n",
        r"^rod\.section: Circular: got radius=0\.01 and diameter=0\.02, need one of",
    ),
    (
        "length = 0.75",
        "length = 0.75\nbase = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]",
        r"^rod: Rod\.base: got a reflection",
    ),
    (
        "actuators = [",
        "loads = [",
        r"^loads\[0\]: unknown type 'Thread', known are DistributedWrench, Gravity",
    ),
    (
        "young = 593000.0\n",
        "",
        r"^rod\.material: missing key 'young', known are density, poisson, shear, young$",
    ),
    (
        "shear = 200000.0\n",
        "",
        r"^rod\.material: Material: got shear=None and poisson=None, need one of the two$",
    ),
    (
        "radius = 0.01\n",
        'radius = "thin"\n',
        r"^rod\.section: Circular\.radius: got 'thin', need a finite number > 0$",
    ),
    (
        "radius = 0.01\n",
        "radius = true\n",
        r"^rod\.section: Circular\.radius: got True, need a finite number > 0$",
    ),
    (
        "radius = 0.01\n",
        "radius = 1979-05-27\n",
        r"^rod\.section: Circular\.radius: got .*date.*need a finite number > 0$",
    ),
    (
        "radius = 0.01\n",
        "radius = [0.01, 0.02]\n",
        r"^rod\.section: Circular\.radius: got shape \(2,\), need a finite number > 0$",
    ),
    (
        "radius = 0.01\n",
        "radius = {base = 1.0}\n",
        r"^rod\.section\.radius: missing key 'type', known types are Constant, ",
    ),
    (
        "radius = 0.01\n",
        'radius = {type = "Taper", base = 1.0}\n',
        r"^rod\.section\.radius: missing key 'tip', known are base, tip$",
    ),
    (
        "radius = 0.005",
        "radius = -0.005",
        r"^actuators\[0\]\.routing: Helix\.radius: got -0\.005, need a finite number > 0$",
    ),
    (
        "radius = 0.005",
        "radius = 0.05",
        r"^Scene\.actuators\[0\]\.routing: the thread is 0\.04 m outside the section at X = ",
    ),
    (
        "length = 0.75",
        "length = 0.75\nbase = [1.0, 0.0]",
        r"^rod: Rod\.base: got shape \(2,\), need finite numbers of shape \(4, 4\)$",
    ),
    ("length = 0.75", "length = {}", r"^rod\.length: missing key 'type'"),
    ('"Case B1"', "1", "^title: got 1, need text$"),
    (
        "[-5.0]",
        "[-5.0, 1.0]",
        r"^inputs: got shape \(2,\), need \(1,\), one number each for Thread",
    ),
    ("[-5.0]", '["much"]', r"^inputs: got \['much'\], need finite numbers$"),
    ("0.01\n", "0.01\nradius = 0.02\n", r"Cannot overwrite a value \(at line \d+, column \d+\)$"),
]


@pytest.mark.parametrize(
    ("right", "wrong", "message"), MISTAKES, ids=[message[:60] for _, _, message in MISTAKES]
)
@pytest.mark.usefixtures("unchecked")
def test_mistakes_are_named_with_their_place(right, wrong, message):
    assert right in HELIX
    with pytest.raises(ValueError, match=message) as caught:
        parse_scene(HELIX.replace(right, wrong, 1))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", ["3", '"Thread"', "[3]"])
@pytest.mark.usefixtures("unchecked")
def test_actuators_that_are_no_tables_are_refused(value):
    rod = HELIX[HELIX.index("[rod]") :]
    with pytest.raises(
        ValueError,
        match=r"^actuators(\[0\])?: got .*, need a table of the type Chamber or Tendon or Thread$",
    ):
        parse_scene(f"actuators = {value}\n{rod}")


@pytest.mark.usefixtures("unchecked")
def test_one_actuator_needs_no_list():
    text = (
        HELIX[HELIX.index("[rod]") :]
        + '[actuators]\ntype = "Thread"\nrouting = { type = "Parallel", y = 0.0, z = 0.0 }\n'
    )
    assert len(parse_scene(text).scene.actuators) == 1


def test_files_that_cannot_be_read_are_named(tmp_path):
    bad = tmp_path / "bad.toml"
    bad.write_text("[rod]\nlength 0.4\n")
    with pytest.raises(
        ValueError,
        match=r"bad\.toml: Expected '=' after a key in a key/value pair \(at line 2, column 8\)$",
    ):
        load(bad)
    bad.write_bytes(b'title = "\xff"')
    with pytest.raises(ValueError, match=r"bad\.toml: 'utf-8' codec can't decode"):
        load(bad)
    with pytest.raises(ValueError, match=r"none\.toml: No such file or directory$"):
        load(tmp_path / "none.toml")
    with pytest.raises(ValueError, match=r"Is a directory$"):
        load(tmp_path)


def test_strain_names_are_those_of_the_rod():
    text = 'free_strains = ["bending_x"]\n' + HELIX
    with pytest.raises(ValueError, match=r"free_strains.*bending_x") as caught:
        parse_scene(text)
    assert all(name in str(caught.value) for name in STRAINS)
