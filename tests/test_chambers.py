"""Chambers driven by volume and by an amount of gas: closed forms, energy, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import central_differences, checked_derivative
from scipy.optimize import brentq

import vsr_jax as vsr
from vsr_jax.files.scene_file import parse_scene, to_toml

LENGTH, RADIUS, YOUNG = 0.2, 0.013, 0.2e6
AREA, OFFSET = 2.83e-5, 0.007
SECTION = np.pi * RADIUS**2
ROD = vsr.Rod(LENGTH, vsr.Circular(RADIUS), vsr.Material(YOUNG, poisson=0.5, density=1000.0))
LOADS = vsr.Gravity(), vsr.TipWrench(force=(0.0, -0.3, 0.1))
STEPS = vsr.StrainDependent(6)
ATMOSPHERE = 101_325.0


def driven(control, offset=OFFSET, loads=(), **options):
    """The arm with one chamber along it."""
    chamber = vsr.Chamber(vsr.Parallel(offset, 0.0), AREA, control=control, **options)
    return vsr.Scene(ROD, chamber, loads)


KINDS = {
    "volume": ("volume", {}, 5e-7),
    "compliant": ("volume", {"compliance": 1e-13}, 5e-7),
    "gas": ("gas", {"dead_volume": 4e-6}, 1.6e-5),
}


def test_a_volume_bends_and_stretches_the_arm():
    """The strain of a chamber's force, $EA e = p a$ and $EI \\kappa = p a d$, with the length that
    the volume fills. The numbers are those of a public case."""
    eq = vsr.solve(driven("volume"), [5e-7], model=STEPS, throw=True)
    per_pressure = LENGTH * AREA / YOUNG * (1 / SECTION + OFFSET**2 / (SECTION * RADIUS**2 / 4))
    pressure = 5e-7 / AREA / per_pressure
    np.testing.assert_allclose(eq.forces[0] / AREA, pressure, rtol=1e-10)
    np.testing.assert_allclose(pressure, 153_471, rtol=1e-5)
    strain = eq.strain(0.1)
    np.testing.assert_allclose(strain[3] - 1, 4.0902e-2, rtol=2e-5)
    np.testing.assert_allclose(-strain[2], 6.7767, rtol=1e-5)


def test_a_force_meets_more_stiffness_at_given_volume_than_at_given_pressure():
    def deflection(control, value):
        ends = [
            vsr.solve(driven(control, loads=loads), [value], model=STEPS, throw=True).tip[:3, 3]
            for loads in ((), vsr.TipWrench(force=(0.0, -0.02, 0.0)))
        ]
        return np.linalg.norm(ends[1] - ends[0])

    filled = float(vsr.solve(driven("volume"), [5e-7], model=STEPS).forces[0]) / AREA
    assert deflection("volume", 5e-7) < 0.95 * deflection("pressure", filled)


def test_a_compliant_supply_takes_its_share():
    """$a L e + C p = V$ with $E A e = p a$ for a chamber on the axis."""
    compliance = 2e-12
    scene = driven("volume", 0.0, compliance=compliance)
    eq = vsr.solve(scene, [5e-7], model=STEPS, throw=True)
    pressure = 5e-7 / (LENGTH * AREA**2 / (YOUNG * SECTION) + compliance)
    np.testing.assert_allclose(eq.forces[0] / AREA, pressure, rtol=1e-10)


@pytest.mark.parametrize("share", [0.7, 1.0, 2.5])
def test_gas_is_compressed_as_by_boyle(share):
    """$(p_0 + p)(V_d + a L (1 + e)) = p_0 V_n$ with $E A e = p a$; below one it is a vacuum."""
    dead = 3e-6
    amount = share * (dead + AREA * LENGTH)
    scene = driven("gas", 0.0, dead_volume=dead)
    eq = vsr.solve(scene, [amount], model=STEPS, throw=True)

    def excess(p):
        room = dead + AREA * LENGTH * (1 + p * AREA / (YOUNG * SECTION))
        return (ATMOSPHERE + p) * room - ATMOSPHERE * amount

    pressure = brentq(excess, -ATMOSPHERE, 1e6, xtol=1e-7)
    np.testing.assert_allclose(eq.forces[0] / AREA, pressure, rtol=1e-9, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_energy_changes_with_the_input_as_its_potential(kind):
    """$dU / dV = p$ of a pump; $dU / dV_n = -p_0 \\ln v$ of gas with the volume v."""
    control, options, value = KINDS[kind]
    scene = driven(control, loads=LOADS, **options)

    fine = vsr.StrainDependent(24)

    def energy(u):
        return vsr.solve(scene, u, model=fine, throw=True).energy.total

    eq = vsr.solve(scene, [value], model=fine, throw=True)
    step = 1e-3 * value
    found = central_differences(lambda unit: energy(value + step * unit), 1)[0] / step
    pressure = float(eq.forces[0]) / AREA
    if control == "gas":
        volume = value * ATMOSPHERE / (ATMOSPHERE + pressure)
        np.testing.assert_allclose(found, -ATMOSPHERE * np.log(volume), rtol=1e-6)
    else:
        np.testing.assert_allclose(found, pressure, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_in_both_modes_and_batches(kind):
    control, options, value = KINDS[kind]
    names = list(options)

    def number(p):
        more = {name: p[2 + i] * options[name] for i, name in enumerate(names)}
        chamber = vsr.Chamber(vsr.Parallel(OFFSET, 0.0), p[1] * AREA, control=control, **more)
        scene = vsr.Scene(ROD, chamber, LOADS)
        eq = vsr.solve(scene, p[:1] * value, model=STEPS)
        return eq.tip[:3, 3] @ jnp.array([1.0, -2.0, 3.0]) + 1e-6 * eq.forces[0] / AREA

    p = jnp.ones(2 + len(names))
    solve, _ = checked_derivative(number, p, 1e-2, rtol=2e-5)
    batch = jax.jit(jax.vmap(number))(jnp.stack([p, 0.9 * p]))
    np.testing.assert_allclose(batch, [solve(p)[0], solve(0.9 * p)[0]], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["volume", "gas"])
def test_models_agree(kind):
    control, options, value = KINDS[kind]
    scene = driven(control, loads=LOADS, **options)
    models = (
        vsr.StrainDependent(24),
        vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(8))),
        vsr.Continuum(rtol=1e-10, atol=1e-12),
    )
    found = [vsr.solve(scene, [value], model=model, throw=True) for model in models]
    for other in found[1:]:
        np.testing.assert_allclose(other.tip, found[0].tip, atol=1e-7)
        np.testing.assert_allclose(other.forces, found[0].forces, rtol=1e-6)


def test_the_precision_is_that_of_the_inputs(dtype):
    for control, options, value in KINDS.values():
        scene = driven(control, loads=LOADS, **options)
        eq = vsr.solve(scene, jnp.array([value], dtype), model=STEPS, throw=True)
        exact = vsr.solve(scene, jnp.array([value]), model=STEPS, throw=True)
        assert eq.tip.dtype == dtype
        np.testing.assert_allclose(eq.tip, exact.tip, atol=1e5 * float(jnp.finfo(dtype).eps))


def test_scene_files_keep_them():
    for control, options, _ in KINDS.values():
        scene = driven(control, **options)
        again = parse_scene(to_toml(scene)).scene
        assert repr(again) == repr(scene)
        assert f"{control} control" in again.effects


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: driven("flow"), "Chamber.control: got 'flow', need"),
        (
            lambda: driven("pressure", compliance=1e-12),
            "Chamber.compliance: got 1e-12 with control",
        ),
        (lambda: driven("volume", dead_volume=1e-6), "Chamber.dead_volume: got 1e-06 with control"),
        (lambda: driven("volume", compliance=-1.0), "Chamber.compliance: got -1.0, need"),
        (lambda: driven("gas", atmosphere=0.0), "Chamber.atmosphere: got 0.0, need"),
        (lambda: vsr.solve(driven("gas"), [-1e-6]), "inputs[0]: got -1e-06, need a finite number"),
    ],
)
def test_bad_chambers_are_refused(make, message, unchecked):
    with pytest.raises(ValueError) as told:  # noqa: PT011
        make()
    assert str(told.value).startswith(message)


@pytest.mark.slow
def test_shapes_without_weight_tell_only_the_ratio_of_modulus_and_area():
    """A public case: with chambers of 6.236e-5 m^2 in place of the 1.2828e-4 m^2 that were made,
    the modulus comes out at 0.486 of the truth."""
    angles = np.arange(3) * 2 * np.pi / 3
    paths = [vsr.Parallel(0.02 * np.cos(t), 0.02 * np.sin(t)) for t in angles]
    rod = vsr.Rod(0.2, vsr.Circular(0.03), vsr.Material(1.0766e6, poisson=0.5, density=1104.0))
    scene = vsr.Scene(rod, [vsr.Chamber(path, 1.2828e-4) for path in paths])
    pressures = np.array([[2e5, 0.0, 0.0], [1e5, 2e5, 0.0], [0.5e5, 1e5, 3e5]])
    stations = np.array([0.1, 0.2])
    model = vsr.StrainDependent(4)
    shapes = [vsr.solve(scene, u, model=model).position(stations) for u in pressures]
    data = vsr.Measurements(pressures, vsr.Markers(np.stack(shapes), stations, sd=1e-4))
    unknown = {
        "rod.material.young": (2e5, 5e6),
        "actuators[*].area": vsr.Unknown(2e-5, 8e-4, shared=True),
    }
    assumed = scene.replace({"rod.material.young": 5e5, "actuators[*].area": 6.236e-5})
    found = vsr.fit(assumed, unknown, data, model=model, progress=False)
    numbers = {name: one.value for name, one in found.numbers.items()}
    ratio = numbers["rod.material.young"] / numbers["actuators[*].area"]
    np.testing.assert_allclose(6.236e-5 * ratio / 1.0766e6, 0.486, atol=2e-4)
    (sentence,) = found.undetermined
    assert "rod.material.young" in sentence
    assert "actuators[*].area" in sentence
