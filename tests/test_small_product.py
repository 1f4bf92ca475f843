"""Products of small matrices and of vectors: values and derivatives of both modes against `einsum`
and `numpy.cross`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from vsr_jax.numerics.small_product import cross, product

PLACES = {
    "alike": ((5, 2), (5, 2)),
    "one of a kind": ((1, 2), (5, 1)),
    "none": ((), ()),
}


def drawn(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def by_numpy(a, b):
    return jnp.cross(a, b, axis=0)


def by_einsum(a, b):
    return jnp.einsum("nk...,km...->nm...", a, b)


@pytest.mark.slow
@pytest.mark.parametrize("places", PLACES.values(), ids=PLACES)
@pytest.mark.parametrize("columns", [1, 4])
def test_values_and_derivatives_of_both_modes_are_those_of_einsum(places, columns):
    a, b = drawn(0, 2, 3, *places[0]), drawn(1, 3, columns, *places[1])
    np.testing.assert_allclose(product(a, b), by_einsum(a, b), rtol=1e-13)
    check_grads(
        lambda a, b: product(jnp.asarray(a), jnp.asarray(b)), (a, b), 2, atol=1e-7, rtol=1e-7
    )
    for one, other in zip(
        jax.jacrev(product, (0, 1))(a, b), jax.jacfwd(by_einsum, (0, 1))(a, b), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("axes", [(0, None), (None, 0), (2, 1), (0, 3)])
def test_a_batch_of_either_factor_is_the_loop(axes):
    a, b = (
        drawn(i, *shape) if axis is None else drawn(i, *shape[:axis], 6, *shape[axis:])
        for i, (shape, axis) in enumerate(zip([(2, 3, 5), (3, 4, 5)], axes, strict=True))
    )

    def twice(a, b):
        return jax.grad(lambda a, b: jnp.sum(product(a, b) ** 2), (0, 1))(a, b)

    found = jax.vmap(twice, axes)(a, b)
    for i in range(6):
        one, other = (
            x if axis is None else jnp.take(x, i, axis)
            for x, axis in zip((a, b), axes, strict=True)
        )
        for whole, part in zip(found, twice(one, other), strict=True):
            np.testing.assert_allclose(whole[i], part, rtol=1e-13)


def test_a_derivative_in_reverse_mode_is_a_product_each():
    a, b = drawn(0, 3, 3, 5), drawn(1, 3, 3, 5)
    back = jax.make_jaxpr(lambda a, b: jax.vjp(product, a, b)[1](a))(a, b)
    assert [e.primitive.name for e in back.eqns] == ["small_product"] * 3


@pytest.mark.slow
@pytest.mark.parametrize("places", PLACES.values(), ids=PLACES)
def test_vector_products_and_their_derivatives_are_those_of_numpy(places):
    a, b = (drawn(i, 3, *shape) for i, shape in enumerate(places))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b, axis=0), rtol=1e-13, atol=1e-15)
    check_grads(lambda a, b: cross(jnp.asarray(a), jnp.asarray(b)), (a, b), 2, atol=1e-6, rtol=1e-6)
    for one, other in zip(
        jax.jacrev(cross, (0, 1))(a, b), jax.jacfwd(by_numpy, (0, 1))(a, b), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("axes", [(0, None), (None, 0), (1, 0), (0, 2)])
def test_a_batch_of_vector_products_is_the_loop(axes):
    a, b = (
        drawn(i, 3, 5) if axis is None else drawn(i, *(3, 5)[:axis], 6, *(3, 5)[axis:])
        for i, axis in enumerate(axes)
    )
    found = jax.vmap(cross, axes)(a, b)
    for i in range(6):
        one, other = (
            x if axis is None else jnp.take(x, i, axis)
            for x, axis in zip((a, b), axes, strict=True)
        )
        np.testing.assert_allclose(found[i], np.cross(one, other, axis=0), rtol=1e-13, atol=1e-15)


def test_matrices_that_do_not_fit_are_refused():
    with pytest.raises(TypeError, match=r"no product of matrices of shapes \(2, 3\) and \(2, 3\)"):
        jax.jit(product)(jnp.ones((2, 3)), jnp.ones((2, 3)))


def test_vectors_that_do_not_fit_are_refused():
    for shapes in (((3,), (3, 2)), ((2,), (2,))):
        with pytest.raises(TypeError, match="no product of vectors of shapes"):
            jax.jit(cross)(*(jnp.ones(shape) for shape in shapes))
