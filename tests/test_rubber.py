"""Arms of neo-Hookean rubber: bars that are pulled, bent and twisted, derivatives, files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import checked_derivative
from scipy.integrate import dblquad
from scipy.optimize import brentq, fsolve

import vsr_jax as vsr
from vsr_jax.analysis import plausible
from vsr_jax.arm.section_law import NeoHookeanLaw
from vsr_jax.files.scene_file import parse_scene, to_toml
from vsr_jax.viewer.coloring import colorings_of

LENGTH, RADIUS, YOUNG = 0.3, 0.01, 1e6
AREA, MOMENT = np.pi * RADIUS**2, np.pi * RADIUS**4 / 4
EA, EI, GJ = YOUNG * AREA, YOUNG * MOMENT, YOUNG / 3 * 2 * MOMENT
RUBBER = vsr.NeoHookean(YOUNG, density=1000.0)
ROD = vsr.Rod(LENGTH, vsr.Circular(RADIUS), RUBBER)
STEPS = vsr.StrainDependent(4)


def loaded(**wrench):
    """The strain of a short bar under a wrench at its tip, which turns with it."""
    rod = vsr.Rod(3 * RADIUS, vsr.Circular(RADIUS), RUBBER)
    scene = vsr.Scene(rod, loads=vsr.TipWrench(frame="body", **wrench))
    return vsr.solve(scene, [], model=STEPS, throw=True).strain(RADIUS)


@pytest.mark.parametrize("stretch", [0.5, 0.8, 1.2, 1.5, 3.0])
def test_a_bar_is_pulled_and_pressed(stretch):
    """$N = EA/3 (s - s^{-2})$, 0.352 EA at s = 1.5; pressed ones are held straight."""
    force = EA / 3 * (stretch - stretch**-2)
    if stretch == 1.5:
        np.testing.assert_allclose(force / EA, 0.352, atol=2e-4)
    scene = vsr.Scene(ROD, vsr.Thread(vsr.Parallel(0.0, 0.0)))
    eq = vsr.solve(scene, [force], model=STEPS, throw=True)
    np.testing.assert_allclose(eq.tip[0, 3], stretch * LENGTH, rtol=1e-9)


def test_bending_lets_a_bar_become_longer():
    """$M = EI/3 (1 + 2 s^{-3}) k$ and $0 = EA/3 (s - s^{-2}) - EI k^2 s^{-4}$."""
    moment = 0.3 * EI / RADIUS

    def off(x):
        s, k = x
        axial = EA / 3 * (s - s**-2) - EI * k**2 / s**4
        return axial / EA, (EI / 3 * (1 + 2 / s**3) * k - moment) / moment

    s, k = fsolve(off, (1.0, moment / EI), xtol=1e-13)
    strain = loaded(moment=(0.0, 0.0, moment))
    np.testing.assert_allclose(strain, (0, 0, k, s, 0, 0), rtol=1e-8, atol=1e-10)
    assert s > 1.02


def test_twist_lets_a_bar_become_longer():
    """Poynting's effect: $T = GJ k / s$ and $N = EA/3 (s - s^{-2}) - GJ k^2 / (2 s^2)$."""
    torque, force = 0.5 * GJ / RADIUS, 0.1 * EA

    def off(s):
        k = torque * s / GJ
        return EA / 3 * (s - s**-2) - GJ * k**2 / (2 * s**2) - force

    s = brentq(off, 0.9, 2.0, xtol=1e-14)
    strain = loaded(moment=(torque, 0, 0), force=(force, 0, 0))
    np.testing.assert_allclose(strain, (torque * s / GJ, 0, 0, s, 0, 0), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("stretch", [0.8, 1.0, 1.4])
def test_the_energy_is_that_of_the_material_in_the_section(stretch):
    """$\\frac{E}{6} \\int I_1 - 3 \\, dA$ by quadrature, with the stretch $s + k z$ of a fibre, and
    $I_1 = s^2 + 2/s + k_x^2 r^2 / s$ with twist; but for the fourth order of the strain."""

    def of_material(bend, twist):
        def density(r, angle):
            s = stretch + bend * r * np.sin(angle)
            return r * (s**2 + 2 / s + twist**2 * r**2 / s - 3)

        return YOUNG / 6 * dblquad(density, 0, 2 * np.pi, 0, RADIUS, epsabs=1e-13)[0]

    stiffness = tuple(jnp.asarray(x) for x in (GJ, EI, EI, EA, EA / 3, EA / 3))

    def of_law(bend, twist):
        strain = [jnp.asarray(float(x)) for x in (twist, bend, 0, stretch - 1, 0, 0)]
        return float(NeoHookeanLaw().energy(tuple(strain), stiffness))

    for bend, twist in ((0.0, 0.0), (2.0, 0.0), (0.0, 5.0)):
        np.testing.assert_allclose(
            of_law(bend, twist), of_material(bend, twist), rtol=1e-3, atol=1e-9
        )
        change = of_material(bend, twist) - of_material(0.0, 0.0)
        np.testing.assert_allclose(
            of_law(bend, twist) - of_law(0.0, 0.0), change, rtol=2e-3, atol=1e-9
        )


def test_small_strains_are_those_of_a_linear_material():
    linear = vsr.Rod(LENGTH, vsr.Circular(RADIUS), vsr.Material(YOUNG, poisson=0.5))
    wrench = {"force": (1e-6, 2e-6, -1e-6), "moment": (1e-7, 0.0, 0.0)}
    tips = [
        vsr.solve(vsr.Scene(rod, loads=vsr.TipWrench(**wrench)), [], model=STEPS).tip[:3, 3]
        for rod in (linear, ROD)
    ]
    straight = np.array([LENGTH, 0, 0])
    np.testing.assert_allclose(tips[1] - straight, tips[0] - straight, rtol=1e-3, atol=1e-9)


@pytest.mark.slow
def test_models_agree():
    tendon = vsr.Tendon(vsr.Helix(0.006, pitch=0.4))
    scene = vsr.Scene(ROD, tendon, [vsr.Gravity(), vsr.TipWrench(force=(0.5, 0.2, 0.3))])
    models = (
        vsr.StrainDependent(40),
        vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(13)), steps=40),
        vsr.Continuum(rtol=1e-10, atol=1e-12),
    )
    tips = [vsr.solve(scene, [30.0], model=model, throw=True).tip for model in models]
    np.testing.assert_allclose(tips[1], tips[0], atol=2e-7)
    np.testing.assert_allclose(tips[2], tips[0], atol=2e-8)


