"""Warnings about implausible numbers: names, guessed units, none for ordinary arms."""

import pathlib
import warnings

import jax
import jax.numpy as jnp
import pytest

import vsr_jax as vsr
from vsr_jax.analysis.health import Limit
from vsr_jax.cli import common as cli_common, main as cli
from vsr_jax.files.scene_file import load
from vsr_jax.optimization import design_search
from vsr_jax.solution.plausible_strain import strain_warnings
from vsr_jax.studies import paper
from vsr_jax.viz import body

FOLDER = pathlib.Path(__file__).parents[1] / "notebooks"
SCENES = sorted((FOLDER / "scenes").glob("*.toml"))
HELIX = (FOLDER / "scenes" / "helix.toml").read_text()
STEEL = vsr.Material(2e11, poisson=0.3)
PARALLEL = 'type = "Parallel", y = 0.0, z = 0.0'


def arm(*, length=0.3, radius=0.01, young=1e6, shear=3e5, density=1e3, rim=0.02, area=1e-5):
    rod = vsr.Rod(
        length,
        vsr.Circular(radius),
        vsr.Material(young, shear=shear, density=density),
        discs=vsr.Discs(10, radius=rim),
    )
    return vsr.Scene(rod, [vsr.Chamber(vsr.Parallel(0.0, 0.0), area)])


