"""Arms whose stiffness is given: closed forms, the same arm about another axis, bad matrices."""

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import checked_derivative
from scipy.integrate import quad

import vsr_jax as vsr
from vsr_jax.files.scene_file import parse_scene, to_toml
from vsr_jax.viewer.coloring import colorings_of

LENGTH, RADIUS, DENSITY = 0.3, 0.01, 1000.0
MATERIAL = vsr.Material(1e6, poisson=0.45, density=DENSITY)
DISC = vsr.Circular(RADIUS)
DIAGONAL = [float(x) for x in vsr.Rod(LENGTH, DISC, MATERIAL).stiffness(0.1)]
MASS = DENSITY * np.pi * RADIUS**2
LOADS = vsr.Gravity(), vsr.TipWrench(force=(0.01, 0.02, 0.03))
STEPS = vsr.StrainDependent(8)


def loaded(material, **options):
    """The arm with a tendon, its weight and a force."""
    rod = vsr.Rod(LENGTH, DISC, material)
    return vsr.Scene(rod, vsr.Tendon(vsr.Helix(0.007, pitch=0.4)), LOADS, **options)


def tip(scene, inputs=(1.0,), model=STEPS):
    return np.asarray(vsr.solve(scene, inputs, model=model, throw=True).tip)


def numbers():
    """The stiffness of the arm, number by number."""
    GJ, EI_y, EI_z, EA, GA_y, GA_z = DIAGONAL
    return vsr.Stiffness(EI_y, EI_z, GJ, EA, GA_y, GA_z, mass=MASS)


@pytest.mark.parametrize(
    "given",
    [
        numbers,
        lambda: vsr.Stiffness(matrix=np.diag(DIAGONAL), mass=MASS),
        lambda: vsr.Stiffness(matrix=lambda X: jnp.diag(jnp.array(DIAGONAL)), mass=MASS),
    ],
)
def test_given_numbers_are_those_of_the_material(given):
    np.testing.assert_allclose(tip(loaded(given())), tip(loaded(MATERIAL)), atol=1e-12)


def test_what_has_no_stiffness_does_not_change():
    free = "bending_y", "bending_z"
    scene = loaded(vsr.Stiffness(DIAGONAL[1], mass=MASS))
    assert scene.free_strains == free
    np.testing.assert_allclose(tip(scene), tip(loaded(MATERIAL, free_strains=free)), atol=1e-12)


def moved(offset):
    """A pose of an axis that is moved in the section, and the matrix that takes the arm's strains
    $(k, u)$ to those of that axis."""
    d = np.array([0.0, *offset])
    cross = np.array([[0, -d[2], d[1]], [d[2], 0, -d[0]], [-d[1], d[0], 0]])
    pose, strains = np.eye(4), np.eye(6)
    pose[:3, 3], strains[3:, :3] = d, -cross
    return pose, strains


