"""Inverse statics: targets with known inputs, and targets out of reach."""

import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.analysis import inverse
from vsr_jax.cli import common as cli_common, main as cli

MODEL = vsr.StrainDependent(8)
MOST = 12.0
OFFSETS = ((0.005, 0.0), (-0.0025, 0.0043), (-0.0025, -0.0043))


@pytest.fixture(scope="module")
def scene():
    arm = vsr.Rod(0.75, vsr.Circular(vsr.Taper(0.012, 0.010)), vsr.Material(5.93e5, shear=2e5))
    return vsr.Scene(arm, [vsr.Tendon(vsr.Parallel(y, z)) for y, z in OFFSETS])


@pytest.fixture(scope="module")
def reached(scene):
    """Random inputs; targets: their tips, one out of reach by 20 um, one by far; results."""
    drawn = jnp.asarray(np.random.default_rng(3).uniform(0.2, MOST, (7, 3)))
    tips = jax.vmap(lambda u: vsr.solve(scene, u, model=MODEL).tip[:3, 3])(drawn)
    targets = jnp.concatenate([tips, jnp.array([[0.75 + 2e-5, 0.0, 0.0], [2.0, 0.0, 0.0]])])
    return (
        drawn,
        targets,
        jax.vmap(lambda target: vsr.reach(scene, target, (0.0, MOST), model=MODEL))(targets),
    )


def test_known_inputs_are_recovered(scene, reached):
    drawn, targets, found = reached
    assert np.all(found.reached[:7])
    assert np.all(found.miss[:7] < 1e-9)
    np.testing.assert_allclose(
        found.inputs[:7], drawn, atol=1e-8
    )  # three tendons and three coordinates: the solution is unique
    alone = vsr.solve(scene, found.inputs[2], model=MODEL)
    np.testing.assert_allclose(alone.tip[:3, 3], targets[2], atol=1e-9)


def test_a_target_out_of_reach_gives_the_nearest_point(reached):
    _, _, found = reached
    assert not found.reached[-1]
    assert float(found.miss[-1]) == pytest.approx(1.25, abs=1e-6)  # the straight arm at rest
    np.testing.assert_array_equal(found.inputs[-1], 0)
    assert np.all(found.equilibrium.converged)


def test_a_result_prints_what_the_command_prints(reached, scene):
    found = reached[-1]
    one = jax.tree.map(lambda x: x[0], found)
    lines = str(one).splitlines()
    assert repr(one) == str(one)
    assert lines[0].startswith("inputs     ")
    assert lines[1].endswith("m, within the 7.5e-05 m allowed")
    assert str(found).startswith("8 of 9 targets reached, largest miss 1.2 m")
    texts = []
    shapes = jax.eval_shape(lambda x: texts.append(str(x)) or x, one)
    assert texts[0].startswith("Reach(inputs=")
    assert str(shapes).startswith("Reach(inputs=")


def test_a_miss_below_the_allowed_one_counts_as_reached(reached):
    _, _, found = reached
    np.testing.assert_allclose(found.miss[7], 2e-5, rtol=1e-6)
    assert found.reached[7]
    np.testing.assert_allclose(found.allowed_miss, 1e-4 * 0.75)
    np.testing.assert_array_equal(found.inputs[7], 0)


@pytest.mark.slow
def test_least_effort_leaves_one_of_two_antagonists_slack():
    arm = vsr.Rod(0.75, vsr.Circular(0.01), vsr.Material(5.93e5, shear=2e5))
    scene = vsr.Scene(
        arm,
        [vsr.Tendon(vsr.Parallel(y, 0.0)) for y in (0.005, -0.005)],
        free_strains=("bending_z",),
    )
    target = vsr.solve(scene, [9.0, 4.0], model=MODEL).tip[:3, 3]
    found = vsr.reach(scene, target, (0.0, MOST), model=MODEL)
    assert bool(found.reached)
    np.testing.assert_allclose(found.inputs, [5.0, 0.0], atol=1e-6)


@pytest.mark.slow
def test_a_moving_target_is_followed_with_the_least_change_of_inputs():
    """Four tendons, one more than needed: along the direction that keeps the tip nothing moves."""
    rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(8e5, poisson=0.45, density=800.0))
    around = [
        vsr.Tendon(vsr.Parallel(0.007 * np.cos(a), 0.007 * np.sin(a)))
        for a in 0.3 + np.pi / 2 * np.arange(4)
    ]
    scene, model = vsr.Scene(rod, around, [vsr.Gravity()]), vsr.StrainDependent(8)
    tense = jnp.array([4.0, 2.5, 2.0, 3.0])
    eq = vsr.solve(scene, tense, model=model)
    zero = jnp.zeros(())
    here = vsr.Reach(tense, eq, zero, jnp.array(True), zero, zero)
    target = eq.tip[:3, 3] + jnp.array([0.0, 1e-3, 2e-3])
    track = jax.jit(lambda t, start: vsr.reach(scene, t, (0.0, 8.0), model=model, start=start))
    found = track(target, here)
    assert bool(found.reached)
    assert float(found.miss) < 1e-9
    change = np.asarray(found.inputs - tense)
    assert 0 < np.max(np.abs(change)) < 0.6
    J = jax.jacfwd(lambda u: vsr.solve(scene, u, model=model).tip[:3, 3])(found.inputs)
    keeps = np.linalg.svd(J)[2][3]
    assert abs(keeps @ change) < 0.02 * np.linalg.norm(change)
    at = track(target + jnp.array([0.0, 1e-3, 0.0]), found)
    assert bool(at.reached)


