"""Arms of rubber: bars that are pulled, bent and twisted, derivatives, files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import checked_derivative
from scipy.optimize import brentq, fsolve

import vsr_jax as vsr
from vsr_jax.files.scene_file import parse_scene, to_toml
from vsr_jax.solution.plausible_strain import strain_warnings
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
    """$M = EI/3 (s^{-1} + 2 s^{-4}) k$, $0 = EA/3 (s - s^{-2}) - EI/6 k^2 (s^{-2} + 8 s^{-5})$."""
    moment = 0.3 * EI / RADIUS

    def off(x):
        s, k = x
        axial = EA / 3 * (s - s**-2) - EI / 6 * k**2 * (s**-2 + 8 * s**-5)
        return axial / EA, (EI / 3 * (1 / s + 2 / s**4) * k - moment) / moment

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


def energy_of_material(constants, stretch, bend, twist, shear):
    """Energy per length [J/m] of a round bar of Mooney-Rivlin material in three dimensions, by
    minimization over maps of the section, polynomials of third degree in its plane. The axis
    follows the mean of the section; the material is compressed by a ten-thousandth of its strain.
    """
    points, weights = np.polynomial.legendre.leggauss(6)
    radii, angles = 0.5 * RADIUS * (points + 1), np.arange(12) * np.pi / 6
    y, z = (np.outer(radii, f(angles)).ravel() for f in (np.cos, np.sin))
    weight = np.repeat(0.5 * RADIUS * weights * radii, 12) * np.pi / 6
    powers = [(i, j) for i in range(4) for j in range(4 - i) if i + j > 0]
    values = np.stack([y**i * z**j / RADIUS ** (i + j - 1) for i, j in powers], axis=1)
    values -= weight @ values / weight.sum()  # the mean stays in the axis
    along_y, along_z = (
        np.stack([d(i, j) / RADIUS ** (i + j - 1) for i, j in powers], axis=1)
        for d in (
            lambda i, j: i * y ** max(i - 1, 0) * z**j,
            lambda i, j: j * y**i * z ** max(j - 1, 0),
        )
    )
    c1, c2 = constants
    bulk = 6e4 * (c1 + c2)

    def energy(q):
        qy, qz = q.reshape(2, -1)
        py, pz = values @ qy, values @ qz
        zero = jnp.zeros_like(py)
        axial = (stretch + bend * pz, shear - twist * pz, twist * py)
        columns = (axial, (zero, along_y @ qy, along_y @ qz), (zero, along_z @ qy, along_z @ qz))
        F = jnp.stack([jnp.stack(column, axis=-1) for column in columns], axis=-1)
        C, J = F.mT @ F, jnp.log(jnp.linalg.det(F))
        I1 = jnp.trace(C, axis1=1, axis2=2)
        I2 = 0.5 * (I1**2 - jnp.trace(C @ C, axis1=1, axis2=2))
        turn = qy[powers.index((0, 1))] - qz[powers.index((1, 0))]  # the section is round
        compressed = 0.5 * bulk * J**2 - 2 * (c1 + 2 * c2) * J
        return weight @ (c1 * (I1 - 3) + c2 * (I2 - 3) + compressed + bulk * turn**2)

    slope, curvature = jax.jit(jax.grad(energy)), jax.jit(jax.hessian(energy))
    start = np.zeros((2, len(powers)))
    start[0, powers.index((1, 0))] = start[1, powers.index((0, 1))] = stretch**-0.5
    q = start.ravel()
    for _ in range(5):
        q = q - np.linalg.solve(curvature(q), slope(q))
    np.testing.assert_allclose(slope(q), 0.0, atol=1e-9 * bulk * AREA)
    return float(energy(q))


@pytest.mark.parametrize("stretch", [0.7, 1.0, 1.6])
@pytest.mark.parametrize("share", [0.0, 0.4])
def test_the_energy_is_that_of_the_material_in_three_dimensions(stretch, share):
    """Bent, twisted and sheared a little while it is stretched, with a share of $C_2$."""
    c1, c2 = (1 - share) * YOUNG / 6, share * YOUNG / 6
    rubber = vsr.Ogden((2 * c1, -2 * c2), (2.0, -2.0)) if share else RUBBER
    section = vsr.Circular(RADIUS)
    law, stiffness = rubber.law(section, 0.0, LENGTH), rubber.stiffness(section, 0.0, LENGTH)

    def of_law(bend, twist, shear):
        strain = [jnp.asarray(float(x)) for x in (twist, bend, 0, stretch - 1, shear, 0)]
        return float(law.energy(tuple(strain), stiffness))

    at_rest = [
        f(0.0, 0.0, 0.0) for f in (of_law, lambda *x: energy_of_material((c1, c2), stretch, *x))
    ]
    np.testing.assert_allclose(at_rest[0], at_rest[1], rtol=1e-3, atol=1e-4)
    for strain in ((0.05, 0.0, 0.0), (0.0, 0.05, 0.0), (0.0, 0.0, 5e-4)):
        changes = (
            of_law(*strain) - at_rest[0],
            energy_of_material((c1, c2), stretch, *strain) - at_rest[1],
        )
        np.testing.assert_allclose(changes[0], changes[1], rtol=1e-3)


@pytest.mark.parametrize("stretch", [0.6, 0.9999, 1.0, 1.0001, 1.5, 4.0])
def test_an_ogden_bar_is_pulled(stretch):
    """$N = A \\sum \\mu (s^{\\alpha - 1} - s^{-\\alpha / 2 - 1})$, with Ogden's own three terms."""
    moduli, exponents = np.array([6.3e5, 1.2e3, -1e4]), np.array([1.3, 5.0, -2.0])
    force = AREA * moduli @ (stretch ** (exponents - 1) - stretch ** (-exponents / 2 - 1))
    rod = vsr.Rod(LENGTH, vsr.Circular(RADIUS), vsr.Ogden(moduli, exponents))
    scene = vsr.Scene(rod, vsr.Thread(vsr.Parallel(0.0, 0.0)))
    eq = vsr.solve(scene, [force], model=STEPS, throw=True)
    np.testing.assert_allclose(eq.tip[0, 3], stretch * LENGTH, rtol=1e-9)


