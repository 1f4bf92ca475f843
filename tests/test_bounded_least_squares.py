"""Least squares within the unit box: problems whose solutions are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vsr_jax.numerics import bounded_least_squares


def circle(s):
    """Nothing on a circle of radius 0.3 around (0.5, 0.5)."""
    return jnp.array([jnp.sum((s - 0.5) ** 2) - 0.09])


def solve(f, starts, rest, dtype, allowed=1e-6):
    return jax.jit(
        lambda: bounded_least_squares.nearest(
            f, jnp.asarray(starts, dtype), jnp.asarray(rest, dtype), jnp.asarray(allowed, dtype)
        )
    )()


def test_the_effort_chooses_among_many_solutions(dtype):
    found = solve(circle, [[0.9, 0.4]], [0.1, 0.1], dtype)
    np.testing.assert_allclose(
        found.share, 0.5 - 0.3 / np.sqrt(2), atol=1e-8 if dtype == jnp.float64 else 2e-3
    )
    assert float(jnp.abs(circle(found.share))[0]) < 4 * float(jnp.finfo(dtype).eps)
    assert np.all(found.free)


def test_what_pushes_against_a_bound_is_held(dtype):
    found = solve(
        lambda s: jnp.array([s[0] + s[1] - 0.4 + s[0] ** 2]), [[0.5, 0.5]], [0.0, 0.9], dtype
    )
    np.testing.assert_allclose(found.share, [0.0, 0.4], atol=1e-6)
    assert found.free.tolist() == [False, True]


def test_out_of_reach_is_the_nearest(dtype):
    found = solve(
        lambda s: jnp.array([s[0] - 2.0, s[1] ** 2 - 0.25, s[1] - s[0] + 0.5]),
        [[0.2, 0.9]],
        [0.0, 0.0],
        dtype,
    )
    np.testing.assert_allclose(found.share, [1.0, 0.5], atol=1e-8 if dtype == jnp.float64 else 1e-3)


def test_steps_turn_back_where_nothing_is_finite():
    found = solve(lambda s: jnp.log(s - 0.2) - jnp.log(0.1), [[0.9]], [0.0], jnp.float64)
    np.testing.assert_allclose(found.share, 0.3, atol=1e-8)


def test_another_start_follows_where_one_leads_nowhere():
    def valley(s):
        return (0.9 - s) * ((s - 0.3) ** 2 + 0.02)

    found = [
        solve(valley, starts, [0.0], jnp.float64).share for starts in ([[0.1]], [[0.1], [0.8]])
    ]
    np.testing.assert_allclose(
        found[0], 0.3 + 0.6 / 3 - np.sqrt(0.2**2 - 0.02 / 3), atol=1e-6
    )  # where the slope is nothing
    np.testing.assert_allclose(found[1], 0.9, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 6])
def test_a_batch_finds_what_each_finds_alone(size):
    targets = jnp.asarray(np.random.default_rng(size).uniform(0.1, 0.9, (5, 3)))
    turns = jnp.asarray(np.random.default_rng(0).normal(size=(3, size)))

    def find(target):
        place = jnp.sin(turns @ jnp.resize(target, size))
        start, rest = jnp.full((1, size), 0.5), jnp.zeros(size)
        return bounded_least_squares.nearest(
            lambda s: jnp.sin(turns @ s) - place, start, rest, jnp.asarray(1e-9)
        ).share

    np.testing.assert_allclose(
        jax.jit(jax.vmap(find))(targets), [find(target) for target in targets], atol=1e-10
    )
