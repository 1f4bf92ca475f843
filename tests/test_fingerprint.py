"""What tells stored results apart: constants at every depth of a program."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from jax import lax

from vsr_jax.numerics.fingerprint import fingerprint


def plain(size):
    table = jnp.full(3, size)
    return lambda x: x * table.sum()


def under_jit(size):
    table = jnp.full(3, size)
    return eqx.filter_jit(lambda x: x * table.sum())


def in_a_scan_of_a_jit(size):
    inner = under_jit(size)
    return lambda x: lax.scan(lambda carry, _: (inner(carry), None), x, length=2)[0]


def in_a_branch(size):
    inner = under_jit(size)
    return lambda x: lax.cond(x > 0, inner, lambda x: x, x)


def under_a_derivative(size):
    return jax.grad(in_a_scan_of_a_jit(size))


@pytest.mark.parametrize(
    "make", [plain, under_jit, in_a_scan_of_a_jit, in_a_branch, under_a_derivative]
)
def test_a_constant_of_the_program_changes_its_hash(make):
    x = (jnp.array(1.5),)
    assert fingerprint(make(1.0), x) == fingerprint(make(1.0), x)
    assert fingerprint(make(1.0), x) != fingerprint(make(2.0), x)


@pytest.mark.skipif(
    not hasattr(jax.config, "jax_use_simplified_jaxpr_constants"), reason="an option of newer JAX"
)
def test_a_constant_that_is_an_operand_changes_the_hash():
    """JAX prints such an array by its shape only."""
    name = "jax_use_simplified_jaxpr_constants"
    before = getattr(jax.config, name)
    jax.config.update(name, True)
    try:
        x = (jnp.array(1.5),)
        assert fingerprint(under_jit(1.0), x) == fingerprint(under_jit(1.0), x)
        assert fingerprint(under_jit(1.0), x) != fingerprint(under_jit(2.0), x)
    finally:
        jax.config.update(name, before)