def test_a_start_with_other_actuators_is_refused(scene, reached):
    eq = vsr.solve(vsr.Scene(scene.rod, []), [])
    zero = jnp.zeros(())
    start = vsr.Reach(jnp.zeros(0), eq, zero, jnp.array(True), zero, zero)
    with pytest.raises(ValueError, match="start: got inputs of shape"):
        vsr.reach(scene, jnp.zeros(3), (0.0, 1.0), start=start)


@pytest.mark.slow
def test_a_pose_and_points_along_the_arm(scene):
    inputs, X = jnp.array([7.0, 2.0, 4.0]), jnp.array([0.4, 0.75])
    eq = vsr.solve(scene, inputs, model=MODEL)
    for target, places in ((eq.tip, None), (eq.position(X), X)):
        found = vsr.reach(scene, target, (0.0, MOST), X=places, model=MODEL)
        assert bool(found.reached)
        np.testing.assert_allclose(found.inputs, inputs, atol=1e-8)


@pytest.mark.slow
def test_derivatives_with_respect_to_the_target_against_differences():
    """Four tendons for three coordinates: one is at its bound, or the effort decides."""
    arm = vsr.Rod(0.75, vsr.Circular(vsr.Taper(0.012, 0.010)), vsr.Material(5.93e5, shear=2e5))
    ring = [
        vsr.Tendon(vsr.Parallel(y, z))
        for y, z in ((0.005, 0.0), (0.0, 0.005), (-0.005, 0.0), (0.0, -0.005))
    ]
    scene = vsr.Scene(arm, ring)

    def inputs(target):
        found = vsr.reach(scene, target, (0.0, MOST), model=MODEL).inputs
        return found, found

    slopes, step = jax.jit(jax.jacfwd(inputs, has_aux=True)), 1e-5
    for place in ((0.0, 4.0, 7.0, 2.0), (3.0, 6.0, 3.0, 5.0)):
        target = vsr.solve(scene, place, model=MODEL).tip[:3, 3]
        found, effort = slopes(target)
        assert bool(jnp.any(effort == 0)) == (place[0] == 0)
        true = np.stack(
            [
                (slopes(target + step * unit)[1] - slopes(target - step * unit)[1]) / (2 * step)
                for unit in jnp.eye(3)
            ],
            axis=1,
        )
        np.testing.assert_allclose(found, true, rtol=1e-4, atol=1e-5 * np.abs(true).max())


@pytest.mark.parametrize(
    ("target", "bounds", "options", "message"),
    [
        ([0.5, 0.1], (0.0, 1.0), {}, r"target: got shape \(2,\), need \(3,\)"),
        ([0.5, 0.1, 0.0], 1.0, {}, r"bounds: got 1.0, need a pair"),
        (
            [0.5, 0.1, 0.0],
            (1.0, 0.0),
            {},
            r"bounds: got \[1. 1. 1.\] to \[0. 0. 0.\], need the least inputs first",
        ),
        (
            [0.5, 0.1, 0.0],
            ([0.0, 0.0], 1.0),
            {},
            r"bounds\[0\]: got shape \(2,\), need one number or 3",
        ),
        ([0.5, 0.1, 0.0], (-1.0, 1.0), {}, r"inputs\[0\]: got -1, need a finite number >= 0"),
        (
            [0.5, 0.1, 0.0],
            (0.0, 1.0),
            {"X": [0.1, 0.2]},
            r"X: got shape \(2,\) for targets of shape \(3,\)",
        ),
        (
            [0.5, 0.1, 0.0],
            (0.0, 1.0),
            {"allowed_miss": -1.0},
            r"allowed_miss: got -1.0, need a finite number > 0",
        ),
        (
            [[0.5, 0.1, 0.0]],
            (0.0, 1.0),
            {"X": [9.0]},
            r"X: got 9 m, need 0 to 0.75 m, the ends of the arm",
        ),
        (
            np.diag([0.0, 0.0, 0.0, 1.0]),
            (0.0, 1.0),
            {},
            r"target: got a rotation of zeros, need a rigid transform",
        ),
        (np.diag([1.0, 1.0, -1.0, 1.0]), (0.0, 1.0), {}, r"target: got a reflection"),
    ],
)
def test_invalid_arguments_are_rejected(unchecked, scene, target, bounds, options, message):
    with pytest.raises(ValueError, match=message):
        vsr.reach(scene, target, bounds, **options)


