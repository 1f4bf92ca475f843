"""Inverse statics: targets that were reached by known inputs, and some that cannot be reached."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax import cli, cli_common, inverse

MODEL = vsr.StrainDependent(8)
MOST = 12.0
OFFSETS = ((0.005, 0.0), (-0.0025, 0.0043), (-0.0025, -0.0043))


@pytest.fixture(scope="module")
def scene():
    arm = vsr.Rod(0.75, vsr.Circular(vsr.Taper(0.012, 0.010)), vsr.Material(5.93e5, shear=2e5))
    return vsr.Scene(arm, [vsr.Tendon(vsr.Parallel(y, z)) for y, z in OFFSETS])


@pytest.fixture(scope="module")
def reached(scene):
    """Inputs drawn, their tips with one more beyond reach, and what is found for these."""
    drawn = jnp.asarray(np.random.default_rng(3).uniform(0.2, MOST, (7, 3)))
    tips = jax.vmap(lambda u: vsr.solve(scene, u, model=MODEL).tip[:3, 3])(drawn)
    targets = jnp.concatenate([tips, jnp.array([[2.0, 0.0, 0.0]])])
    return drawn, targets, jax.vmap(lambda target: vsr.reach(scene, target, (0.0, MOST), model=MODEL))(targets)


def test_all_that_can_be_reached_are_and_the_inputs_are_found_again(scene, reached):
    drawn, targets, found = reached
    assert np.all(found.reached[:-1])
    np.testing.assert_allclose(found.inputs[:-1], drawn, atol=1e-8)  # three tendons and three coordinates: there is one way only
    alone = vsr.solve(scene, found.inputs[2], model=MODEL)
    np.testing.assert_allclose(alone.tip[:3, 3], targets[2], atol=1e-9)


def test_what_is_out_of_reach_gets_the_nearest_point_and_says_so(reached):
    _, _, found = reached
    assert not found.reached[-1]
    assert float(found.miss[-1]) == pytest.approx(1.25, abs=1e-6)  # the straight arm, at rest
    np.testing.assert_array_equal(found.inputs[-1], 0)
    assert np.all(found.equilibrium.converged)


@pytest.mark.slow
def test_least_effort_leaves_one_of_two_antagonists_slack():
    arm = vsr.Rod(0.75, vsr.Circular(0.01), vsr.Material(5.93e5, shear=2e5))
    scene = vsr.Scene(arm, [vsr.Tendon(vsr.Parallel(y, 0.0)) for y in (0.005, -0.005)], free_strains=("bending_z",))
    target = vsr.solve(scene, [9.0, 4.0], model=MODEL).tip[:3, 3]
    found = vsr.reach(scene, target, (0.0, MOST), model=MODEL)
    assert bool(found.reached)
    np.testing.assert_allclose(found.inputs, [5.0, 0.0], atol=1e-6)


@pytest.mark.slow
def test_a_pose_and_points_along_the_arm(scene):
    inputs, X = jnp.array([7.0, 2.0, 4.0]), jnp.array([0.4, 0.75])
    eq = vsr.solve(scene, inputs, model=MODEL)
    for target, places in ((eq.tip, None), (eq.position(X), X)):
        found = vsr.reach(scene, target, (0.0, MOST), X=places, model=MODEL)
        assert bool(found.reached)
        np.testing.assert_allclose(found.inputs, inputs, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("place", [(0.0, 4.0, 7.0, 2.0), (3.0, 6.0, 3.0, 5.0)])
def test_derivatives_by_the_target_are_those_of_differences(place):
    """Four tendons for three coordinates: one is at its bound, or the effort chooses."""
    arm = vsr.Rod(0.75, vsr.Circular(vsr.Taper(0.012, 0.010)), vsr.Material(5.93e5, shear=2e5))
    ring = [vsr.Tendon(vsr.Parallel(y, z)) for y, z in ((0.005, 0.0), (0.0, 0.005), (-0.005, 0.0), (0.0, -0.005))]
    scene = vsr.Scene(arm, ring)
    target = vsr.solve(scene, place, model=MODEL).tip[:3, 3]
    inputs = jax.jit(lambda target: vsr.reach(scene, target, (0.0, MOST), model=MODEL).inputs)
    assert bool(jnp.any(inputs(target) == 0)) == (place[0] == 0)
    step = 1e-5
    found = jax.jit(jax.jacfwd(inputs))(target)
    true = np.stack([(inputs(target + step * unit) - inputs(target - step * unit)) / (2 * step) for unit in jnp.eye(3)], axis=1)
    np.testing.assert_allclose(found, true, rtol=1e-4, atol=1e-5 * np.abs(true).max())


@pytest.mark.parametrize(
    ("target", "bounds", "options", "message"),
    [
        ([0.5, 0.1], (0.0, 1.0), {}, r"target: got shape \(2,\), need \(3,\)"),
        ([0.5, 0.1, 0.0], 1.0, {}, r"bounds: got 1.0, need a pair"),
        ([0.5, 0.1, 0.0], (1.0, 0.0), {}, r"bounds: got \[1. 1. 1.\] to \[0. 0. 0.\], need the least inputs first"),
        ([0.5, 0.1, 0.0], ([0.0, 0.0], 1.0), {}, r"bounds\[0\]: got shape \(2,\), need one number or 3"),
        ([0.5, 0.1, 0.0], (-1.0, 1.0), {}, r"inputs\[0\]: got -1, need a finite number >= 0"),
        ([0.5, 0.1, 0.0], (0.0, 1.0), {"X": [0.1, 0.2]}, r"X: got shape \(2,\) for targets of shape \(3,\)"),
        ([0.5, 0.1, 0.0], (0.0, 1.0), {"tolerance": -1.0}, r"tolerance: got -1.0, need a finite number > 0"),
    ],
)
def test_refusals(unchecked, scene, target, bounds, options, message):
    with pytest.raises(ValueError, match=message):
        vsr.reach(scene, target, bounds, **options)


def test_no_actuators_are_refused(unchecked, scene):
    with pytest.raises(ValueError, match="scene: got no actuators"):
        vsr.reach(vsr.Scene(scene.rod, []), [0.5, 0.0, 0.0], (0.0, 1.0))


@pytest.mark.parametrize("close", [True, False])
def test_the_command(tmp_path, capsys, monkeypatch, scene, close):
    def reach(scene, target, bounds, model):
        np.testing.assert_array_equal(target, [0.7, -0.1, 0.2])
        np.testing.assert_array_equal(bounds, [[0, 0, 0], [12, 12, 12]])
        inputs = jnp.array([7.0, 2.0, 4.0])
        return inverse.Reach(inputs, vsr.solve(scene, inputs, model=model), jnp.array(0.0 if close else 0.3), jnp.array(close))

    monkeypatch.setattr(inverse, "reach", reach)
    file, out = tmp_path / "arm.toml", tmp_path / "found.json"
    file.write_text(scene.to_toml([1.0, 1.0, 1.0]))
    arguments = ["reach", str(file), "--target", "0.7", "-0.1", "0.2", "--high", "12", "--steps", "8", "--json", str(out)]
    assert cli.main(arguments) == (cli_common.DONE if close else cli_common.NOT_CONVERGED)
    text = capsys.readouterr().out
    assert "  inputs     7, 2, 4\n" in text
    assert ("out of reach" in text) != close
    assert json.loads(out.read_text())["reached"] == close
