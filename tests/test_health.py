"""Health reports: distances to failure known in closed form, conditioning, text of the report."""

import json
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.analysis.health import Limit, _independence
from vsr_jax.cli import main as cli
from vsr_jax.studies import paper

LENGTH, RADIUS = 0.3, 0.01
AXIAL = 1e6 * math.pi * RADIUS**2
BENDING = AXIAL * RADIUS**2 / 4
MODEL = vsr.StrainDependent(4)


def rod(density=None):
    return vsr.Rod(LENGTH, vsr.Circular(RADIUS), vsr.Material(1e6, poisson=0.45, density=density))


@pytest.fixture(scope="module")
def twins():
    """Two coincident threads."""
    return vsr.check(
        vsr.Scene(rod(), [vsr.Tendon(vsr.Parallel(0.0, 0.008))] * 2),
        jnp.array([1.0, 1.0]),
        model=MODEL,
    )


@pytest.fixture(scope="module")
def strut():
    """A strut under half of Euler's load, with a thread on its axis."""
    load = vsr.TipWrench(force=(-0.5 * math.pi**2 / 4 * BENDING / LENGTH**2, 0.0, 0.0))
    return vsr.check(
        vsr.Scene(rod(), [vsr.Tendon(vsr.Parallel(0.0, 0.0))], [load]),
        jnp.array([0.0]),
        model=vsr.StrainDependent(16),
    )


@pytest.mark.slow
def test_tensions_may_grow_until_the_path_has_no_length(twins):
    limit = 1 / (1 / AXIAL + 0.008**2 / BENDING) / 2
    np.testing.assert_allclose(twins.inputs.factor, limit, rtol=1e-3)
    assert twins.inputs.status == vsr.Status.COLLAPSED
    assert twins.loads is None


def test_the_papers_arm_collapses_at_93_newtons():
    health = vsr.check(paper.scene("A1"), jnp.array([-1.0]), model=MODEL)
    np.testing.assert_allclose(health.inputs.factor, 93.1, rtol=1e-3)
    assert health.independence is None


@pytest.mark.slow
def test_twin_threads_are_not_independent(twins):
    assert abs(twins.independence) < 1e-14
    assert "some threads are redundant" in str(twins)
    apart = vsr.Scene(
        rod(), [vsr.Tendon(vsr.Parallel(0.0, 0.008)), vsr.Tendon(vsr.Parallel(0.008, 0.0))]
    )
    health = vsr.check(apart, jnp.array([1.0, 1.0]), model=MODEL)
    coupling = (1 / AXIAL) / (
        1 / AXIAL + 0.008**2 / BENDING
    )  # of the two, through the elongation alone
    np.testing.assert_allclose(health.independence, 1 - coupling, rtol=1e-9)
    assert str(health).splitlines()[-1] == "  advice       no problems found"


@pytest.mark.slow
def test_a_strut_fails_at_eulers_load(strut):
    # the rod shortens and shears before it buckles, so Euler's load is exact only to its strain
    np.testing.assert_allclose(strut.loads.factor, 2.0, rtol=5e-3)
    assert strut.loads.status == vsr.Status.UNSTABLE
    assert strut.inputs.status == vsr.Status.CONVERGED
    np.testing.assert_allclose(strut.equilibrium.stability, 0.5, atol=0.01)
    assert strut.equilibrium.condition > 1 / strut.equilibrium.stability * 0.99


def test_no_finer_steps_are_needed_for_an_arc(twins):
    assert twins.tip_change < 1e-12
    assert twins.equilibrium.converged


def test_an_unknown_condition_has_no_digits(twins, monkeypatch):
    monkeypatch.setattr(vsr.Health, "_margins", lambda self: (math.nan, math.nan))
    assert "  condition    unknown" in str(twins).splitlines()
    assert twins.record()["condition"] is None


def test_a_factor_of_one_within_its_resolution_is_close_to_failure(twins):
    edge = Limit(jnp.array(0.9999), jnp.array(vsr.Status.UNSTABLE))
    assert twins._replace(inputs=edge).advice[0] == (
        "close to failure: inputs may grow by 0 % at most"
    )
    below = Limit(jnp.array(0.99), jnp.array(vsr.Status.UNSTABLE))  # fails between 0.99 and 1
    assert "close to failure" not in twins._replace(inputs=below).advice[0]


@pytest.mark.slow
def test_redundant_threads_are_found_in_both_precisions(dtype):
    around = [(math.cos(i * math.pi / 3), math.sin(i * math.pi / 3)) for i in range(6)]
    threads = [vsr.Tendon(vsr.Parallel(0.005 * y, 0.005 * z)) for y, z in around]
    eq = vsr.solve(vsr.Scene(rod(), threads), jnp.ones(6, dtype), model=MODEL)
    limit = Limit(jnp.array(2.0), jnp.array(vsr.Status.COLLAPSED))
    health = vsr.Health(eq, _independence(eq.scene), limit, None, jnp.zeros((), dtype))
    assert health.independence.dtype == dtype
    assert "some threads are redundant" in health.advice[-1]


def test_a_thread_without_effect_is_not_independent():
    threads = [vsr.Tendon(vsr.Parallel(0.0, z)) for z in (0.0, 0.008)]
    bending = vsr.Scene(rod(), threads, free_strains=["bending_y", "bending_z"])
    assert _independence(bending) == 0


@pytest.mark.slow
def test_a_rod_without_inputs_and_loads_has_no_limits():
    health = vsr.check(vsr.Scene(rod()), jnp.zeros(0), model=MODEL)
    assert health.inputs is health.loads is health.independence is None
    assert health.advice == ("no problems found",)


@pytest.mark.slow
def test_it_runs_under_jit(twins):
    again = eqx.filter_jit(lambda scene, inputs: vsr.check(scene, inputs, model=MODEL))(
        twins.equilibrium.scene, twins.equilibrium.inputs
    )
    np.testing.assert_allclose(again.inputs.factor, twins.inputs.factor)


@pytest.mark.slow
def test_a_failed_solve_gets_a_remedy():
    helix = vsr.Scene(rod(), [vsr.Tendon(vsr.Helix(0.005, pitch=LENGTH / 50))])
    health = vsr.check(helix, jnp.array([20.0]), model=vsr.StrainDependent(8))
    text = str(health).splitlines()
    assert "under-resolved" in text[0]
    assert "take more steps: StrainDependent(steps=16, order=6)" in text[-1]
    record = health.record()
    assert (record["margin"], record["tip_change"], record["converged"]) == (None, None, False)
    assert 0 < record["inputs"]["factor"] < 1


@pytest.mark.slow
def test_the_command_prints_and_saves_the_report(tmp_path, capsys):
    path = tmp_path / "arm.toml"
    vsr.save(vsr.Scene(rod(), [vsr.Tendon(vsr.Parallel(0.0, 0.008))]), path, [1.0], "An arm")
    code = cli.main(
        [
            "check",
            str(path),
            "--input",
            "12",
            "--steps",
            "4",
            "--json",
            str(tmp_path / "health.json"),
        ]
    )
    out = capsys.readouterr().out
    assert code == 0
    assert out.startswith("An arm\n  status     converged (StrainDependent, float64, ")
    assert "may grow together to" in out
    assert "then collapsed" in out
    saved = json.loads((tmp_path / "health.json").read_text())
    np.testing.assert_allclose(
        12 * saved["inputs"]["factor"], 1 / (1 / AXIAL + 0.008**2 / BENDING), rtol=1e-3
    )
    assert saved["advice"] == ["no problems found"]
