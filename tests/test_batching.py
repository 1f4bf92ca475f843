"""Batches: how many steps they take, and that none waits for one that fails."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.numerics.batching import Iteration, iterated, queued

MODEL = vsr.StrainDependent(8)
THREE = [vsr.Tendon(vsr.Parallel(0.004 * np.cos(a), 0.004 * np.sin(a))) for a in (0.0, 2.1, 4.2)]
ROD = vsr.Rod(0.2, vsr.Circular(0.005), vsr.Material(1e6, poisson=0.3, density=1000.0))
FAR_TOO_TAUT = 500.0


def counting(needed, advances):
    """Problems that need some steps each: their results are the sums of what they counted."""

    def advance(state):
        jax.debug.callback(lambda: advances.append(1))
        count, total = state
        busy = count < needed
        return count + busy, total + jnp.where(busy, needed, 0)

    def begin(_):
        return jnp.zeros_like(needed), jnp.zeros_like(needed)

    return Iteration(begin, advance, lambda state: state[0] < needed, lambda state: state[1])


@pytest.mark.parametrize("slow", [0, 1, 3, 7])
def test_a_queue_finds_what_an_iteration_finds(slow):
    needed = jnp.asarray(np.random.default_rng(slow).integers(1, 20, 61))
    found = queued(lambda needed: counting(needed, []), needed, 61, 8, slow)
    np.testing.assert_array_equal(found, iterated(counting(needed, [])))
    np.testing.assert_array_equal(found, needed**2)


@pytest.mark.parametrize(("slow", "most"), [(0, 95), (1, 60), (7, 60)])
def test_a_queue_does_not_wait_for_a_slow_problem(slow, most):
    """The others take nine times five steps in its eight lanes, in those beside the slow one."""
    advances = []
    needed = jnp.full(64, 5).at[3].set(60)
    queued(lambda needed: counting(needed, advances), needed, 64, 8, slow).block_until_ready()
    jax.effects_barrier()
    assert len(advances) <= most


def test_an_arm_beyond_collapse_ends_soon():
    """Far beyond what it bears, with and without weight; it took 225 and 50 evaluations."""
    for loads, most in (((), 10), (vsr.Gravity(), 80)):
        eq = vsr.solve(vsr.Scene(ROD, THREE, loads), [FAR_TOO_TAUT, 0, 0], model=MODEL)
        assert eq.status == vsr.Status.COLLAPSED
        assert eq.steps <= most


@pytest.mark.slow
def test_a_large_batch_is_its_arms_one_by_one():
    """In a queue, some of them beyond collapse."""
    scene = vsr.Scene(ROD, THREE, vsr.Gravity())
    tensions = np.random.default_rng(0).uniform(0, 1, (300, 3))
    tensions[::50] = FAR_TOO_TAUT
    every = jax.jit(jax.vmap(lambda u: vsr.solve(scene, u, model=MODEL)))(jnp.asarray(tensions))
    tip = jax.vmap(lambda eq: eq.tip)(every)
    assert np.all((every.status == vsr.Status.COLLAPSED) == (tensions[:, 0] > 1))
    assert np.all((every.status == vsr.Status.CONVERGED) == (tensions[:, 0] < 1))
    for i in (1, 149, 151, 299):
        alone = vsr.solve(scene, tensions[i], model=MODEL).tip
        np.testing.assert_allclose(tip[i], alone, atol=1e-12)
