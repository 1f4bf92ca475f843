"""Section IV of the paper: every case and tension against the independent reference, and the
paper's claims."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.studies import paper

L = paper.LENGTH
EXACT = vsr.StrainDependent(steps=96, order=6)
CONTINUUM = vsr.Continuum(rtol=1e-10, atol=1e-12)


def tip_error(eq, reference):
    return float(np.linalg.norm(np.asarray(eq.tip[:3, 3], np.float64) - reference.tip[:3, 3]))


def error_of(case, index, basis):
    reference = paper.reference(case)[index]
    return tip_error(
        vsr.solve(paper.scene(case), reference.tau, model=vsr.Prescribed(basis)), reference
    )


@pytest.mark.parametrize("case", paper.CASES)
def test_strain_dependent_is_the_reference(case):
    """Tips within 1e-8 m and strains within 1e-10 of their scale, on 96 steps of order 6."""
    scene = paper.scene(case)
    for reference in paper.reference(case):
        eq = vsr.solve(scene, reference.tau, model=EXACT)
        assert tip_error(eq, reference) < 1e-8
        np.testing.assert_allclose(eq.tip, reference.tip, atol=2e-8)
        scale = np.maximum(1, np.abs(reference.strain).max(axis=0))
        assert np.max(np.abs(eq.strain(reference.X) - reference.strain) / scale) < 1e-10


def test_whole_shape_is_the_reference():
    for reference in paper.reference("B2"):
        eq = vsr.solve(paper.scene("B2"), reference.tau, model=EXACT)
        assert np.abs(eq.position(reference.X) - reference.position).max() < 1e-8


@pytest.mark.parametrize("case", paper.CASES)
def test_continuum_is_the_reference(case):
    """Tips within 1e-7 m at rtol 1e-10."""
    scene = paper.scene(case)
    for reference in paper.reference(case):
        assert tip_error(vsr.solve(scene, reference.tau, model=CONTINUUM), reference) < 1e-7


@pytest.mark.parametrize("case", paper.CASES)
def test_single_precision_holds_a_ten_thousandth_of_the_length(case):
    scene = paper.scene(case)
    for reference in paper.reference(case):
        eq = vsr.solve(scene, jnp.asarray(reference.tau, jnp.float32))
        assert eq.tip.dtype == jnp.float32
        assert tip_error(eq, reference) < 1e-4 * L


def test_stability_margin_is_the_references():
    for case in ("A1", "B2", "C2"):
        for reference in paper.reference(case):
            eq = vsr.solve(paper.scene(case), reference.tau, model=EXACT)
            # The reference looks at 21 stations with the ends, the model at its nodes without them.
            np.testing.assert_allclose(eq.stability, reference.stability, atol=5e-4)


class TestClaims:
    """What sections IV.A to IV.C say of the prescribed bases (Tables II and IV as mended)."""

    def test_A1_is_exact_with_two_degrees_of_freedom(self):
        assert paper.basis("A1").size == 2
        for i in range(4):
            assert error_of("A1", i, paper.basis("A1")) < 1e-9

    @pytest.mark.slow
    @pytest.mark.parametrize(("case", "size"), [("A2", 3), ("A3", 6), ("B1", 6), ("B2", 12)])
    def test_cylinders_are_met_within_a_quarter_percent(self, case, size):
        basis = paper.basis(case)
        assert basis.size == size
        for i in range(len(paper.reference(case))):
            assert error_of(case, i, basis) < 0.0025 * L

    def test_cones_are_missed_by_the_cylinders_bases(self):
        """C2 misses by about 6 % of L at tau = (-15, -5)."""
        assert paper.reference("C2")[1].tau.tolist() == [-15.0, -5.0]
        assert abs(error_of("C2", 1, paper.basis("C2")) / L - 0.06) < 0.005
        for case in ("C1", "C2"):
            assert all(error_of(case, i, paper.basis(case)) > 0.02 * L for i in range(3))

    def test_pcs_with_six_degrees_is_worse_than_three(self):
        assert paper.piecewise_basis().size == 6
        for i in range(4):
            assert error_of("A2", i, paper.piecewise_basis()) > 10 * error_of(
                "A2", i, paper.basis("A2")
            )


def test_helix_gradients_are_those_of_the_reference_method(helix):
    """d tip / d radius and d tip / d angle of B1 at tau = -15 by central differences of the
    reference program."""

    def tip(scene, model):
        return vsr.solve(scene, jnp.array([-15.0]), model=model).tip[:3, 3]

    for model in (EXACT, vsr.Continuum(rtol=1e-10, atol=1e-12)):
        routing = jax.jit(jax.jacrev(tip))(helix, model).actuators[0].routing
        np.testing.assert_allclose(routing.radius, [-38.60, 51.50, -93.51], atol=0.006)
        np.testing.assert_allclose(routing.angle, [-6.17, -1.74, -3.01], atol=0.006)


def test_unknown_case_is_refused():
    with pytest.raises(ValueError, match="case: got 'D1', need one of 'A1', 'A2'"):
        paper.scene("D1")
