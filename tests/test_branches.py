"""Branches of equilibria: a heavy column snaps over as its clamp rotates; Euler's column."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr

MODEL = vsr.StrainDependent(6)
PLANE = ("bending_y", "elongation", "shear_z")
SWAY = np.pi / 3  # largest angle of the clamp from the vertical


def column(s, density=478.0):
    """Planar column of weight 12 EI / L^2, above Greenhill's 7.84: unstable when upright."""
    lean = (2 * s - 1) * SWAY
    axes = jnp.array(
        [[jnp.sin(lean), 0, -jnp.cos(lean)], [0, 1, 0], [jnp.cos(lean), 0, jnp.sin(lean)]]
    )
    base = jnp.eye(4).at[:3, :3].set(axes)
    rod = vsr.Rod(
        0.4, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45, density=density), base=base
    )
    return vsr.Scene(rod, loads=[vsr.Gravity()], free_strains=PLANE)


def no_inputs(s):
    return jnp.zeros(0)


@pytest.fixture(scope="module")
def snap():
    branch = vsr.follow_branch(column, no_inputs, model=MODEL, points=80)
    tips, margin = jax.vmap(lambda eq: (eq.tip[:3, 3], eq.stability))(branch.equilibria)
    return branch, np.asarray(branch.parameter), np.asarray(tips), np.asarray(margin)


def test_the_branch_has_two_limit_points_and_ends_with_the_path(snap):
    branch, s, _, _ = snap
    assert np.all(branch.equilibria.converged)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(s))[np.diff(s) != 0]))
    assert len(turns) == 2
    assert s[0] == 0
    assert s[-1] == 1


def test_it_is_unstable_between_the_limit_points(snap):
    _, s, _, margin = snap
    falling = np.diff(s) < 0
    inside = np.flatnonzero(falling)
    assert np.all(margin[inside[1:]] < 0)
    outside = np.r_[0 : inside[0], inside[-1] + 2 : len(s)]
    assert np.all(margin[outside] > 0)


def test_it_is_symmetric(snap):
    branch, s, _, _ = snap
    lean = np.asarray(
        jax.vmap(lambda eq: jnp.arctan2(eq.tip[0, 0], eq.tip[2, 0]))(branch.equilibria)
    )
    lean = np.unwrap(lean)
    last = np.flatnonzero(np.diff(s) != 0)[-1] + 2
    assert np.all(np.diff(lean[:last]) > 0)
    mirrored = np.interp(-lean[:last], lean[:last], s[:last])
    np.testing.assert_allclose(1 - mirrored, s[:last], atol=2e-3)


def test_its_stable_equilibria_agree_with_solve(snap):
    _, s, tips, _ = snap
    single = jax.jit(lambda s: vsr.solve(column(s), no_inputs(s), model=MODEL).tip[:3, 3])
    for i in (3, 5):
        np.testing.assert_allclose(single(s[i]), tips[i], atol=1e-9)


@pytest.mark.slow
def test_derivatives_are_taken_at_fixed_parameter():
    def traced(density):
        branch = vsr.follow_branch(lambda s: column(s, density), no_inputs, model=MODEL, points=3)
        return jax.vmap(lambda eq: eq.tip[0, 3])(branch.equilibria)[1], branch.parameter[1]

    (_, s), change = jax.value_and_grad(traced, has_aux=True)(478.0)
    expected = jax.jit(
        jax.grad(lambda density: vsr.solve(column(s, density), no_inputs(s), model=MODEL).tip[0, 3])
    )(478.0)
    np.testing.assert_allclose(change, expected, rtol=1e-6)


@pytest.mark.slow
def test_all_points_have_the_status_of_a_failed_start():
    rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45))
    scene = vsr.Scene(rod, [vsr.Tendon(vsr.Parallel(0.0, 0.0))])
    branch = vsr.follow_branch(
        scene, lambda s: jnp.array([400.0]), model=MODEL, points=5
    )  # beyond EA the axis collapses
    assert np.all(branch.equilibria.status == vsr.Status.COLLAPSED)


