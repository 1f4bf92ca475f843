"""Ordinary scenes are not refused: small versions of the search for false failures, and the program
by which it judges."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from benchmarks.false_failures import search
from benchmarks.load_steps import Arm
from benchmarks.ordinary_scenes import STRUCTURES, built
from vsr_jax.chain import definiteness
from vsr_jax.numerics import compiling

GREENHILL = 7.8373


def stack(draws):
    return {name: jnp.asarray(np.array([draw[name] for draw in draws])) for name in draws[0]}


def draws(name, count, seed=1):
    return [STRUCTURES[name].numbers(np.random.default_rng((seed, i))) for i in range(count)]


def straight_column(weight):
    """An upright rod of a given weight by $EI / L^3$, without a load at its tip."""
    numbers = draws("tip wrench and gravity", 1)[0]
    bending, area = (
        numbers["young"] * np.pi * numbers["radius"] ** 4 / 4,
        np.pi * numbers["radius"] ** 2,
    )
    gravity = weight * bending / numbers["length"] ** 3 / (1000.0 * area)
    loads = {
        "gravity": [-gravity, 0.0, 0.0],
        "tip world force": [0.0] * 3,
        "tip world moment": [0.0] * 3,
    }
    return numbers | loads | {"tip_radius": numbers["radius"], "curvature": [0.0, 0.0]}


@pytest.mark.slow
@pytest.mark.parametrize("weight", [5.0, 30.0])
def test_the_independent_path_ends_where_a_column_buckles(weight):
    path = Arm(STRUCTURES["tip wrench and gravity"], straight_column(weight)).follow()
    assert path.arrived == (weight < GREENHILL)
    if not path.arrived:
        np.testing.assert_allclose(path.share * weight, GREENHILL, rtol=3e-3)


@pytest.mark.parametrize("name", STRUCTURES)
def test_the_independent_tangent_is_that_of_differences(name):
    arm = Arm(STRUCTURES[name], draws(name, 1)[0], 24)
    arm.friction = [0.0] * len(arm.friction)  # whose shares are those of the last iterate
    random = np.random.default_rng(0)
    scale = np.array([1, 1, 1, 0.01, 0.01, 0.01])
    xi = arm.rest + scale * (0.3 * random.normal(size=6) + 0.1 * np.sin(3 * arm.middle)[:, None])
    tension, change, pull = (
        np.ones(len(arm.driven)),
        scale * np.sin(2 * arm.middle + 0.3)[:, None],
        random.normal(size=len(arm.driven)),
    )
    ahead, behind = (arm.system(xi + e * change, tension + e * pull, 0.7)[0] for e in (1e-6, -1e-6))
    found = arm.system(xi, tension, 0.7)[1] @ np.concatenate([change.reshape(-1), pull])
    expected = (ahead - behind) / 2e-6
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.max(np.abs(expected)))


@pytest.mark.slow
def test_the_last_strain_of_a_failed_solve_is_no_collapse():
    """It is refused with a reversed section, and has a stable shape bent by 4.7 rad."""
    name = "dead wrenches, three tendons"
    numbers = draws(name, 76)[75]
    assert Arm(STRUCTURES[name], numbers).follow().arrived
    scene, inputs = built(STRUCTURES[name], numbers)
    eq = vsr.solve(scene, inputs, model=vsr.StrainDependent(16))
    assert eq.status in (vsr.Status.NOT_CONVERGED, vsr.Status.CONVERGED)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["catheter", "tip wrench and gravity"])
def test_ordinary_scenes_are_not_refused(name):
    record = search(name, 40, seed=2)
    assert not record["cases"], json.dumps(record["cases"])
    assert record["have a stable equilibrium"] > 30


@pytest.mark.slow
def test_an_upright_arm_with_a_chamber_at_rest_stands_or_is_unstable():
    name = "upright, chamber at rest"
    structure, drawn = STRUCTURES[name], draws(name, 24)
    solved = jax.jit(
        jax.vmap(
            lambda numbers: (
                vsr.solve(*built(structure, numbers), model=vsr.StrainDependent(16)).status
            )
        )
    )
    stands = np.array([Arm(structure, numbers).follow().arrived for numbers in drawn])
    assert 4 < np.sum(stands) < 20
    np.testing.assert_array_equal(
        solved(stack(drawn)), np.where(stands, vsr.Status.CONVERGED, vsr.Status.UNSTABLE)
    )


@pytest.mark.slow
def test_two_unstable_motions_that_the_pivots_miss_are_found(monkeypatch):
    """A dead moment makes the tangent asymmetric: two negative real eigenvalues leave all pivots of
    the elimination positive, and without the probe the equilibrium is called converged."""
    structure, draw = STRUCTURES["dead wrenches, three tendons"], 108
    numbers = draws("dead wrenches, three tendons", draw + 1)[draw]
    L, arm = numbers["length"], Arm(structure, numbers)

    def real_margin():
        """Least real eigenvalue of the independent tangent at the solution."""
        compiling.drop_programs()
        eq = vsr.solve(*built(structure, numbers), model=vsr.StrainDependent(24), throw=True)
        strain = np.asarray(eq.strain(arm.middle * L)) * np.array([L, L, L, 1, 1, 1])
        found = arm.balance(strain, np.zeros(0), 1.0)
        assert found is not None
        assert np.linalg.norm(arm.tip(found[0]) - eq.tip[:3, 3] / L) < 0.02
        return found[2].real

    assert real_margin() > 0
    with monkeypatch.context() as blind:
        blind.setattr(definiteness, "_ASYMMETRIC", np.inf)
        assert real_margin() < -0.5
    compiling.drop_programs()