def test_a_scene_without_actuators_is_rejected(unchecked, scene):
    with pytest.raises(ValueError, match="scene: got no actuators"):
        vsr.reach(vsr.Scene(scene.rod, []), [0.5, 0.0, 0.0], (0.0, 1.0))


@pytest.mark.slow
def test_a_rounded_target_is_reached_and_the_nearest_point_is_exact(scene):
    """The tips of one tendon form a curve in space; a target rounded to six digits is off it."""
    one = vsr.Scene(scene.rod, scene.actuators[:1])
    tip = vsr.solve(one, [7.0], model=MODEL).tip[:3, 3]
    rounded = jnp.asarray([float(f"{x:.6g}") for x in tip]) + jnp.array([0.0, 0.0, 2e-6])
    found = vsr.reach(one, rounded, (0.0, MOST), model=MODEL)
    assert bool(found.reached)
    assert 1e-6 * 0.75 < found.miss < 1e-5
    np.testing.assert_allclose(found.inputs, [7.0], atol=1e-4)
    np.testing.assert_allclose(found.allowed_miss, 1e-4 * 0.75)
    strict = vsr.reach(one, rounded, (0.0, MOST), model=MODEL, allowed_miss=1e-6)
    assert not bool(strict.reached)
    np.testing.assert_array_equal(strict.inputs, found.inputs)


@pytest.mark.slow
def test_traced_points_beyond_the_arm_are_not_reached(scene):
    one = vsr.Scene(scene.rod, scene.actuators[:1])
    target = vsr.solve(one, [7.0], model=MODEL).position([0.4])
    found = jax.jit(jax.vmap(lambda X: vsr.reach(one, target, (0.0, MOST), X=X, model=MODEL)))(
        jnp.array([[0.4], [9.0]])
    )
    np.testing.assert_array_equal(found.reached, [True, False])
    np.testing.assert_allclose(found.inputs[0], [7.0], atol=1e-8)
    assert np.isinf(found.miss[1])


@pytest.mark.parametrize("close", [True, False])
def test_the_command(tmp_path, capsys, monkeypatch, scene, close):
    def reach(scene, target, bounds, model, allowed_miss, progress):
        np.testing.assert_array_equal(target, [0.7, -0.1, 0.2])
        np.testing.assert_array_equal(bounds, [[0, 0, 0], [12, 12, 12]])
        assert allowed_miss == 1e-3
        inputs = jnp.array([7.0, 2.0, 4.0])
        miss = jnp.array(2e-4 if close else 0.3)
        return inverse.Reach(
            inputs,
            vsr.solve(scene, inputs, model=model),
            miss,
            jnp.array(close),
            jnp.array(allowed_miss),
            jnp.array(0.0),
        )

    monkeypatch.setattr(inverse, "reach", reach)
    file, out = tmp_path / "arm.toml", tmp_path / "found.json"
    vsr.save(scene, file, [1.0, 1.0, 1.0])
    arguments = [
        "reach",
        str(file),
        "--target",
        "0.7",
        "-0.1",
        "0.2",
        "--high",
        "12",
        "--steps",
        "8",
        "--allowed-miss",
        "1e-3",
    ]
    assert cli.main([*arguments, "--json", str(out)]) == (
        cli_common.DONE if close else cli_common.NOT_CONVERGED
    )
    text = capsys.readouterr().out
    assert "  inputs     7, 2, 4\n" in text
    verdict = (
        "0.0002 m, within the"
        if close
        else "0.3 m, out of reach, this is the nearest point found: more than the"
    )
    assert f"  miss       {verdict} 0.001 m allowed\n" in text
    saved = json.loads(out.read_text())
    assert (saved["reached"], saved["allowed_miss"]) == (close, 1e-3)


@pytest.mark.slow
def test_the_command_reaches_a_tip_that_it_printed(tmp_path, capsys, scene):
    """Two tendons for a tip in space: no inputs reach the rounded position exactly."""
    file = tmp_path / "arm.toml"
    vsr.save(vsr.Scene(scene.rod, scene.actuators[:2]), file, [7.0, 2.0])
    assert cli.main(["solve", str(file), "--steps", "8"]) == cli_common.DONE
    digits = re.search(r"  tip        \((.*), (.*), (.*)\) m", capsys.readouterr().out).groups()
    arguments = ["reach", str(file), "--target", *digits, "--high", "12", "--steps", "8"]
    assert cli.main(arguments) == cli_common.DONE
    assert re.search(r"  miss       \S+ m, within the 7.5e-05 m allowed\n", capsys.readouterr().out)
