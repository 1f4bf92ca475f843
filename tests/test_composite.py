"""Sections of several materials: bores, wires and layers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import checked_derivative

import vsr_jax as vsr
from vsr_jax.files.scene_file import parse_scene, to_toml

LENGTH, RADIUS = 0.3, 0.01
SOFT = vsr.Material(1e6, poisson=0.5, density=1000.0)
STIFF = vsr.Material(5e7, poisson=0.3, density=8000.0)
CIRCLE = vsr.Circular(RADIUS)
AXIS = vsr.Parallel(0.0, 0.0)
AREA, MOMENT = np.pi * RADIUS**2, np.pi * RADIUS**4 / 4
STEPS = vsr.StrainDependent(4)


def bent(material, **wrench):
    """The strain at the tip of a short bar, under a wrench there that turns with it."""
    rod = vsr.Rod(3 * RADIUS, CIRCLE, material)
    scene = vsr.Scene(rod, loads=vsr.TipWrench(frame="body", **wrench))
    return vsr.solve(scene, [], model=STEPS, throw=True).strain(3 * RADIUS)


def sigma(material):
    return material.matrix(CIRCLE, 0.5 * LENGTH, LENGTH)


def test_a_bar_with_three_bores():
    """$EA$ loses 3 a; $EI$ loses $3 (a r^2 / 4 + a d^2 / 2)$, the same about y and z."""
    r, d = 0.002, 0.006
    a = np.pi * r**2
    angles = np.arange(3) * 2 * np.pi / 3
    bores = [vsr.Inclusion(vsr.Parallel(d * np.cos(t), d * np.sin(t)), r) for t in angles]
    matrix = sigma(vsr.Composite(SOFT, bores))
    EA, EI = 1e6 * (AREA - 3 * a), 1e6 * (MOMENT - 3 * (a * r**2 / 4 + a * d**2 / 2))
    GA, GJ = EA / 3, 2 * EI / 3
    np.testing.assert_allclose(matrix, np.diag([GJ, EI, EI, EA, GA, GA]), rtol=1e-12, atol=1e-12)
    strain = bent(vsr.Composite(SOFT, bores), moment=(0.0, 0.1, 0.0))
    np.testing.assert_allclose(strain, (0, 0.1 / EI, 0, 1, 0, 0), rtol=1e-9, atol=1e-9)


def test_a_wire_to_one_side_bends_a_bar_that_is_pulled():
    """The force acts at a distance from the neutral axis, $e = \\Delta EA \\, d / EA$, and $EI$
    about that is what the parallel axis theorem says."""
    r, d, force = 0.001, 0.006, 20.0
    a, more = np.pi * r**2, 5e7 - 1e6
    wire = vsr.Inclusion(vsr.Parallel(0.0, d), r, STIFF)
    EA = 1e6 * AREA + more * a
    e = more * a * d / EA
    EI = 1e6 * MOMENT + more * (a * r**2 / 4 + a * d**2) - EA * e**2
    strain = bent(vsr.Composite(SOFT, wire), force=(force, 0.0, 0.0))
    curvature = -force * e / EI  # about y, to which the wire lies in the direction of z
    np.testing.assert_allclose(strain[1], curvature, rtol=1e-9)
    np.testing.assert_allclose(strain[3] - 1, force / EA - curvature * e, rtol=1e-9)


def test_the_energy_is_the_integral_over_the_section():
    """$\\frac12 \\int E \\epsilon^2 + G \\gamma^2 \\, dA$ by quadrature, of any strain."""
    discs = ((0.004, 0.003, 0.002, 0.0, 0.0), (-0.005, 0.001, 0.0015, 5e7, 5e7 / 2.6))
    inclusions = [
        vsr.Inclusion(vsr.Parallel(y, z), r, STIFF if E else None) for y, z, r, E, G in discs
    ]
    points, weights = np.polynomial.legendre.leggauss(8)
    angles = np.arange(16) * np.pi / 8

    def of_disc(y0, z0, radius, E, G, strain):
        rho = 0.5 * radius * (points + 1)
        y, z = y0 + np.outer(rho, np.cos(angles)), z0 + np.outer(rho, np.sin(angles))
        kx, ky, kz, ux, uy, uz = strain
        density = E * (ux + ky * z - kz * y) ** 2 + G * ((uy - kx * z) ** 2 + (uz + kx * y) ** 2)
        return 0.5 * (0.5 * radius * weights * rho) @ density.sum(axis=1) * np.pi / 8

    matrix = sigma(vsr.Composite(SOFT, inclusions))
    for strain in np.random.default_rng(0).normal(size=(5, 6)) * (20, 20, 20, 0.1, 0.1, 0.1):
        total = of_disc(0, 0, RADIUS, 1e6, 1e6 / 3, strain)
        for y, z, r, E, G in discs:
            total += of_disc(y, z, r, E - 1e6, G - 1e6 / 3, strain)
        np.testing.assert_allclose(0.5 * strain @ matrix @ strain, total, rtol=1e-10)


def test_layers_are_tubes_in_each_other():
    core = vsr.Inclusion(AXIS, 0.004)
    layered = vsr.Composite(SOFT, vsr.Inclusion(AXIS, 0.006, vsr.Composite(STIFF, core)))
    outer, inner = vsr.Annular(RADIUS, 0.006), vsr.Annular(0.006, 0.004)
    expected = [
        a + b
        for a, b in zip(
            SOFT.stiffness(outer, 0.1, LENGTH), STIFF.stiffness(inner, 0.1, LENGTH), strict=True
        )
    ]
    np.testing.assert_allclose(sigma(layered), np.diag(expected), rtol=1e-12, atol=1e-12)
    mass = 1000 * np.pi * (0.01**2 - 0.006**2) + 8000 * np.pi * (0.006**2 - 0.004**2)
    np.testing.assert_allclose(layered.mass_per_length(CIRCLE, 0.1, LENGTH), mass, rtol=1e-12)


def test_a_bore_is_as_long_as_its_chamber():
    chamber = vsr.Chamber(vsr.Parallel(0.005, 0.0), 2e-5, start=0.1, end=0.2)
    bored = vsr.Composite(SOFT, vsr.Inclusion.of(chamber))
    axial = [float(bored.stiffness(CIRCLE, X, LENGTH)[3]) for X in (0.05, 0.15, 0.25)]
    solid = 1e6 * AREA
    np.testing.assert_allclose(axial, (solid, solid - 20.0, solid), rtol=1e-12)
    np.testing.assert_allclose(bored.breakpoints, (0.1, 0.2))
    with pytest.raises(ValueError, match=r"Inclusion.of: got a Tendon, need a Chamber"):
        vsr.Inclusion.of(vsr.Tendon(AXIS))


def test_a_lined_lumen_is_as_long_as_its_ends_say():
    liner = vsr.Composite(STIFF, vsr.Inclusion(AXIS, 0.001))
    lumen = vsr.Composite(SOFT, vsr.Inclusion(AXIS, 0.002, liner, start=0.1, end=0.2))
    axial = [float(lumen.stiffness(CIRCLE, X, LENGTH)[3]) for X in (0.05, 0.15, 0.25)]
    outside, wall = 1e6 * AREA, np.pi * (0.002**2 - 0.001**2)
    lined = 1e6 * (AREA - np.pi * 0.002**2) + 5e7 * wall
    np.testing.assert_allclose(axial, (outside, lined, outside), rtol=1e-12)
    mass = [float(lumen.mass_per_length(CIRCLE, X, LENGTH)) for X in (0.05, 0.15)]
    heavy = 1000 * (AREA - np.pi * 0.002**2) + 8000 * wall
    np.testing.assert_allclose(mass, (1000 * AREA, heavy), rtol=1e-12)


def test_chambers_that_follow_each_other_have_a_bore_each():
    ends = {"end": 0.15}, {"start": 0.15}
    chambers = [vsr.Chamber(vsr.Parallel(0.005, 0.0), 2e-5, **one) for one in ends]
    bored = vsr.Composite(SOFT, [vsr.Inclusion.of(chamber) for chamber in chambers])
    scene = vsr.Scene(vsr.Rod(LENGTH, CIRCLE, bored), chambers)
    axial = [float(scene.rod.stiffness(X)[3]) for X in (0.1, 0.2)]
    np.testing.assert_allclose(axial, 1e6 * AREA - 20.0, rtol=1e-12)


@pytest.mark.parametrize("torsion", ["saint_venant", "polar"])
def test_bores_of_a_strip_leave_a_share_of_its_torsion(torsion):
    """By the bores' share of the polar moment; factors of shear do not change it."""
    bores = [vsr.Inclusion(vsr.Parallel(y, 0.0), 0.001) for y in (-0.018, 0.018)]
    strip = vsr.Rectangular(0.04, 0.004, torsion=torsion, shear_correction=(0.8, 0.9))
    shape, a = strip.geometry(0.1, LENGTH), np.pi * 0.001**2
    polar = shape.moment_y + shape.moment_z
    lost = 2 * (a * 0.001**2 / 2 + a * 0.018**2)
    matrix = vsr.Composite(SOFT, bores).matrix(strip, 0.1, LENGTH)
    GJ = 1e6 / 3 * float(shape.torsion) * (1 - lost / polar)
    np.testing.assert_allclose(matrix[0, 0], GJ, rtol=1e-12)
    np.testing.assert_allclose(matrix[4, 4], 0.8e6 / 3 * (shape.area - 2 * a), rtol=1e-12)
    assert np.linalg.eigvalsh(matrix)[0] > 0