@pytest.mark.slow
def test_both_branches_of_eulers_column_agree_with_solve():
    def ends(side):
        def pressed(s):
            rod = vsr.Rod(0.4, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45))
            critical = np.pi**2 / 4 * 1e6 * np.pi / 4 * 0.01**4 / 0.4**2
            return vsr.Scene(
                rod,
                loads=[vsr.TipWrench(force=jnp.array([-2 * critical * s, 0, side * critical]))],
                free_strains=PLANE,
            )

        branch = vsr.follow_branch(pressed, no_inputs, model=MODEL)
        assert branch.parameter[-1] == 1
        tips, margin = jax.vmap(lambda eq: (eq.tip[:3, 3], eq.stability))(branch.equilibria)
        assert np.all(margin > 0)
        assert np.min(margin) < 0.05  # near the critical load of the perfect column
        return np.asarray(tips[-1]), np.asarray(
            vsr.solve(pressed(1.0), jnp.zeros(0), model=MODEL).tip[:3, 3]
        )

    up, solved = ends(1e-3)
    down, _ = ends(-1e-3)
    np.testing.assert_allclose(up, solved, atol=1e-9)
    np.testing.assert_allclose(up, down * [1, 1, -1], atol=1e-9)


@pytest.mark.slow
def test_tensions_and_lengths_along_a_path():
    rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45, density=1000.0))
    tendons = [
        vsr.Tendon(vsr.Parallel(0.007, 0.0)),
        vsr.Tendon(vsr.Parallel(0.0, 0.007), control="length"),
    ]
    scene = vsr.Scene(rod, tendons, [vsr.Gravity()])
    branch = vsr.follow_branch(scene, lambda s: jnp.array([5.0, -0.01]) * s, model=MODEL)
    tips, forces = jax.vmap(lambda eq: (eq.tip, eq.forces))(branch.equilibria)
    end = vsr.solve(scene, [5.0, -0.01], model=MODEL)
    np.testing.assert_allclose(tips[-1], end.tip, atol=1e-9)
    np.testing.assert_allclose(forces[-1], end.forces, rtol=1e-8)


def test_a_curve_that_returns_ends_at_the_start_of_the_path():
    """From 0.45 the column leans to its limit point and back through the upright position."""
    branch = vsr.follow_branch(lambda s: column(0.45 + 0.55 * s), no_inputs, model=MODEL, points=60)
    s = np.asarray(branch.parameter)
    assert np.all(branch.equilibria.converged)
    assert s[0] == s[-1] == 0
    assert np.min(s) == 0
    assert 0.05 < np.max(s) < 0.5
    tips = np.asarray(jax.vmap(lambda eq: eq.tip[:3, 3])(branch.equilibria))
    assert np.linalg.norm(tips[0] - tips[-1]) > 0.1  # another equilibrium of the same scene


def test_points_with_inadmissible_inputs_have_that_status():
    rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45))
    scene = vsr.Scene(rod, [vsr.Tendon(vsr.Parallel(0.0, 0.008))], free_strains=PLANE)
    branch = vsr.follow_branch(scene, lambda s: jnp.array([2.0 - 4.0 * s]), model=MODEL, points=40)
    s, status = np.asarray(branch.parameter), np.asarray(branch.equilibria.status)
    assert s[-1] == 1
    assert np.array_equal(status == vsr.Status.INADMISSIBLE, s > 0.5)
    assert np.array_equal(status == vsr.Status.CONVERGED, s <= 0.5)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"points": 1}, "points"),
        ({"step": 0.0}, "step"),
        ({"model": vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(1)))}, "model"),
    ],
)
def test_invalid_arguments_are_rejected(unchecked, arguments, words):
    with pytest.raises(ValueError, match=words):
        vsr.follow_branch(column, no_inputs, **arguments)