CONTINUUM = vsr.Continuum(rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("model", [STEPS, pytest.param(CONTINUUM, marks=pytest.mark.slow)])
def test_a_full_matrix_is_the_same_arm_about_another_axis(model):
    """With $\\xi' = A \\xi$ the matrix about the other axis is $A^{-T} \\Sigma A^{-1}$, which
    couples stretch, bending and twist; and a wrench $w$ in the body frame becomes $A^{-T} w$."""
    wrench = np.array([0.004, -0.01, 0.006, 0.3, 0.02, 0.03])
    place, strains = moved((0.004, -0.003))
    back = np.linalg.inv(strains)
    around = back.T @ wrench
    load = vsr.TipWrench(moment=wrench[:3], force=wrench[3:], frame="body")
    other = vsr.TipWrench(moment=around[:3], force=around[3:], frame="body")
    matrix = back.T @ np.diag(DIAGONAL) @ back
    assert np.max(np.abs(matrix - np.diag(np.diag(matrix)))) > 1e-3
    coupled = vsr.Rod(LENGTH, DISC, vsr.Stiffness(matrix=matrix), base=place)
    usual = vsr.Scene(vsr.Rod(LENGTH, DISC, MATERIAL), loads=load)
    fine = vsr.StrainDependent(24) if isinstance(model, vsr.StrainDependent) else model
    found = tip(vsr.Scene(coupled, loads=other), (), fine)
    np.testing.assert_allclose(found, tip(usual, (), fine) @ place, atol=1e-9)


def test_a_twisted_rope_turns_as_it_is_pulled():
    """Stretch and twist of a straight arm, coupled by $c$: $(k, e) = \\Sigma^{-1} (0, N)$."""
    pull, GJ, EA, c = 3.0, 2e-3, 50.0, 0.1
    matrix = np.diag([GJ, 1e-3, 1e-3, EA, 20.0, 20.0])
    matrix[0, 3] = matrix[3, 0] = c
    twist, stretch = np.linalg.solve([[GJ, c], [c, EA]], [0.0, pull])
    rod = vsr.Rod(LENGTH, DISC, vsr.Stiffness(matrix=matrix))
    end = tip(vsr.Scene(rod, loads=vsr.TipWrench(force=(pull, 0, 0))), ())
    np.testing.assert_allclose(end[:3, 3], (LENGTH * (1 + stretch), 0, 0), atol=1e-12)
    np.testing.assert_allclose(np.arctan2(end[2, 1], end[1, 1]), twist * LENGTH, rtol=1e-10)


def test_a_shaft_given_by_its_stiffness():
    """A shaft that becomes slender towards its tip, with a force so small that the deflection is
    $\\int M (L - X) / EI \\, dX$."""
    force, ends = 1e-6, [0.7, 0.95, 1.0]
    EI = vsr.Piecewise(
        ends[:-1],
        [3e-3, lambda X: jnp.interp(X, jnp.array(ends[:2]), jnp.array([3e-3, 1.5e-4])), 1.5e-4],
    )
    GJ = vsr.Piecewise(
        ends[:-1],
        [3e-3, lambda X: jnp.interp(X, jnp.array(ends[:2]), jnp.array([3e-3, 3e-4])), 3e-4],
    )
    shaft = vsr.Rod(1.0, vsr.Circular(2e-3), vsr.Stiffness(EI, GJ=GJ))
    eq = vsr.solve(
        vsr.Scene(shaft, loads=vsr.TipWrench(force=(0, force, 0))),
        [],
        model=vsr.StrainDependent(64),
        throw=True,
    )

    def compliance(X):
        return (1 - X) ** 2 / np.interp(X, ends[:2], [3e-3, 1.5e-4])

    exact = force * sum(quad(compliance, a, b)[0] for a, b in zip([0, *ends], ends, strict=False))
    np.testing.assert_allclose(eq.tip[1, 3], exact, rtol=2e-6)
    np.testing.assert_allclose(1e-4 / force * eq.tip[1, 3], 11.339e-3, rtol=1e-4)  # published


@pytest.mark.slow
def test_gradients_by_every_number():
    """In both modes, by the six numbers, the mass and an entry of the matrix."""

    def of_numbers(p):
        GJ, EI_y, EI_z, EA, GA_y, GA_z, mass = p[:7] * jnp.array([*DIAGONAL, MASS])
        coupling = jnp.zeros((6, 6)).at[1, 3].set(p[7]).at[3, 1].set(p[7])
        matrix = jnp.diag(jnp.stack([GJ, EI_y, EI_z, EA, GA_y, GA_z])) + coupling
        materials = (
            vsr.Stiffness(EI_y, EI_z, GJ, EA, GA_y, GA_z, mass=mass),
            vsr.Stiffness(matrix=matrix, mass=mass),
        )
        ends = [vsr.solve(loaded(x), jnp.array([1.0]), model=STEPS).tip for x in materials]
        return jnp.stack([end[:3, 3] @ jnp.array([1.0, -2.0, 3.0]) for end in ends])

    p, scale = jnp.array([1.0] * 7 + [0.1]), jnp.array([1e-2] * 7 + [1e-3])
    _, forward = checked_derivative(of_numbers, p, scale, zero=1e-12)
    assert np.all(np.abs(forward[1]) > 1e-7)


def test_scene_files_keep_stiffness():
    matrix = np.diag(DIAGONAL)
    matrix[1, 3] = matrix[3, 1] = 0.01
    for material in (numbers(), vsr.Stiffness(2e-3), vsr.Stiffness(matrix=matrix, mass=MASS)):
        loads = LOADS if material.weighs else ()
        scene = vsr.Scene(vsr.Rod(LENGTH, DISC, material), loads=loads)
        again = parse_scene(to_toml(scene)).scene
        assert to_toml(again) == to_toml(scene)
        assert repr(again) == repr(scene)


def test_stress_is_offered_where_moduli_are_known():
    assert "stress" in colorings_of(loaded(MATERIAL))
    assert "stress" not in colorings_of(loaded(numbers()))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: vsr.Stiffness(), "Stiffness: got no stiffness, need EI_y and others, or a matrix"),
        (lambda: vsr.Stiffness(GJ=1.0), "Stiffness: got GJ, need EI_y and others, or a matrix"),
        (lambda: vsr.Stiffness(1.0, matrix=np.eye(6)), "Stiffness: got EI_y and a matrix, need"),
        (lambda: vsr.Stiffness(1.0, GA_z=2.0), "Stiffness: got GA_z without GA_y, need both or"),
        (lambda: vsr.Stiffness(-1.0), "Stiffness.EI_y: got -1.0, need a finite number > 0"),
        (lambda: vsr.Stiffness(matrix=np.eye(5)), "Stiffness.matrix: got shape (5, 5), need"),
        (lambda: vsr.Stiffness(matrix=np.tri(6)), "Stiffness.matrix: got a matrix that is not sym"),
        (
            lambda: loaded(vsr.Stiffness(matrix=2 * np.eye(6) - np.ones((6, 6)), mass=1.0)),
            "Scene.rod.material.matrix (its least eigenvalue, scaled): got -4 at X = 0 m, need a",
        ),
        (
            lambda: loaded(vsr.Stiffness(1.0, mass=1.0), free_strains="torsion"),
            "Scene.free_strains: got 'torsion' and a rod without stiffness for torsion, elongation",
        ),
        (lambda: loaded(vsr.Stiffness(1.0)), "Scene.loads: got a Gravity and a rod whose material"),
    ],
)
def test_bad_stiffness_is_refused(make, message, unchecked):
    with pytest.raises(ValueError) as told:  # noqa: PT011
        make()
    assert str(told.value).startswith(message)
