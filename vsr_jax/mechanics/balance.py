r"""The balance of a cross-section: the kernel of all models.

At every X the elastic wrench of the rod, the wrench of the threads and the reaction $\Lambda$ to
the loads beyond X are in balance,

$$r(\xi) = \Sigma (\xi - \xi^*) - B_\tau(\xi) \tau - \Lambda = 0. \qquad (21)$$

Column i of $B_\tau$ is $(d \times t, t) = \partial |t_c| / \partial \xi$, the gradient of thread
i's length, so the tangent

$$H = \frac{\partial r}{\partial \xi} = \Sigma - A, \quad
A = \sum_i \frac{\tau_i}{|t_c|} P^T (1 - t t^T) P, \qquad (13)$$

with $P = [-\tilde d, 1]$, is symmetric. Symbols, each a tuple of component arrays of one shape (see
`component`):

- `xi` $= (k\,[1/m], u\,[-])$: strain, angular first; `rest` $= \xi^*$; `stiffness`: the diagonal of
  $\Sigma$;
- $d = (0, d_y, d_z)$ [m]: where a thread crosses the section; $t_c = k \times d + u + d'$ its
  tangent, $t = t_c / |t_c|$;
- `tau` [N]: thread force, negative for a tendon; `reaction` $= \Lambda$ [N m, N].

On rigid pieces the strain is $\xi^*$ and no unknown: r is zero there, and H is $\Sigma$, so that
it stays positive definite.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..arm.routing import Path, thread_tangent
from ..arm.scene import CrossSections
from ..numerics.batching import TOGETHER, in_parts
from ..numerics.component import (
    Forces,
    Matrix,
    Tree,
    Vector,
    add,
    cholesky,
    cholesky_solve,
    dot,
    free_block,
    free_components,
    multiply,
    scale,
    single,
    spread,
    subtract,
    times,
)
from ..numerics.implicit import implicit_root
from ..numerics.loops import scan
from ..numerics.newton import Evaluation, Root, newton

_LOOPED = 3
"""Threads from which on the program loops over them: two are faster side by side."""

ALL = tuple(range(6))
"""Indices of all strains."""


class Balance(NamedTuple):
    """Solution of the balance: strain, whether it is balanced, whether $H$ is positive definite,
    and the Newton steps."""

    xi: Vector
    balanced: Array
    definite: Array
    steps: Array


def thread_direction(xi: Vector, path: Path) -> tuple[Vector, Array]:
    """Unit tangent $t$ of a thread and the length $|t_c|$ of its path per unit length of the
    arm."""
    t_c = thread_tangent(xi, path)
    length = jnp.sqrt(dot(t_c, t_c))
    return tuple(x / length for x in t_c), length


def thread_wrench(t: Vector, path: Path) -> Vector:
    """Wrench of a unit force along $t$ in a thread (eq. 10): $(d \\times t, t)$."""
    return (path.y * t[2] - path.z * t[1], path.z * t[0], -path.y * t[0], *t)


def unit_wrench(xi: Vector, path: Path) -> Vector:
    """Wrench of a thread per unit of its force, at a strain."""
    return thread_wrench(thread_direction(xi, path)[0], path)


def actuation_wrench(xi: Vector, sections: CrossSections, tau: Forces) -> Vector:
    """Wrench of all threads (eq. 17): $F_a = B_\\tau(\\xi) \\tau$."""

    def more(total: Vector, path: Path, force: Array) -> Vector:
        return add(total, scale(force, unit_wrench(xi, path)))

    return over_threads(more, tuple(jnp.zeros_like(x) for x in xi), sections.paths, tau)


def over_threads(more: Callable, total: Tree, paths: tuple, forces: tuple) -> Tree:
    """A total to which `more` adds the part of each thread, one after another: in a loop of the
    program from `_LOOPED` threads on, where it compiles faster than one copy per thread."""
    threads = tuple(zip(paths, forces, strict=True))
    if len(threads) < _LOOPED:
        for path, force in threads:
            total = more(total, path, force)
        return total
    leaves = jax.tree.leaves((total, threads))
    shape = jnp.broadcast_shapes(*(x.shape for x in leaves))
    total, threads = jax.tree.map(lambda x: jnp.broadcast_to(x, shape), (total, threads))
    listed = jax.tree.map(lambda *same: jnp.stack(same), *threads)
    return scan(lambda total, thread: (more(total, *thread), None), total, listed)[0]


def residual(
    xi: Vector, sections: CrossSections, tau: Forces, reaction: Vector | None = None
) -> Vector:
    """Residual of a cross-section (eq. 21): $r = \\Sigma (\\xi - \\xi^*) - B_\\tau \\tau -
    \\Lambda$, zero on rigid pieces."""
    r = subtract(sections.elastic_wrench(xi), actuation_wrench(xi, sections, tau))
    return times(sections.flexible, r if reaction is None else subtract(r, reaction))


def tangent(xi: Vector, sections: CrossSections, tau: Forces) -> Matrix:
    """Lower triangle of the tangent stiffness (eq. 12-13): $H = \\Sigma - A$, on rigid pieces
    $\\Sigma$."""
    tau = times(sections.flexible, tau)

    def less(lower: Matrix, path: Path, force: Array) -> Matrix:
        return subtract(lower, _thread_stiffness(xi, path, force))

    return over_threads(less, sections.elastic_tangent(xi), sections.paths, tau)


def _thread_stiffness(xi: Vector, path: Path, force: Array) -> Matrix:
    """Lower triangle of one thread's part of A."""
    y, z = path.y, path.z
    t, length = thread_direction(xi, path)
    geometric = force / length
    w = [[geometric * ((1.0 if i == j else 0.0) - t[i] * t[j]) for j in range(3)] for i in range(3)]
    dw = [
        [y * w[2][j] - z * w[1][j] for j in range(3)],
        [z * x for x in w[0]],
        [-y * x for x in w[0]],
    ]  # d~ W
    dwd = [[y * row[2] - z * row[1], z * row[0], -y * row[0]] for row in dw]  # d~ W d~^T
    bending = [tuple(dwd[i][: i + 1]) for i in range(3)]
    linear = [(*(dw[j][i] for j in range(3)), *w[i][: i + 1]) for i in range(3)]
    return (*bending, *linear)