@pytest.mark.slow
def test_models_agree():
    wire = vsr.Inclusion(vsr.Helix(0.006, pitch=0.3), 0.001, STIFF)
    rod = vsr.Rod(LENGTH, CIRCLE, vsr.Composite(SOFT, wire))
    scene = vsr.Scene(rod, vsr.Tendon(vsr.Parallel(0.0, 0.008)), vsr.Gravity())
    models = (
        vsr.StrainDependent(40),
        vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(13)), steps=40),
        vsr.Continuum(rtol=1e-10, atol=1e-12),
    )
    tips = [vsr.solve(scene, [1.0], model=model, throw=True).tip for model in models]
    np.testing.assert_allclose(tips[1], tips[0], atol=1e-7)
    np.testing.assert_allclose(tips[2], tips[0], atol=1e-8)


@pytest.mark.slow
def test_derivatives_by_every_number():
    def number(p):
        stiff = vsr.Material(p[0] * 5e7, shear=p[1] * 2e7, density=p[2] * 8000.0)
        wire = vsr.Inclusion(vsr.Parallel(p[3] * 0.006, 0.001), p[4] * 0.001, stiff)
        bore = vsr.Inclusion(vsr.Parallel(-0.004, p[5] * 0.002), p[6] * 0.002)
        rod = vsr.Rod(LENGTH, CIRCLE, vsr.Composite(SOFT, [wire, bore]))
        loads = [vsr.Gravity(), vsr.TipWrench(force=(1.0, 0.02, 0.03), moment=(0.01, 0.0, 0.0))]
        scene = vsr.Scene(rod, vsr.Tendon(vsr.Parallel(0.006, 0.0)), loads)
        eq = vsr.solve(scene, [1.0], model=vsr.StrainDependent(6))
        return eq.tip[:3, 3] @ jnp.array([1.0, -2.0, 3.0])

    solve, _ = checked_derivative(number, jnp.ones(7), jnp.full(7, 1e-3))
    batch = jax.jit(jax.vmap(number))(jnp.array([[1.0] * 7, [0.9] * 7]))
    np.testing.assert_allclose(
        batch, [solve(jnp.ones(7))[0], solve(jnp.full(7, 0.9))[0]], rtol=1e-9
    )


