"""Acceleration of linearly convergent iterations."""

import jax.numpy as jnp
import numpy as np

from vsr_jax.numerics.acceleration import Earlier, accelerated


def dot(one, other):
    return jnp.sum(one * other, axis=0)


def test_two_contractions_of_either_sign_are_found_from_three_steps():
    """Steps $g = (1 - T) x$ in the axes of T; one problem per column, each with its own T."""
    contractions = jnp.array([[-0.4, 0.9, 0.03], [0.2, -0.7, 0.02]])
    x = jnp.array([[1.0, 2.0, -1.0], [3.0, -1.0, 0.5]])
    steps, taken = [], []
    for _ in range(2):
        steps.append((1 - contractions) * x)
        taken.append(steps[-1])
        x = x - taken[-1]
    step = (1 - contractions) * x
    earlier = Earlier(steps[1], taken[0], steps[0])
    both = accelerated(step, taken[1], earlier, jnp.array([True, True, False]), dot)
    np.testing.assert_allclose((x - both)[:, :2], 0.0, atol=1e-12)
    assert np.linalg.norm((x - both)[:, 2]) < np.linalg.norm((x - step)[:, 2])


def test_one_contraction_needs_two_steps_and_does_not_divide_by_zero():
    """Both changes are parallel; only the last is used. A step of zero stays zero."""
    x = jnp.array([[1.0, 0.0], [2.0, 0.0]])
    first, second, third = 1.4 * x, -0.4 * 1.4 * x, 0.16 * 1.4 * x
    found = accelerated(third, second, Earlier(second, first, first), jnp.array([True, True]), dot)
    np.testing.assert_allclose(found, 0.16 * x, atol=1e-12)
