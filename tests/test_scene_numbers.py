"""Numbers of a scene by name: what they are called, their units, and that a change reaches the
scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.arm.routing import Routing
from vsr_jax.arm.scene_numbers import matching, replaced


@pytest.fixture(scope="module")
def scene():
    sections = vsr.Joined((0.1,), [vsr.Circular(vsr.Taper(0.012, 0.01)), vsr.Annular(0.01, 0.002)])
    arm = vsr.Rod(
        0.3,
        sections,
        vsr.Material(8e5, poisson=0.4, density=1000.0),
        rest_strain=(0, 1.0, 0, 1, 0, 0),
    )
    threads = [
        vsr.Tendon(vsr.Helix(0.005, 1.5), end=0.2),
        vsr.Tendon(vsr.Spline([0, 0.1, 0.3], [0, 0.001, 0.003], [0] * 3)),
        vsr.Tendon(vsr.Polynomial([0.001, 0.002], [0.0, 0.001, 0.002])),
    ]
    return vsr.Scene(
        arm,
        threads,
        [
            vsr.Gravity(),
            vsr.DistributedWrench(force=(0, vsr.PolynomialProfile([1.0, 2.0, 3.0]), 0)),
        ],
    )


def test_names_are_those_of_the_constructors_and_units_follow(scene):
    known = vsr.parameters(scene)
    units = {
        "rod.length": "m",
        "rod.section.sections[0].radius.base": "m",
        "rod.section.ends": "m",
        "rod.material.young": "Pa",
        "rod.material.poisson": "-",
        "rod.rest_strain[1]": "1/m",
        "rod.rest_strain[3]": "-",
        "actuators[0].routing.angle": "rad",
        "actuators[0].end": "m",
        "actuators[1].routing.X": "m",
        "loads[0].acceleration": "m/s^2",
        "loads[1].moment[0]": "N",
    }
    assert {name: known[name].unit for name in units} == units
    assert known["actuators[2].routing.z"].entries("z") == [
        ("z[0]", "m"),
        ("z[1]", "-"),
        ("z[2]", "1/m"),
    ]
    force = "loads[1].force[1].coefficients"
    assert [unit for _, unit in known[force].entries(force)] == ["N/m", "N/m/m", "N/m/m^2"]


def test_every_number_of_a_scene_has_a_name(scene):
    import equinox as eqx

    assert len(vsr.parameters(scene)) == len(
        jax.tree.leaves(eqx.filter(scene, eqx.is_inexact_array))
    )


def test_a_new_value_reaches_the_scene(scene):
    new = replaced(
        scene, {"actuators[1].routing.X": jnp.array([0.0, 0.2, 0.3]), "rod.length": jnp.array(0.31)}
    )
    assert float(new.rod.length) == 0.31
    np.testing.assert_array_equal(new.actuators[1].routing.X, [0.0, 0.2, 0.3])
    assert replaced(scene, {}) is scene


def test_patterns_and_names_that_nothing_has(scene):
    known = vsr.parameters(scene)
    assert matching("actuators[*].routing.y", known) == [
        "actuators[1].routing.y",
        "actuators[2].routing.y",
    ]
    with pytest.raises(
        ValueError, match=r"no such number; did you mean 'actuators\[0\].routing.radius'"
    ):
        matching("actuators[0].routing.radus", known)


def test_replace_changes_one_number_or_several(scene):
    stiffer = scene.replace("rod.material.young", 6e5)
    assert float(stiffer.rod.material.young.value) == 6e5
    assert float(scene.rod.material.young.value) == 8e5
    new = scene.replace({"loads[0].acceleration": (0, 0, 9.81), "actuators[*].routing.y": 0.001})
    np.testing.assert_array_equal(new.loads[0].acceleration, (0, 0, 9.81))
    np.testing.assert_array_equal(new.actuators[1].routing.y, [0.001] * 3)
    np.testing.assert_array_equal(new.actuators[2].routing.y, [0.001] * 2)
    assert jax.tree.structure(new) == jax.tree.structure(scene)
    assert scene.replace({}) is scene


def test_a_replaced_number_keeps_its_precision(scene):
    small = scene.astype(jnp.float32).replace("rod.length", np.float64(0.31))
    assert small.rod.length.dtype == jnp.float32


@pytest.mark.slow
def test_transforms_go_through_replace(helix):
    def height(radius):
        scene = helix.replace("actuators[0].routing.radius", radius)
        return vsr.solve(scene, jnp.array([-15.0])).tip[2, 3]

    radius = helix.actuators[0].routing.radius
    slope = jax.grad(lambda scene: vsr.solve(scene, jnp.array([-15.0])).tip[2, 3])(helix)
    np.testing.assert_allclose(
        jax.jit(jax.grad(height))(radius), slope.actuators[0].routing.radius, rtol=1e-9
    )
    radii = jnp.array([0.004, 0.005])
    np.testing.assert_allclose(jax.vmap(height)(radii), [height(x) for x in radii], rtol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("rod.material.yong", 6e5), "rod.material.yong: the scene has no such number; did you "),
        (("rod.length", [0.3, 0.4]), r"rod.length: got shape \(2,\), need one number"),
        (
            ("loads[0].acceleration", [1.0, 2.0]),
            r"loads\[0\].acceleration: got shape \(2,\), need one number or shape \(3,\)",
        ),
        (("rod.length", np.nan), "rod.length: got nan, need finite"),
        (("rod.length", -0.1), "rod.length: got .*, need a finite number > 0"),
        (("rod.material.young", -1.0), "Scene.rod.material.young: got -1 at X = 0 m"),
        (("actuators[0].routing.radius", 0.02), r"Scene.actuators\[0\].routing: the thread is "),
        (("rod.length",), "Scene.replace: got 'rod.length' and None, need a name and a value"),
        (({"rod.length": 0.2}, 0.2), "Scene.replace: got .*, need a name and a value"),
    ],
)
def test_errors_of_replace(unchecked, scene, arguments, message):
    with pytest.raises(ValueError, match=message):
        scene.replace(*arguments)


def test_a_class_of_your_own_declares_its_units():
    import equinox as eqx
    from jaxtyping import Array

    class Diagonal(Routing):
        offset: Array = eqx.field(metadata={"unit": "m"})
        radius: Array

        def __call__(self, X):
            return self.offset, self.radius

    routing = Diagonal(jnp.array(0.001), jnp.array(0.002))
    arm = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.5))
    known = vsr.parameters(vsr.Scene(arm, [vsr.Thread(routing)]))
    assert known["actuators[0].routing.offset"].unit == "m"
    assert known["actuators[0].routing.radius"].unit == ""
