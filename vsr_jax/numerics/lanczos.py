r"""Smallest and largest eigenvalue of a symmetric operator, from its products with vectors, by the
Lanczos method.

From a start $v_1$ the recurrence $\beta_j v_{j+1} = S v_j - \alpha_j v_j - \beta_{j-1} v_{j-1}$
builds an orthonormal basis $V$ in which S is the tridiagonal matrix $T = V^T S V$. The ends of its
spectrum approach those of S first. With $T s = \theta s$ the pair $(\theta, V s)$ leaves the
residual $|S V s - \theta V s| = \beta_m |s_m|$, which bounds the distance of $\theta$ to an
eigenvalue of S. Every new vector is orthogonalised against all earlier ones. LAPACK is not called,
so that any number of operators can be batched.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float

from .implicit import change_of
from .loops import fori_loop, scan, while_loop

_MOST = 256
"""Bound on the number of products, or a quarter of the unknowns if that is more. Arms take 20 to
80, and more where an end of the spectrum is the edge of the band of the sections' own tangents."""

_BETWEEN = 8
"""Products between two computations of the spectrum of T."""

_SECTIONS = 256
"""Parts into which an interval with an eigenvalue is divided at a time, which gives 8 bits of
it."""


class Operator(eqx.Module):
    """A symmetric operator on arrays of one shape. Its eigenpairs can be differentiated by its
    arrays."""

    @property
    @abstractmethod
    def like(self) -> Array:
        """Any array of the shape and dtype of the vectors."""

    @abstractmethod
    def product(self) -> Callable[[Array], Array]:
        """The function $v \\mapsto S v$, in the allowed space; zero for vectors orthogonal to it.
        What does not depend on v is computed once."""

    @abstractmethod
    def allowed(self, v: Array) -> Array:
        """Orthogonal projection onto the space of the eigenvectors that are sought."""


class Pairs(NamedTuple):
    """Smallest and largest eigenvalue, shape (2,), with their unit eigenvectors, shape (2, ...);
    NaN where not found."""

    values: Float[Array, "2"]
    vectors: Float[Array, "2 *shape"]


class _KrylovBasis(NamedTuple):
    """Lanczos vectors in rows, diagonal and subdiagonal of T, the next vector, the number of
    vectors; the ends of the spectrum of T, their vectors in the basis and residuals."""

    rows: Array
    alpha: Array
    beta: Array
    following: Array
    filled: Array
    values: Array
    s: Array
    residual: Array


@jax.custom_jvp
def extreme_pairs(operator: Operator) -> Pairs:
    r"""Ends of the spectrum of a symmetric operator.

    Residuals reach $\epsilon^{0.6}$ for the smallest eigenvalue and $\epsilon^{0.4}$ for the
    largest, relative where the eigenvalue is above 1 in size. At the edge of a band of close
    eigenvalues residuals fall slowly: an eigenvalue is NaN where its own stays above
    $\epsilon^{0.5}$, of the largest $\epsilon^{0.4}$, and $\epsilon^{0.25}$ of its size.
    Derivatives are exact, of any order: $d\lambda = v^T dS\, v$ and
    $(S - \lambda)\, dv = -(dS - d\lambda) v$ by conjugate gradients. A multiple eigenvalue has no
    derivative; the result is the derivative along one of its eigenvectors.
    """
    product = operator.product()
    start = np.random.default_rng(0).standard_normal(operator.like.shape)
    start = operator.allowed(jnp.asarray(start, operator.like.dtype))
    eps = float(jnp.finfo(start.dtype).eps)

    def unsettled(basis: _KrylovBasis, least: float, greatest: float) -> Array:
        return basis.residual > jnp.array([least, greatest], start.dtype) * jnp.maximum(
            1, jnp.abs(basis.values)
        )

    def proceed(basis: _KrylovBasis) -> Array:
        return (basis.filled < basis.alpha.size) & jnp.any(unsettled(basis, eps**0.6, eps**0.4))

    def extend(basis: _KrylovBasis) -> _KrylovBasis:
        return _with_ritz(
            fori_loop(0, _BETWEEN, lambda _, basis: _one_more(operator, product, basis), basis)
        )

    basis = while_loop(proceed, extend, _empty(start))
    found = ~unsettled(basis, eps**0.5, eps**0.4)
    found |= basis.residual < eps**0.25 * jnp.abs(basis.values)
    vectors = (basis.s @ basis.rows).reshape(2, *start.shape)
    places = (2,) + (1,) * start.ndim
    return Pairs(
        jnp.where(found, basis.values, jnp.nan), jnp.where(found.reshape(places), vectors, jnp.nan)
    )