def test_the_neo_hookean_law_is_one_term_of_ogdens():
    ogden = vsr.Ogden((YOUNG / 3,), (2.0,))
    section = vsr.Circular(RADIUS)
    laws = [x.law(section, 0.0, LENGTH) for x in (RUBBER, ogden)]
    stiffness = ogden.stiffness(section, 0.0, LENGTH)
    for stretched in (-0.4, -1e-3, 0.0, 1e-9, 0.15, 2.0):
        strain = tuple(jnp.asarray(x) for x in (1.0, 2.0, 3.0, stretched, 0.1, 0.2))
        found = [(x.energy(strain, stiffness), x.wrench(strain, stiffness)) for x in laws]
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12), *found)
        tangents = [x.tangent(strain, stiffness) for x in laws]
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9), *tangents)


@pytest.mark.parametrize("rubber", [RUBBER, vsr.Ogden((4e5, 1e3, -1e4), (1.7, 5.0, -2.0))])
def test_wrench_and_tangent_are_derivatives_of_the_energy(rubber):
    section = vsr.Circular(RADIUS)
    law, stiffness = rubber.law(section, 0.0, LENGTH), rubber.stiffness(section, 0.0, LENGTH)

    def energy(x):
        return law.energy(tuple(x), stiffness)

    for stretched in (-0.4, 0.0, 0.7):
        x = jnp.array([5.0, -3.0, 8.0, stretched, 0.1, -0.2])
        np.testing.assert_allclose(
            law.wrench(tuple(x), stiffness), jax.grad(energy)(x), rtol=1e-9, atol=1e-12
        )
        rows = law.tangent(tuple(x), stiffness)
        lower = jnp.tril(jax.hessian(energy)(x))
        for i, row in enumerate(rows):
            np.testing.assert_allclose(jnp.stack(row), lower[i, : i + 1], rtol=1e-9, atol=1e-9)


def test_an_inflated_bar_becomes_longer():
    """A tube with fibres around it: $p a = EA/3 (s - s^{-2})$ with the area $A$ of its wall."""
    wall = np.pi * (RADIUS**2 - 0.004**2)
    pressure = YOUNG / 3 * wall * (1.3 - 1.3**-2) / (np.pi * 0.004**2)
    rod = vsr.Rod(LENGTH, vsr.Annular(RADIUS, 0.004), RUBBER)
    chamber = vsr.Chamber(vsr.Parallel(0.0, 0.0), np.pi * 0.004**2)
    eq = vsr.solve(vsr.Scene(rod, chamber), [pressure], model=STEPS, throw=True)
    np.testing.assert_allclose(eq.tip[0, 3], 1.3 * LENGTH, rtol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((), ()), r"Ogden.shear_moduli: got shape \(0,\), need a list of numbers"),
        (((1e5, 1e5), (2.0,)), r"Ogden.exponents: .* shape \(2,\)"),
        (((1e5,), (0.0,)), r"Ogden.exponents: got \[0.0\], need numbers other than 0"),
        (((1e5,), (-2.0,)), r"Ogden: got a Young's modulus of -300000 Pa"),
    ],
)
def test_ogden_says_what_is_wrong(arguments, message):
    with pytest.raises(ValueError, match=message):
        vsr.Ogden(*arguments)


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
    told = [strain_warnings(vsr.solve(x, [], model=STEPS)) for x in scenes]
    assert len(told[0]) == 1
    assert told[1] == ()
    assert "stress" not in colorings_of(vsr.Scene(ROD))


@pytest.mark.parametrize("rubber", [RUBBER, vsr.Ogden((4e5, -1e4), (2.0, -2.0), density=1000.0)])
def test_scene_files_keep_rubber(rubber):
    scene = vsr.Scene(vsr.Rod(LENGTH, vsr.Circular(RADIUS), rubber))
    text = to_toml(scene)
    assert f'type = "{type(rubber).__name__}"' in text
    assert repr(parse_scene(text).scene) == repr(scene)