@pytest.mark.slow
def test_derivatives_in_both_modes_and_batches():
    def number(p):
        rod = vsr.Rod(LENGTH, vsr.Circular(p[1]), vsr.NeoHookean(p[0] * YOUNG, density=1000.0))
        tendon = vsr.Tendon(vsr.Parallel(0.006, 0.0))
        scene = vsr.Scene(rod, tendon, [vsr.Gravity(), vsr.TipWrench(force=(8.0, 0.2, 0.3))])
        eq = vsr.solve(scene, p[2:], model=vsr.StrainDependent(6))
        return eq.tip[:3, 3] @ jnp.array([1.0, -2.0, 3.0])

    p, scale = jnp.array([1.0, RADIUS, 20.0]), jnp.array([1e-2, 1e-5, 1e-1])
    solve, _ = checked_derivative(number, p, scale)
    batch = jax.jit(jax.vmap(number))(jnp.stack([p, 0.9 * p]))
    np.testing.assert_allclose(batch, [solve(p)[0], solve(0.9 * p)[0]], rtol=1e-9)


def test_large_strains_are_no_reason_to_doubt_rubber():
    """As they are with a linear material."""
    linear = vsr.Rod(LENGTH, vsr.Circular(RADIUS), vsr.Material(YOUNG, poisson=0.5))
    pull = vsr.TipWrench(force=(EA, 0, 0))
    scenes = [vsr.Scene(rod, loads=pull, free_strains="elongation") for rod in (linear, ROD)]
    told = [plausible.strain_warnings(vsr.solve(x, [], model=STEPS)) for x in scenes]
    assert len(told[0]) == 1
    assert told[1] == ()
    assert "stress" not in colorings_of(vsr.Scene(ROD))


def test_scene_files_keep_rubber():
    scene = vsr.Scene(ROD)
    text = to_toml(scene)
    assert 'type = "NeoHookean"' in text
    assert repr(parse_scene(text).scene) == repr(scene)