def _empty(start: Array) -> _KrylovBasis:
    size = -(-min(start.size, max(_MOST, start.size // 4)) // _BETWEEN) * _BETWEEN
    flat = start.reshape(-1)
    zero, two = jnp.zeros(size, flat.dtype), jnp.zeros(2, flat.dtype)
    unit = flat / jnp.sqrt(jnp.sum(flat**2))
    return _KrylovBasis(
        jnp.zeros((size, flat.size), flat.dtype),
        zero,
        zero,
        unit,
        jnp.zeros((), jnp.int32),
        two,
        jnp.zeros((2, size), flat.dtype),
        two + jnp.inf,
    )


def _one_more(operator: Operator, product: Callable, basis: _KrylovBasis) -> _KrylovBasis:
    """Add one vector. Once the basis spans an invariant space, further vectors are zero and T is
    padded with an entry from inside its spectrum."""
    v, j = basis.following, basis.filled
    rows = basis.rows.at[j].set(v)
    w = product(v.reshape(operator.like.shape)).reshape(-1)
    parts = rows @ w
    w = operator.allowed((w - parts @ rows).reshape(operator.like.shape)).reshape(
        -1
    )  # rounding errors outside the allowed space would grow
    w = w - (rows @ w) @ rows
    size = jnp.sqrt(jnp.sum(w**2))
    alpha = basis.alpha.at[j].set(jnp.where(jnp.any(v != 0), parts[j], basis.alpha[0]))
    more = size > 64 * jnp.finfo(w.dtype).eps * jnp.max(jnp.abs(alpha))
    beta = basis.beta.at[j].set(jnp.where(more, size, 0.0))
    following = jnp.where(more, w / jnp.where(more, size, 1.0), 0.0)
    return basis._replace(rows=rows, alpha=alpha, beta=beta, following=following, filled=j + 1)


def _with_ritz(basis: _KrylovBasis) -> _KrylovBasis:
    """The ends of the spectrum of T, with their vectors and residuals."""
    filled = jnp.arange(basis.alpha.size) < basis.filled
    alpha = jnp.where(
        filled, basis.alpha, basis.alpha[0]
    )  # lies inside the spectrum, and beta is 0 there
    link = jnp.where(jnp.arange(basis.alpha.size) < basis.filled - 1, basis.beta, 0.0)
    values = _ends(alpha, link, basis.filled)
    s = jax.vmap(lambda x: _vector(alpha, link, x))(values)
    return basis._replace(
        values=values, s=s, residual=basis.beta[basis.filled - 1] * jnp.abs(s[:, basis.filled - 1])
    )


def _pivots(alpha: Array, link: Array, x: Array) -> Array:
    r"""Pivots of $T - x$ from the first row on, $d_j = \alpha_j - x - \beta_{j-1}^2 / d_{j-1}$,
    none of them zero."""

    def row(d: Array, entry: tuple[Array, Array]) -> tuple[Array, Array]:
        d = _pivot(entry[0] - x, entry[1], d)
        return d, d

    return scan(row, jnp.ones_like(x), (alpha, _shifted(link)))[1]


def _pivot(diagonal: Array, link: Array, last: Array) -> Array:
    """The next pivot, never zero."""
    least = jnp.finfo(last.dtype).tiny ** 0.5
    d = diagonal - link**2 / last
    return jnp.where(jnp.abs(d) < least, -least, d)


def _shifted(link: Array) -> Array:
    """Subdiagonal entries indexed by their lower row instead of their upper one."""
    return jnp.concatenate([jnp.zeros_like(link[:1]), link[:-1]])


def _ends(alpha: Array, link: Array, count: Array) -> Array:
    """Smallest and largest eigenvalue of T, by multisection with counts of negative pivots."""
    before = _shifted(link)
    reach = jnp.abs(link) + before
    low, high = jnp.min(alpha - reach), jnp.max(alpha + reach)
    wanted = jnp.stack([jnp.ones_like(count), count])[:, None]
    part = jnp.arange(1, _SECTIONS, dtype=alpha.dtype) / _SECTIONS

    def cut(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        x = low[:, None] + (high - low)[:, None] * part

        def row(j: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            d = _pivot(alpha[j] - x, before[j], carry[0])
            return d, carry[1] + (d < 0)

        _, negative = fori_loop(0, count, row, (jnp.ones_like(x), jnp.zeros(x.shape, jnp.int32)))
        above = negative >= wanted
        return jnp.max(jnp.where(above, low[:, None], x), axis=1), jnp.min(
            jnp.where(above, x, high[:, None]), axis=1
        )

    rounds = -(-jnp.finfo(alpha.dtype).nmant // 8) + 1
    low, high = fori_loop(0, rounds, cut, (jnp.stack([low, low]), jnp.stack([high, high])))
    return 0.5 * (low + high)


def _vector(alpha: Array, link: Array, x: Array) -> Array:
    """Unit eigenvector of T, from the row where the pivots from both ends meet best (a twisted
    factorisation)."""
    before = _shifted(link)
    down, up = _pivots(alpha, link, x), _pivots(alpha[::-1], before[::-1], x)[::-1]
    place = jnp.arange(alpha.size)
    k = jnp.argmin(jnp.abs(down + up - (alpha - x)))
    back = lax.cumprod(jnp.where(place < k, -link / down, 1.0), reverse=True)
    ahead = lax.cumprod(jnp.where(place > k, -before / up, 1.0))
    s = back * ahead
    return s / jnp.sqrt(jnp.sum(s**2))


def _solve(operator: Operator, value: Array, v: Array, sign: float, right: Array) -> Array:
    r"""Solution of $(S - \lambda) x = b$ orthogonal to v in the allowed space, with b projected
    onto it; NaN where not found."""

    def project(x: Array) -> Array:
        x = operator.allowed(x)
        return x - jnp.sum(v * x) * v

    def definite(x: Array) -> Array:
        inside = project(x)
        return sign * project(product(inside) - value * inside) + x - inside

    product = operator.product()
    eps, right = float(jnp.finfo(right.dtype).eps), sign * project(right)
    x, _ = cg(definite, right, tol=eps**0.8, maxiter=1000)
    left = definite(x) - right
    found = jnp.sum(left**2) <= eps * jnp.sum(right**2)
    return jnp.where(found, x, jnp.nan)


@partial(extreme_pairs.defjvp, symbolic_zeros=True)
def _extreme_pairs_jvp(primals: tuple, tangents: tuple) -> tuple[Pairs, Pairs]:
    (operator,) = primals
    pairs = extreme_pairs(operator)
    values, vectors = [], []
    for value, v, sign in zip(pairs.values, pairs.vectors, (1.0, -1.0), strict=True):
        product, moved = change_of(
            lambda operator, v=v: (operator.product()(v), operator.allowed(v)), primals, tangents
        )
        values.append(jnp.sum(v * product))
        vectors.append(moved - _solve(operator, value, v, sign, product))
    return pairs, Pairs(jnp.stack(values), jnp.stack(vectors))
