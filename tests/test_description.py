"""Scenes and their parts as text, also where their numbers are traced, batched or missing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import vsr_jax as vsr

ARM = vsr.Rod(
    0.75,
    vsr.Circular(vsr.Taper(0.012, 0.01)),
    vsr.Material(5.93e5, shear=2e5, density=1080.0),
    discs=vsr.Discs(10, radius=0.03),
)
SCENE = vsr.Scene(
    ARM,
    [
        vsr.Tendon(vsr.Helix(0.005, pitch=0.8), end=0.4, friction=0.1),
        vsr.Tendon(vsr.Parallel(0.0, 0.005), control="length", stiffness=2e4),
        vsr.Chamber(vsr.Polynomial([0.001, 0.01], [-0.004]), area=2e-5),
    ],
    [vsr.Gravity(), vsr.TipWrench(force=(0.0, 0.0, 0.1), frame="body")],
    free_strains=("bending_y", "bending_z"),
)
TABLE = """\
Scene
  rod.length    0.75 m
  rod.section   Circular(radius=Taper(base=0.012 m, tip=0.01 m))
  rod.material  Material(young=593000 Pa, shear=200000 Pa, density=1080 kg/m^3)
  rod.discs     Discs(number=10, radius=0.03 m)
  actuators[0]  Tendon(routing=Helix(radius=0.005 m, pitch=0.8 m), end=0.4 m, friction=0.1),
                  input in N
  actuators[1]  Tendon(routing=Parallel(y=0 m, z=0.005 m), control='length', stiffness=20000 N),
                  input in m
  actuators[2]  Chamber(routing=Polynomial(y=(0.001 m, 0.01), z=(-0.004 m)), area=2e-5 m^2),
                  input in Pa
  loads[0]      Gravity(acceleration=(0, 0, -9.81) m/s^2)
  loads[1]      TipWrench(force=(0, 0, 0.1) N, frame='body')
  free_strains  bending_y, bending_z"""


def test_a_scene_is_a_table_of_numbers_with_units():
    assert str(SCENE) == repr(SCENE) == TABLE


@pytest.mark.parametrize(
    ("part", "text"),
    [
        (vsr.Helix(0.005, pitch=0.8), "Helix(radius=0.005 m, pitch=0.8 m)"),
        (vsr.Helix(0.005, 1.5, hand="left"), "Helix(radius=0.005 m, angle=1.5 rad, hand='left')"),
        (vsr.Linear(0.0, 0.005, slope_y=-1e-5), "Linear(y=0 m, z=0.005 m, slope_y=-1e-5)"),
        (
            vsr.Spline([0, 0.3], [0, 0.001], [0, 0]),
            "Spline(X=(0, 0.3) m, y=(0, 0.001) m, z=(0, 0) m)",
        ),
        (
            vsr.Polynomial([1.0, 2.0, 3.0], jnp.arange(9.0)),
            "Polynomial(y=(1 m, 2, 3 1/m), z=9 numbers, from 0 to 8 m per m^i)",
        ),
        (vsr.Circular(diameter=0.02), "Circular(radius=0.01 m)"),
        (
            vsr.Elliptic(0.03, 0.02, torsion="polar", shear_correction=(0.9, 1.0)),
            "Elliptic(semi_axis_y=0.03 m, semi_axis_z=0.02 m, torsion='polar', "
            "shear_correction=(0.9, 1))",
        ),
        (vsr.Constant(3.0), "3"),
        (vsr.Taper(1.0, 2.0), "Taper(base=1, tip=2)"),
        (vsr.Gravity((0, 0, 0)), "Gravity(acceleration=(0, 0, 0) m/s^2)"),
        (
            vsr.DistributedWrench(force=(0, vsr.Taper(0.0, 1.0), 0)),
            "DistributedWrench(force=(0 N/m, Taper(base=0 N/m, tip=1 N/m), 0 N/m))",
        ),
        (
            vsr.Material(lambda x: 1e6, poisson=0.5),
            "Material(young=FunctionProfile(function=<lambda>(X)), poisson=0.5)",
        ),
    ],
)
def test_a_part_is_one_line(part, text):
    assert repr(part) == text


def test_defaults_that_matter_are_shown():
    """A default of zeros, ones or an option's name is left out, and no number close to one."""
    bent = vsr.Rod(0.5, ARM.section, ARM.material, rest_strain=(0, 0, 4, 1, 0, 0))
    assert "rest_strain=(0 1/m, 0 1/m, 4 1/m, 1, 0, 0)" in repr(bent)
    assert "rest_strain" not in repr(vsr.Rod(0.5, ARM.section, ARM.material))
    assert "shear_correction=(1, 1)" in repr(vsr.Circular(0.01, shear_correction=1.0 + 1e-9))


def test_a_base_shows_its_matrix():
    base = jnp.diag(jnp.array([1.0, -1.0, -1.0, 1.0])).at[0, 3].set(0.2)
    arm = vsr.Rod(0.5, ARM.section, ARM.material, base=base)
    assert "base=((1, 0, 0, 0.2), (0, -1, 0, 0), (0, 0, -1, 0), (0, 0, 0, 1))" in repr(arm)


def test_traced_numbers_are_shown_as_such():
    texts = []

    @eqx.filter_jit
    def program(scene):
        texts.append(repr(scene))
        return scene.rod.length

    program(SCENE)
    assert "rod.length       traced\n" in texts[0]
    assert "acceleration=traced (3,)" in texts[0]
    assert "control='length'" in texts[0]
    assert "rod.length       unknown\n" in repr(eqx.filter_eval_shape(lambda s: s, SCENE))


def test_a_batch_shows_its_range():
    batch = jax.vmap(lambda r: eqx.tree_at(lambda s: s.actuators[0].routing.radius, SCENE, r))(
        jnp.linspace(0.002, 0.006, 20)
    )
    assert "radius=20 numbers, from 0.002 to 0.006 m" in repr(batch)
    assert "rod.length    20 numbers, each 0.75 m\n" in repr(batch)
    assert "acceleration=numbers of shape (20, 3), from -9.81 to 0 m/s^2" in repr(batch)


@pytest.mark.parametrize("leaf", [None, True, "text", object(), 1.0, 1j])
def test_any_tree_of_a_scene_has_a_text(leaf):
    assert "rod.section" in repr(jax.tree.map(lambda _: leaf, SCENE))


@pytest.mark.parametrize("name", ["rod", "actuators", "loads"])
def test_a_part_that_is_missing_has_a_text(name):
    lines = repr(eqx.tree_at(lambda s: getattr(s, name), SCENE, None)).splitlines()
    assert f"{name} None" in [" ".join(line.split()) for line in lines]


def test_deleted_numbers_have_a_text():
    load = vsr.TipWrench((1.0, 2.0, 3.0))
    load.force.delete()
    assert repr(load) == "TipWrench(force=unknown (3,))"