def shortened(xi: Vector, sections: CrossSections, share: float = 0.0) -> Array:
    """Whether the axis, or a thread's path between its ends, has at most a share of its length at
    rest: 0 where it is reversed."""
    short = xi[3] <= share * sections.rest[3]
    if not sections.paths:
        return short
    path, reach = sections.every_path, sections.every_reach
    rest = thread_tangent(sections.rest, path)
    square = dot(rest, rest)
    left = dot(thread_tangent(xi, path), rest) <= share * square
    # a path without length at rest has the direction of its rounding errors
    left = left & (square > (8 * jnp.finfo(square.dtype).eps) ** 2)
    left = left if reach is None else left & (reach > 0)
    return short | (left if len(sections.paths) == 1 else jnp.any(left, axis=0))


def force_scale(stiffness: Vector) -> Array:
    r"""Force that makes a strain of 1, the axial stiffness $\Sigma_{44}$ [N]: the scale of all
    convergence tests."""
    return stiffness[3]


def largest_force_scale(sections: CrossSections) -> Array:
    """Largest `force_scale` of the flexible nodes of an arm [N]."""
    return jnp.max(times(sections.flexible, force_scale(sections.stiffness)), axis=(0, 1))


def strain_norm(wrench: Vector, stiffness: Vector) -> Array:
    r"""Dimensionless size of a wrench as a strain, $\sqrt{F^T \Sigma^{-1} F / \Sigma_{44}}$."""
    strain = tuple(f / s for f, s in zip(wrench, stiffness, strict=True))
    return jnp.sqrt(dot(wrench, strain) / force_scale(stiffness))


def rounding_floor(stiffness: Vector, tau: Forces) -> Array:
    """Rounding error of `strain_norm` of a balanced residual, a multiple of the machine epsilon."""
    scale = force_scale(stiffness)
    load = sum((jnp.abs(force) for force in tau), jnp.zeros_like(scale))
    return 64 * jnp.finfo(scale.dtype).eps * (1 + load / scale)


def forces_where(sound: Array, tau: Forces) -> Forces:
    """Thread forces where the solution is sound, and zero elsewhere, so that later results stay
    finite."""
    return tuple(jnp.where(sound, force, 0.0) for force in tau)


def without_force(tau: Forces) -> Forces:
    """Forces of zero in place of `tau`."""
    return tuple(jnp.zeros_like(force) for force in tau)


def completed(free_part: Vector, sections: CrossSections, free: tuple[int, ...]) -> Vector:
    """Six strains from the free ones, with the rest strain in the others and on rigid pieces."""
    one = free_part[0]
    return tuple(
        _flexed(free_part[free.index(i)], sections.rest[i], sections)
        if i in free
        else jnp.broadcast_to(sections.rest[i], one.shape).astype(one.dtype)
        for i in range(6)
    )