def test_scene_files_keep_composites():
    chamber = vsr.Chamber(vsr.Parallel(0.005, 0.0), 2e-5, start=0.1, end=0.2)
    liner = vsr.Composite(STIFF, vsr.Inclusion(AXIS, 0.001))
    material = vsr.Composite(SOFT, [vsr.Inclusion.of(chamber), vsr.Inclusion(AXIS, 0.002, liner)])
    scene = vsr.Scene(vsr.Rod(LENGTH, CIRCLE, material), chamber)
    assert repr(parse_scene(to_toml(scene)).scene) == repr(scene)


@pytest.mark.parametrize(
    ("inclusions", "message"),
    [
        (
            [vsr.Inclusion(vsr.Parallel(0.0095, 0.0), 1e-3)],
            r"inclusions\[0\].radius: .* need a disc",
        ),
        ([vsr.Inclusion(AXIS, 1e-3)] * 2, r"inclusions\[1\].radius: .* clear of the other"),
        (
            [vsr.Inclusion(AXIS, 2e-3, vsr.Composite(STIFF, vsr.Inclusion(AXIS, 3e-3)))],
            r"inclusions\[0\].material.inclusions\[0\].radius: .* need a disc inside",
        ),
        (
            [vsr.Inclusion(AXIS, lambda X: 1e-3 - X)],
            r"inclusions\[0\].radius: got -0.299 m at X = 0.3 m, need a size > 0",
        ),
        (
            [vsr.Inclusion(AXIS, 1e-3, end=0.35)],
            r"inclusions\[0\].end: got 0.35 m, need a place on the arm of 0.3 m",
        ),
    ],
)
def test_inclusions_fit_into_the_section(inclusions, message):
    with pytest.raises(ValueError, match=message):
        vsr.Scene(vsr.Rod(LENGTH, CIRCLE, vsr.Composite(SOFT, inclusions)))


@pytest.mark.usefixtures("unchecked")
def test_what_is_no_material_is_refused():
    with pytest.raises(ValueError, match=r"Inclusion.of: got 3, need a Chamber"):
        vsr.Inclusion.of(3)
    with pytest.raises(ValueError, match=r"Inclusion.end: .* need an end beyond the start"):
        vsr.Inclusion(AXIS, 1e-3, start=0.2, end=0.1)
    tube = vsr.Annular(RADIUS, 0.004)
    filled = vsr.Rod(LENGTH, tube, vsr.Composite(SOFT, vsr.Inclusion(AXIS, 0.005)))
    with pytest.raises(ValueError, match="need a disc clear of the section's hole"):
        vsr.Scene(filled)
    with pytest.raises(ValueError, match=r"Composite.material: .* need a Material"):
        vsr.Composite(vsr.NeoHookean(1e6), [])
    with pytest.raises(ValueError, match=r"Inclusion.material: .* a Material, a Composite or None"):
        vsr.Inclusion(AXIS, 1e-3, vsr.Stiffness(1.0))