@pytest.mark.parametrize(
    ("numbers", "sentence"),
    [
        (
            {"length": 400.0},
            "rod.length: 400 m; arms are 1 mm to 20 m long; is it in millimetres?",
        ),
        ({"length": 1e9}, "rod.length: 1e+09 m; arms are 1 mm to 20 m long"),
        (
            {"length": 200.0, "radius": 0.5},
            "rod.length: 200 m; arms are 1 mm to 20 m long; is it in millimetres?",
        ),
        (
            {"radius": 7.0},
            "rod.section: half thickness: 7 m; arms have 5 um to 500 mm; is it in millimetres?",
        ),
        (
            {"rim": 10.0},
            "rod.discs.radius: 10 m; arms have 5 um to 500 mm; is it in millimetres?",
        ),
        (
            {"radius": 0.2},
            "rod: 1.5 times as long as half its thickness; rods are 3 to 10000 times; are length "
            "and sizes in one unit?",
        ),
        ({"length": 19.0, "radius": 1e-4}, "rod: 1.9e+05 times as long as half its thickness"),
        (
            {"young": 0.2},
            "rod.material.young: 0.2 Pa; materials have 1 kPa to 2 TPa; is it in MPa or GPa?",
        ),
        (
            {"young": 1.5, "shear": 22e3},
            "rod.material.young: 1.5 Pa; materials have 1 kPa to 2 TPa; is it in MPa or GPa?",
        ),
        (
            {"young": vsr.Taper(54.0, 60.0)},
            "rod.material.young: 54 Pa; materials have 1 kPa to 2 TPa; is it in MPa or GPa?",
        ),
        (
            {"young": 54e9, "shear": 20e3},
            "rod.material: young 5.4e+10 Pa and shear 20000 Pa; their ratio is 2 to 3",
        ),
        (
            {"density": 1.08},
            "rod.material.density: 1.08 kg/m^3; materials have 50 to 25000 kg/m^3; is it in "
            "g/cm^3?",
        ),
        (
            {"area": 28.3},
            "actuators[0].area: 28.3 m^2; the section has 0.00126 m^2; is it in mm^2?",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else "",
)
def test_a_wrong_unit_is_named(numbers, sentence):
    with pytest.warns(vsr.UnitWarning) as told:
        found = arm(**numbers).warnings
    assert len(found) == 1
    assert found[0].startswith(sentence)
    (warning,) = told
    assert str(warning.message) == found[0]
    assert warning.filename == __file__


@pytest.mark.parametrize(
    ("acceleration", "sentence"),
    [
        ((0, 0, 9.81), "loads[0].acceleration: points up, along +z; is its sign right?"),
        (
            (0, 0, -9810.0),
            "loads[0].acceleration: 9810 m/s^2; the Earth's is 9.81 m/s^2; is it in mm/s^2?",
        ),
    ],
    ids=["up", "large"],
)
def test_doubtful_gravity_is_named(acceleration, sentence):
    scene = arm()
    heavy = vsr.Scene(scene.rod, scene.actuators, vsr.Gravity(acceleration))
    assert heavy.warnings == (sentence,)


def test_the_materials_of_a_composite_are_named():
    wire = vsr.Inclusion(vsr.Parallel(0.0, 0.0), 1e-3, vsr.Material(200.0, poisson=0.3))
    rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Composite(vsr.Material(1e6, poisson=0.5), wire))
    (sentence,) = vsr.Scene(rod).warnings
    assert sentence.startswith("rod.material.inclusions[0].material.young: 200 Pa; materials")
    odd = vsr.Composite(vsr.Material(2e6, shear=1.1e3), [])
    (sentence,) = vsr.Scene(vsr.Rod(0.3, vsr.Circular(0.01), odd)).warnings
    assert sentence.startswith("rod.material.material: young 2e+06 Pa and shear 1100 Pa;")
    rubber = vsr.Ogden((0.4, -0.01), (2.0, -2.0))
    (sentence,) = vsr.Scene(vsr.Rod(0.3, vsr.Circular(0.01), rubber)).warnings
    assert "shear_moduli times exponents): 1.23 Pa" in sentence


def test_code_without_a_module_may_make_scenes():
    exec("import vsr_jax as vsr\nvsr.Scene(vsr.Rod(400.0, vsr.Circular(0.01), M))", {"M": STEEL})


def test_numbers_that_the_package_tries_are_not_warned_of():
    with pytest.warns(vsr.UnitWarning):
        scene = arm(length=400.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        body.at_rest(vsr.solve(scene, [0.0], model=vsr.StrainDependent(2)))


def test_stiffness_that_no_section_has_is_named():
    def told(EI):
        rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Stiffness(EI, EA=300.0))
        return vsr.Scene(rod).warnings

    assert told(7.5e-3) == ()
    (first, _) = told(7.5)
    assert first.startswith(
        "rod.material: EI_y 7.5 N m^2 and EA 300 N; what is stiff would lie 0.158 m from the axis"
    )


@pytest.mark.slow
@pytest.mark.parametrize("aside", [0.0, 0.008])
def test_a_tension_beyond_what_the_arm_bears_is_named(aside):
    """First-order strain: $T / EA$, or $T d b / EI$ at the outline of a section."""
    rod = arm().rod
    scene = vsr.Scene(rod, [vsr.Tendon(vsr.Parallel(aside, 0.0))])
    area, bending = jnp.pi * 0.01**2, 1e6 * jnp.pi / 4 * 0.01**4
    tension = 5000.0
    strain = max(tension / (1e6 * area), tension * aside * 0.01 / bending)
    with pytest.warns(vsr.UnitWarning, match=r"inputs\[0\]: 5000 N would") as told:
        eq = vsr.solve(scene, [tension], model=vsr.StrainDependent(4))
    assert not eq.converged
    assert [warning.filename for warning in told] == [__file__]
    (sentence,) = strain_warnings(eq)
    assert sentence.startswith(f"inputs[0]: 5000 N would strain a section by {strain:.2g}; ")
    assert sentence.endswith("is it in mN?")
    fine = vsr.solve(scene, [tension * 1e-3], model=vsr.StrainDependent(4))
    assert strain_warnings(fine) == ()


@pytest.mark.slow
@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_the_examples_are_plausible(path):
    assert load(path).scene.warnings == ()


@pytest.mark.parametrize("case", ["A1", "B2", "C1"])
def test_the_papers_arms_are_plausible(case):
    assert paper.scene(case).warnings == ()


def test_ordinary_arms_are_plausible():
    for numbers in (
        {},
        {"young": 5e4, "shear": 2e4},
        {"length": 1.5, "radius": 3e-4, "young": 2e11, "shear": 8e10, "density": 7800.0},
    ):
        assert arm(**numbers).warnings == ()


def test_large_strains_are_named_and_failed_or_traced_solves_are_not(helix):
    soft = vsr.Scene(helix.rod, [vsr.Thread(vsr.Parallel(0.0, 0.0))], free_strains=["elongation"])
    stretch = 5.93e5 * jnp.pi * 0.01**2

    def solved(strain):
        return vsr.solve(soft, [strain * stretch], model=vsr.StrainDependent(4))

    assert strain_warnings(solved(0.4)) == ()
    (sentence,) = strain_warnings(solved(0.8))
    assert sentence.startswith("strain: up to 0.8; beyond 0.5 a linear material is doubtful")
    assert strain_warnings(solved(-1.5)) == ()
    said = []
    jax.jit(
        lambda u: said.extend(strain_warnings(vsr.solve(soft, u, model=vsr.StrainDependent(4))))
    )(jnp.array([0.8 * stretch]))
    jax.jit(lambda length: said.extend(arm(length=length).warnings))(400.0)
    assert said == []


def test_the_health_of_a_solve_has_the_warnings(helix):
    eq = vsr.solve(arm(length=400.0), [0.0], model=vsr.StrainDependent(4))
    limit = Limit(jnp.array(2.0), jnp.array(0))
    health = vsr.Health(eq, None, limit, None, jnp.array(0.0))
    (sentence,) = health.warnings
    assert f"  warning      {sentence}" in str(health).splitlines()
    assert health.record()["warnings"] == [sentence]


@pytest.mark.filterwarnings("always::vsr_jax.UnitWarning")
@pytest.mark.parametrize(
    "arguments",
    [["solve"], ["check"], ["sweep"], ["reach", "--target", "0.1", "0", "0"]],
    ids=lambda x: x[0],
)
def test_commands_warn_on_stderr_before_solving(arguments, tmp_path, capsys):
    path = tmp_path / "arm.toml"
    path.write_text(HELIX.replace("length = 0.75", "length = 400"))
    name, *more = arguments
    nowhere = ["--out" if name == "sweep" else "--json", str(tmp_path / "no" / "file")]
    assert cli.main([name, str(path), *more, *nowhere]) == cli_common.BAD_USAGE
    out, err = capsys.readouterr()
    assert err.startswith(
        "vsr-jax: warning: rod.length: 400 m; arms are 1 mm to 20 m long; is it in "
        "millimetres?\nvsr-jax: "
    )
    assert out == ""


@pytest.mark.filterwarnings("always::vsr_jax.UnitWarning")
def test_design_warns_on_stderr_before_solving(tmp_path, capsys, monkeypatch):
    def design(*_, **__):
        raise ValueError("not now")

    monkeypatch.setattr(design_search, "design", design)
    path = tmp_path / "problem.toml"
    text = (FOLDER / "problems" / "reach_out.toml").read_text()
    path.write_text(text.replace("young = 8e5", "young = 0.8"))
    assert cli.main(["design", str(path)]) == cli_common.BAD_USAGE
    assert capsys.readouterr().err.startswith("vsr-jax: warning: rod.material.young: 0.8 Pa; ")
    path.write_text(text)
    assert cli.main(["design", str(path)]) == cli_common.BAD_USAGE
    assert capsys.readouterr().err == "vsr-jax: not now\n"


def test_solve_warns_of_large_strains(tmp_path, capsys):
    path = tmp_path / "arm.toml"
    free = 'free_strains = ["elongation"]\ninputs = [120.0]'
    path.write_text(
        HELIX.replace("inputs = [-5.0]", free).replace(
            'type = "Helix", radius = 0.005, angle = 1.529', PARALLEL
        )
    )
    assert cli.main(["solve", str(path), "--steps", "4"]) == cli_common.DONE
    assert capsys.readouterr().err.startswith("vsr-jax: warning: strain: up to 0.64; ")