def with_locked(xi: Vector, sections: CrossSections, free: tuple[int, ...]) -> Vector:
    """The free strains of `xi`, with the rest strain in the others and on rigid pieces."""
    return tuple(
        _flexed(x, rest, sections) if i in free else jnp.broadcast_to(rest, x.shape)
        for i, (x, rest) in enumerate(zip(xi, sections.rest, strict=True))
    )


def _flexed(x: Array, rest: Array, sections: CrossSections) -> Array:
    """A strain where the arm can bend, its rest value on rigid pieces."""
    if sections.flexible is None:
        return x
    return jnp.where(sections.flexible > 0, x, rest).astype(x.dtype)


def newton_step(
    xi: Vector, sections: CrossSections, tau: Forces, reaction: Vector | None, free: tuple[int, ...]
) -> tuple[Vector, Vector]:
    """Residual $r$ of the free strains and the step $H^{-1} r$ to subtract, whose last component is
    NaN where $H$ is not positive definite.

    The tangent is factored in single precision at half the cost: only the first digits of a small
    step matter.
    """
    r = free_components(residual(xi, sections, tau, reaction), free)
    factor = cholesky(free_block(tangent(*single((xi, sections, tau))), free))
    step = cholesky_solve(factor, single(r))
    return r, tuple(s.astype(x.dtype) for s, x in zip(step, r, strict=True))


def solve_balance(
    sections: CrossSections,
    tau: Forces,
    reaction: Vector | None = None,
    free: tuple[int, ...] = ALL,
    start: Vector | None = None,
) -> Balance:
    r"""Strain that balances each cross-section (eq. 21), by Newton's method from the rest strain.

    Where $H$ is not positive definite the step is $\Sigma^{-1} r$. Derivatives of any order are
    implicit, $d\xi = -H^{-1} dr$, in forward and reverse mode.

    **Arguments:** component arrays of one shape.
    - `reaction`: $\Lambda$, None without external loads.
    - `free`: indices of the strains that are solved for; the others keep their rest value, as all
      do on rigid pieces.
    - `start`: strain to start from. A section under compression and loads may have several
      solutions, and near collapse Newton's method from rest may miss the only one.

    **Returns:** a `Balance`. `xi` is the last iterate, balanced or not.
    """

    def imbalance(
        x: Vector, sections: CrossSections, tau: Forces, reaction: Vector | None, _: Vector | None
    ) -> Vector:
        return free_components(
            residual(completed(x, sections, free), sections, tau, reaction), free
        )

    def linear_solve(
        x: Vector, sections: CrossSections, tau: Forces, _: Any, __: Any, right: Vector
    ) -> Vector:
        lower = tangent(completed(x, sections, free), sections, tau)
        return cholesky_solve(cholesky(free_block(lower, free)), right)

    def at_rest(x: Vector, sections: CrossSections, tau: Forces, *others: Vector | None) -> tuple:
        return free_components(sections.rest, free), sections, without_force(tau), *others

    root = implicit_root(
        in_parts(partial(_find_balance, free), TOGETHER),
        imbalance,
        linear_solve,
        at_rest,
        sections,
        tau,
        reaction,
        start,
    )
    return Balance(completed(root.x, sections, free), root.converged, root.definite, root.steps)


def _find_balance(
    free: tuple[int, ...],
    sections: CrossSections,
    tau: Forces,
    reaction: Vector | None,
    start: Vector | None,
) -> Root:
    """The free strains of `solve_balance`."""
    stiffness = sections.stiffness
    shape = jnp.broadcast_shapes(
        *(x.shape for x in (*stiffness, *sections.rest, *tau, *(reaction or ())))
    )
    rest = tuple(jnp.broadcast_to(x, shape) for x in sections.rest)
    floor = jnp.broadcast_to(rounding_floor(stiffness, tau), shape)

    compliance = tuple(1 / s for s in stiffness)
    per_force = force_scale(compliance)

    def evaluate(xi: Vector) -> Evaluation:
        r, step = newton_step(xi, sections, tau, reaction, free)
        elastic = multiply(free_components(compliance, free), r)
        definite = ~jnp.isnan(step[-1])
        step = tuple(jnp.where(definite, x, e) for x, e in zip(step, elastic, strict=True))
        size = jnp.sqrt(dot(step, multiply(free_components(stiffness, free), step)) * per_force)
        return Evaluation(spread(step, free), size, jnp.sqrt(dot(r, elastic) * per_force), definite)

    first = rest if start is None else with_locked(start, sections, free)
    xi, definite, steps = newton(evaluate, first, floor)
    imbalance = spread(free_components(residual(xi, sections, tau, reaction), free), free)
    balanced = strain_norm(imbalance, stiffness) <= 16 * floor
    return Root(free_components(xi, free), balanced, definite, steps)
