"""Tolerances to steps: met against solutions at far more steps, with gradients against differences
of those."""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.numerics.quadrature import make_grid
from vsr_jax.studies import paper

HELICES = paper.scene("B2")
RANGE = (-15.0, 0.0)
FINE = vsr.StrainDependent(320)


@pytest.fixture(scope="module")
def plans():
    return {tolerance: vsr.plan(HELICES, tolerance, RANGE) for tolerance in (1e-3, 1e-6)}


def with_angle(angle):
    return eqx.tree_at(lambda scene: scene.actuators[0].routing.angle, HELICES, angle)


def tip(scene, inputs, model):
    return vsr.solve(scene, inputs, model=model).tip[:3, 3]


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
def test_a_plan_meets_its_tolerance_between_its_samples(plans, tolerance):
    chosen = plans[tolerance]
    inputs = jnp.asarray(np.random.default_rng(5).uniform(*RANGE, (32, 2)))
    fine = jax.vmap(lambda u: tip(HELICES, u, FINE))(inputs)
    ours = jax.vmap(lambda u: tip(HELICES, u, chosen.model))(inputs.astype(chosen.dtype))
    worst = float(jnp.max(jnp.linalg.norm(ours - fine, axis=1)))
    assert tolerance / 100 < worst <= tolerance  # and is not wasteful


@pytest.mark.slow
def test_a_millimetre_takes_single_precision_and_fewer_steps(plans):
    assert (plans[1e-3].dtype, plans[1e-6].dtype) == ("float32", "float64")
    assert plans[1e-3].model.steps <= plans[1e-6].model.steps / 2


def test_solve_chooses_for_its_inputs():
    inputs = jnp.array([-8.0, -5.0])
    eq = vsr.solve(HELICES, inputs, tolerance=1e-5)
    assert float(jnp.linalg.norm(eq.tip[:3, 3] - tip(HELICES, inputs, FINE))) <= 1e-5
    assert eq.model.steps < 32


@pytest.mark.slow
def test_gradient_tolerance_holds_against_differences_of_ten_times_the_steps():
    chosen = vsr.plan(HELICES, 1e-2, ([-8.0, -5.0], [-8.0, -5.0]), gradient_tolerance=1e-4)
    inputs = jnp.array([-8.0, -5.0])
    ten_times = vsr.StrainDependent(10 * chosen.model.steps)

    slope = jax.jacobian(lambda angle: tip(with_angle(angle), inputs, chosen.model))(
        jnp.array(1.529)
    )
    step = 1e-4
    values = [
        tip(with_angle(jnp.array(1.529 + k * step)), inputs, ten_times) for k in (-2, -1, 1, 2)
    ]
    true = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)
    assert float(jnp.linalg.norm(slope - true) / jnp.linalg.norm(true)) <= 1e-4
    assert chosen.gradient_error <= 0.5e-4
    assert chosen.model.steps > vsr.plan(HELICES, 1e-2, ([-8.0, -5.0], [-8.0, -5.0])).model.steps


@pytest.mark.slow
def test_under_loads():
    arm = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(5.93e5, shear=2e5, density=1000.0))
    scene = vsr.Scene(arm, [vsr.Tendon(vsr.Helix(0.005, 1.5))], [vsr.Gravity((0.0, 0.0, -9.81))])
    chosen, inputs = vsr.plan(scene, 1e-4, (0.0, 8.0)), jnp.array([6.0])
    assert (
        float(
            jnp.linalg.norm(
                tip(scene, inputs, chosen.model) - tip(scene, inputs, vsr.StrainDependent(32))
            )
        )
        <= 1e-4
    )


@pytest.mark.slow
def test_a_helix_of_fifty_turns_gets_steps_enough():
    arm = vsr.Rod(0.75, vsr.Circular(0.01), vsr.Material(5.93e5, shear=2e5))
    scene = vsr.Scene(arm, [vsr.Tendon(vsr.Helix(0.005, pitch=0.75 / 50))])
    inputs = jnp.array([5.0])
    assert vsr.solve(scene, inputs).status == vsr.Status.UNDER_RESOLVED
    eq = vsr.solve(scene, inputs, tolerance=1e-5)
    assert float(jnp.linalg.norm(eq.tip[:3, 3] - tip(scene, inputs, FINE))) <= 1e-5


@pytest.mark.slow
def test_a_straight_arm_takes_one_step():
    assert vsr.solve(paper.scene("A1"), [-5.0], tolerance=1e-9).model.steps == 1


def test_a_failed_solve_says_why_all_the_same():
    assert vsr.solve(HELICES, [-9e4, -9e4], tolerance=1e-3).status == vsr.Status.COLLAPSED


@pytest.mark.parametrize("edges", [[0.0, 0.75], [0.0, 0.2, 0.21, 0.75]])
def test_a_grid_with_room_is_the_one_without(edges):
    edges, wanted = jnp.array(edges), 9
    plain, roomy = (
        make_grid(edges, wanted, 3),
        jax.jit(lambda n: make_grid(edges, n, 3, room=16))(wanted),
    )
    for a, b in zip(plain, roomy, strict=True):
        np.testing.assert_allclose(a, b[..., :wanted], rtol=1e-15)
    assert np.all(np.asarray(roomy.h[wanted:]) == 0)
    assert np.all(np.asarray(roomy.X[:, wanted:]) == 0.75)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((HELICES, 0.0, RANGE), "tolerance: got 0.0, need a finite number > 0"),
        ((HELICES, 1e-3, -15.0), "inputs_range: got -15.0, need a pair"),
        ((HELICES, 1e-3, (0.0, -15.0)), "need the least inputs first"),
        (
            (HELICES, 1e-3, ([0.0], [1.0])),
            r"inputs_range\[0\]: got shape \(1,\), need one number or 2",
        ),
        (
            (HELICES, 1e-3, (-9e4, -8e4)),
            "inputs_range: got no sample with a stable equilibrium",
        ),
        ((None, 1e-3, RANGE), "scene: got None, need a Scene"),
    ],
)
def test_refusals(unchecked, arguments, message):
    with pytest.raises(ValueError, match=message):
        vsr.plan(*arguments)


def test_a_tolerance_beyond_the_precision_is_refused(monkeypatch):
    monkeypatch.setattr(sys.modules["vsr_jax.solution.step_choice"], "_CAPACITIES", (64,))
    with pytest.raises(ValueError, match="tolerance: got 1e-16 m, need at least"):
        vsr.plan(HELICES, 1e-16, RANGE)


def test_solve_refuses_a_model_besides_a_tolerance_and_traced_inputs(unchecked):
    with pytest.raises(ValueError, match=r"tolerance: got 0\.001 and a model, need one of them"):
        vsr.solve(HELICES, [-1.0, -1.0], model=FINE, tolerance=1e-3)
    with pytest.raises(ValueError, match=r"under jax\.jit use the result of an earlier vsr\.plan"):
        jax.jit(lambda u: vsr.solve(HELICES, u, tolerance=1e-3).tip)(jnp.array([-1.0, -1.0]))
