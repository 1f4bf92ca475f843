r"""The hinges of a chain, and the elimination of one of them.

Each node represents a cell of its weight w, integrated by the midpoint rule: the arm is a chain of
hinges at the nodes, which turn by $w\kappa$ and slide by $w\upsilon$, with stiff links between
them. All is in the world's axes and, at each hinge, about its point. The motion
of the arm beyond a hinge is $z = (\theta, \rho)$, rotation and displacement; the change of the
wrench there, as seen by the moving section, is $Q z + q$. With the wrench $W = (m, n)$ and

$$A = \begin{pmatrix} -\tilde m & -\tilde n \\ -\tilde n & 0 \end{pmatrix}, \quad
\hat Q = Q + \tfrac12 A,$$

$\hat Q$ is symmetric where the loads have a potential. It is the stiffness of the arm beyond,
springs included, so that a stiff spring is eliminated exactly. A hinge with the strain $\delta\xi =
(\kappa, \upsilon)$ and the motion z before it has

$$(H + H_w - w \hat Q) \, \delta\xi = (\hat Q - \tfrac12 A) z + q + b$$

and before it is $\hat Q z + q + w (\hat Q + \tfrac12 A) \, \delta\xi$. A cell bends evenly, and
not at a hinge: by the midpoint rule this adds $H_w = \tfrac{w^2}8 (\tilde u \tilde n + \tilde n
\tilde u)$ to the bending stiffness, with the axis u; without it an arm that buckles seems too soft.
A link of the vector d to the next hinge moves what is beyond it by $\rho + \theta \times d$. Loads
between two nodes act on the link, at the end of the first cell, the vector r from its node: those
with the wrench (c, f) and the derivative K by the motion, both about the node, add

$$K + \begin{pmatrix} \tilde f \tilde r & 0 \\ 0 & 0 \end{pmatrix} +
\tfrac12 \begin{pmatrix} \tilde c & -\tilde f \\ \tilde f & 0 \end{pmatrix}.$$

A contact acts inside a cell. Behind the part $\alpha$ of it the arm has moved by $z + \alpha w
\delta\xi$, about the node; with the derivative K and a given change p of the wrench there, the
hinge has $H + H_w - w (\hat Q + \alpha^2 K)$ and $(\hat Q - \tfrac12 A + \alpha K) z + q + \alpha p
+ b$, and before it is $(\hat Q + K) z + q + p + w (\hat Q + \tfrac12 A + \alpha K) \, \delta\xi$.
Contacts on neighbouring steps are so near to each other that the compliance of their own cells
decides on their forces.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics.component import Matrix
from ..numerics.once import once
from ..numerics.quadrature import Grid
from ..numerics.stacked import blocks, columns, cross, matmul, product, rows, skew, transpose
from .coupled import Coupled
from .definiteness import factored_block
from .nodes import at_last_nodes, block_of, whole


class Hinge(NamedTuple):
    r"""The hinge at a node, of size 3 if only bending and twist are free, else 6, the link to the
    next one, and the loads on it. All that the passes need is prepared for all hinges at once.

    The first six columns belong to the motion, the last to the right sides; those between them, if
    there are any, to other unknowns of the passes, zero here.

    - `width` w; `link`: vector d to the next hinge or the tip; `rotation` of the section.
    - `lever`: $(\tilde d, 0)$, shape (3, columns).
    - `stiff`: $H + H_w$ in blocks (3, 3): of bending and, of size 6, of bending with linear strains
      and of these.
    - `given`: $(-\tfrac12 A, b)$, shape (6, columns).
    - `load`: derivative of the loads on the link by its motion, shape (6, columns).
    - `flexible`: 1, or 0 where the section is rigid; None without rigid pieces.
    - `inside`: as `load`, of what acts in the cell, and the part of the cell before it; None if
      nothing does.
    """

    width: Array
    link: Array
    rotation: Array
    lever: Array
    stiff: tuple[Array, ...]
    given: Array
    load: Array
    flexible: Array | None
    inside: tuple[Array, Array] | None


def hinges_of(
    H: Matrix,
    right: Array,
    coupled: Coupled,
    grid: Grid,
    flexible: Array | None,
    push: Array | None,
    unknowns: int,
    *,
    linear: bool,
) -> Hinge:
    """All hinges, in the last axes (stages, steps, *arms).

    **Arguments:** `right`, `push`: right sides (6, sides, stages, steps, *arms), `push` in the
    world's axes; `unknowns`: number of columns between those of motions and those of right sides;
    `linear`: whether linear strains are free.
    """
    shape, sides = right.shape[2:], right.shape[1]
    all_of = partial(whole, shape=shape)
    R, w, wrench = all_of(coupled.rotation), all_of(grid.weight), once(all_of(coupled.wrench))
    reach = once(0.5 * w * all_of(coupled.axis))  # from the node to the end of its cell
    link = once(reach + _after(reach, len(shape)))
    load = _on_links(wrench, reach, link, coupled, grid)
    b = once(jnp.concatenate([matmul(R, part) for part in halves(right)]))
    stiff = _seen_from(R, block_of(H, 0, 0, shape))
    even = matmul(skew(reach), skew(rows(wrench, 3, 6)))
    stiff = [once(stiff + 0.25 * w * (even + transpose(even)))]
    if linear:
        stiff += [_seen_from(R, block_of(H, i, 3, shape)) for i in (0, 3)]
    inside = None
    if coupled.cells is not None and coupled.part is not None:
        cells = all_of(coupled.cells)
        cells = _wider(cells, unknowns + sides) if push is None else _beside(cells, push, unknowns)
        inside = cells, all_of(coupled.part)
    load, given = _wider(load, unknowns + sides), _beside(-_half(wrench), b, unknowns)
    lever = _wider(skew(link), 3 + unknowns + sides)
    flexible = None if flexible is None else all_of(flexible)
    return Hinge(w, link, R, lever, tuple(stiff), given, load, flexible, inside)


def _on_links(wrench: Array, reach: Array, link: Array, coupled: Coupled, grid: Grid) -> Array:
    """Derivatives (6, 6, stages, steps, *arms) of the loads on all links by their motions, about
    the nodes before them.

    **Arguments:** `wrench` at the nodes; vectors `reach` from these to the ends of their cells and
    `link` to the next nodes; all of them (..., stages, steps, *arms).
    """
    shape = wrench.shape[1:]
    after = partial(_after, axes=len(shape))
    later = once(after(wrench))
    (m, n), (moment, force) = halves(wrench), halves(later)
    load = once(jnp.concatenate([m - moment - cross(link, force), n - force]))
    moved = matmul(skew(rows(load, 3, 6)), skew(reach))
    half = _half(load)
    load = blocks(moved - half[:3, :3], half[:3, 3:], -half[3:, :3], half[3:, 3:])
    if coupled.ends is not None:
        jump = jnp.broadcast_to(coupled.ends, (*coupled.ends.shape[:2], *shape[1:]))
        load = load + at_last_nodes(_carried(jump, reach[:, -1]), shape[0])
    if coupled.density is not None:
        density = 0.5 * whole(grid.weight, shape) * whole(coupled.density, shape)
        load = load + density + _carried(after(density), link)
    return load


def _after(x: Array, axes: int) -> Array:
    """Values at the next nodes, zero beyond the tip, with so many axes (stages, steps, *arms)."""
    stage = x.ndim - axes
    others = lax.slice_in_dim(x, 1, None, axis=stage)
    later = lax.slice_in_dim(lax.slice_in_dim(x, 0, 1, axis=stage), 1, None, axis=stage + 1)
    room = [(0, 0)] * x.ndim
    room[stage + 1] = (0, 1)
    return jnp.concatenate([others, jnp.pad(later, room)], axis=stage)


def before(
    free: tuple[int, ...], end: tuple[Array, Array], hinge: Hinge
) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
    r"""One hinge: from $\hat Q$ and q before the next one to those before it, the moments (3,
    columns) and the forces; the strain by the motion of the section before the hinge and by the
    other columns (size, columns), the number of negative pivots, the compliance of bending, and the
    change of the moment beyond by the rotation (3, 3).

    Moments and forces are apart, since XLA does not fuse what joins arrays."""
    w = hinge.width
    load, given = (halves(x) for x in (hinge.load, hinge.given))
    linked = _before_link(end, hinge.lever)
    beyond = linked[0] + load[0], linked[1] + load[1]
    # what a strain and a motion before the hinge do, and a strain to itself
    bent = twice = whole_cell = beyond
    if hinge.inside is not None:
        inside, part = halves(hinge.inside[0]), hinge.inside[1]
        bent = tuple(x + part * y for x, y in zip(beyond, inside, strict=True))
        twice = tuple(x + part**2 * y for x, y in zip(beyond, inside, strict=True))
        whole_cell = tuple(x + y for x, y in zip(beyond, inside, strict=True))
    right = tuple(once(x + y) for x, y in zip(bent, given, strict=True))
    D = _pivot(hinge.stiff, w, twice)
    X, negative, compliance = solved(D, right, hinge.rotation, free)
    if hinge.flexible is not None:
        bends = hinge.flexible > 0
        X = tuple(jnp.where(bends, x, 0.0) for x in X)
        compliance = jnp.where(bends, compliance, 0.0)
        negative = jnp.where(bends, negative, 0)
    start = []
    for Q, held, half in zip(bent, whole_cell, given, strict=True):
        turning = once(w * columns(Q - half, 0, 3 * len(X)))
        parts = [product(columns(turning, 3 * i, 3 * i + 3), x) for i, x in enumerate(X)]
        start.append(once(sum(parts, held)))
    Q = columns(beyond[0], 0, 3)
    return (start[0], start[1]), (jnp.concatenate(X), negative, compliance, Q)


def behind(
    motion: Array, link: Array, width: Array, X: Array, others: Array
) -> tuple[Array, Array]:
    r"""The motions before the next hinge and the strains of one, from the motions (6, n) before it,
    X (size, 6) and `others` (size, n): $X z + x$, with the motion z before the hinge."""
    strain = once(product(X, motion) + others)
    return motion_behind(motion, strain, link, width), strain


def motion_behind(motion: Array, strain: Array, link: Array, width: Array) -> Array:
    """The motions before the next hinge from those before a hinge and its strains, all (..., n)."""
    turn = once(rows(motion, 0, 3) + width * rows(strain, 0, 3))
    shift = rows(motion, 3, 6) + cross(turn, link[:, None])
    if len(strain) == 6:
        shift = shift + width * rows(strain, 3, 6)
    return once(jnp.concatenate([turn, shift]))


def _pivot(
    stiff: tuple[Array, ...], w: Array, twice: tuple[Array, ...]
) -> tuple[tuple[Array, ...], ...]:
    """The system of a hinge in blocks: its stiffness less what the arm beyond takes."""

    def less(block: Array, i: int, j: int) -> Array:
        return block - w * columns(twice[i], 3 * j, 3 * j + 3)

    bending = less(stiff[0], 0, 0)
    if len(stiff) == 1:
        return ((bending,),)
    _, mixed, linear = stiff
    below = once(less(transpose(mixed), 1, 0))
    return (bending, less(mixed, 0, 1)), (below, less(linear, 1, 1))


def _half(wrench: Array) -> Array:
    r"""$\tfrac12 A$ of a wrench (6)."""
    m, n = (-0.5 * skew(rows(wrench, i, i + 3)) for i in (0, 3))
    return blocks(m, n, n, jnp.zeros_like(m))


def solved(
    D: tuple[tuple[Array, ...], ...], right: tuple[Array, ...], R: Array, free: tuple[int, ...]
) -> tuple[tuple[Array, ...], Array, Array]:
    """Solution of the system of a hinge, in blocks, for the free strains of a section with the
    rotation R, zero for the others, the number of negative eigenvalues of D, and the inverse of its
    bending block."""
    bent, stretched = tuple(i for i in free if i < 3), tuple(i - 3 for i in free if i > 2)
    if not stretched:
        up, down, negative = _factored(D[0][0], R, bent)
        return (matmul(up, matmul(down, right[0])),), negative, matmul(up, down)
    (a, b), (below, d) = D
    stretch, down, first = _factored(d, R, stretched)
    across, below, pulled = matmul(b, stretch), matmul(down, below), matmul(down, right[1])
    bend, down, second = _factored(a - product(across, below), R, bent)
    bending = matmul(bend, matmul(down, right[0] - product(across, pulled)))
    stretched = matmul(stretch, pulled - product(below, bending))
    return (bending, stretched), first + second, matmul(bend, down)


def _factored(matrix: Array, R: Array, places: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """Factors of the inverse for the free strains among three of the section, and its negative
    eigenvalues."""
    matrix = once(matrix)
    if len(places) == 3:
        return factored_block(matrix, places)
    up, down, negative = factored_block(_seen_from(transpose(R), matrix), places)
    return matmul(R, up), matmul(down, transpose(R)), negative


def _seen_from(R: Array, matrix: Array) -> Array:
    r"""$R M R^T$."""
    return matmul(matmul(R, matrix), transpose(R))


def _before_link(beyond: tuple[Array, Array], lever: Array) -> tuple[Array, Array]:
    """What acts at the end of a link by the motion there, its moments and forces (3, 7, ...), at
    its start."""
    moment, force = beyond
    moment = once(moment + product(columns(lever, 0, 3), force))
    moved, pushed = (once(x - product(columns(x, 3, 6), lever)) for x in (moment, force))
    return moved, pushed


def _carried(beyond: Array, link: Array) -> Array:
    """As `_before_link`, of derivatives (6, 6, ...) alone."""
    d = skew(link)
    above, below = rows(beyond, 0, 3), rows(beyond, 3, 6)
    beyond = jnp.concatenate([above + matmul(d, below), below])
    turning = columns(beyond, 0, 3) - matmul(columns(beyond, 3, 6), d)
    return jnp.concatenate([turning, columns(beyond, 3, 6)], axis=1)


def halves(x: Array) -> tuple[Array, Array]:
    """The rows of moments and those of forces."""
    first, second = lax.split(x, (3, 3))
    return first, second


def _wider(matrix: Array, more: int) -> Array:
    """A matrix with so many columns of zeros more."""
    return jnp.pad(matrix, [(0, 0), (0, more), *[(0, 0)] * (matrix.ndim - 2)])


def _beside(matrix: Array, sides: Array, between: int) -> Array:
    """A matrix, so many columns of zeros, and the columns of right sides."""
    return jnp.concatenate([_wider(matrix, between), sides], axis=1)
