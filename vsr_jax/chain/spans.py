r"""Stiffness across spans of a chain, which the turning chords of straight tendons are.

A span is one step of the chain or several that follow each other. With the motions $z_0, z_1$ of
the sections at its start and its end, it has the potential

$$\tfrac12 \sum_j (a_j \cdot z_0 + b_j \cdot z_1)^2,$$

so that the wrench beyond its end changes by $-S_{11} z_1 - S_{10} z_0$ and that before its start by
$-S_{01} z_1 - S_{00} z_0$, where $S_{10} = \sum_j b_j a_j^T$ and so on.

A pass from the tip knows the wrench beyond the end of a span by the motion there. It adds $-S_{11}$
to that, and takes the force $\phi = -S_{10} z_0$ as an unknown of the steps of the span, with
columns of its own in all that it keeps, and with the motion of the end of the span beside the
wrench. At the start of the span $\phi$ is known by the motion there, and $-S_{01} z_1 - S_{00} z_0$
is added.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..numerics.loops import scan
from ..numerics.once import once
from ..numerics.stacked import blocks, columns, cross, identity, product, rows, skew, transpose


class Spans(NamedTuple):
    """Springs across spans, at each step those of the span in which it lies.

    - `start`, `end`: the wrenches a and b on the sections at both ends, (6, springs, steps, *arms).
    - `opens`: 1 where a span begins with the step, or no span contains it, else 0; (steps, *arms).
    """

    start: Array
    end: Array
    opens: Array

    def stiffness(self, reach: Array) -> "SpanStiffness":
        """The stiffness of all spans, about the hinges of the chain.

        **Arguments:** `reach`: from the starts of the steps to their first hinges, (3, steps,
        *arms).
        """
        beyond = jnp.concatenate([reach[:, 1:], jnp.zeros_like(reach[:, :1])], axis=1)
        one = jnp.broadcast_to(identity(reach[None]), (3, 3, *reach.shape[1:]))
        to_hinge = blocks(one, -skew(beyond), jnp.zeros_like(one), one)
        force = rows(self.start, 3, 6)
        a = jnp.concatenate([rows(self.start, 0, 3) - cross(reach[:, None], force), force])
        b = once(product(to_hinge, self.end))
        return SpanStiffness(
            once(product(a, transpose(a))),
            once(product(self.end, transpose(a))),
            once(product(b, transpose(b))),
            to_hinge,
            self.opens > 0,
            jnp.concatenate([self.opens[1:], jnp.ones_like(self.opens[:1])]) > 0,
        )


class SpanStiffness(NamedTuple):
    r"""The stiffness of spans at each step, in the motions of hinges.

    - `start`: $S_{00}$ about the first hinge of the step, where a span `opens` there.
    - `across`: $S_{10}$, from there to the section at the end of the span.
    - `end`: $S_{11}$ about the first hinge behind the step, where a span `closes` there.
    - `to_hinge`: wrenches on the section at the end of the step about that hinge.

    All (6, 6, steps, *arms), the flags (steps, *arms).
    """

    start: Array
    across: Array
    end: Array
    to_hinge: Array
    opens: Array
    closes: Array

    def closing(self, wrench: Array, ends: Array) -> tuple[Array, Array]:
        r"""The wrench beyond the end of a step and the motion of the section at the end of its
        span, (6, columns, *arms), by the motion there, the force $\phi = -S_{10} z_0$ on that
        section, and the right sides.

        **Arguments:** the same of the step after it, which count where the span goes on.
        """
        here, sides = columns(wrench, 0, 6) - self.end, columns(wrench, 12, wrench.shape[1])
        new = jnp.concatenate([here, self.to_hinge, sides], axis=1)
        own = jnp.pad(transpose(self.to_hinge), _more(here, new.shape[1] - 6))
        return jnp.where(self.closes, new, wrench), jnp.where(self.closes, own, ends)

    def opening(self, wrench: Array, ends: Array) -> tuple[Array, Array]:
        r"""The same before the start of a step, with $\phi$ known where the span begins there."""
        known = [_with_start(x, self.across) for x in (wrench, ends)]
        more = product(transpose(self.across), known[1])
        start = jnp.pad(self.start, _more(self.start, wrench.shape[1] - 6))
        found = once(known[0] - more - start)
        return jnp.where(self.opens, found, wrench), jnp.where(self.opens, known[1], ends)

    def force(self, z: Array, force: Array) -> Array:
        r"""The force $\phi$ of the span of a step from the motion at its start."""
        return jnp.where(self.opens, -product(self.across, z), force)

    def wrenches(self, z: Array, arms: int) -> Array:
        """The wrenches at the ends of all steps, (steps, 6, sides, *arms), of motions at all starts
        and the tip, (steps + 1, 6, sides, *arms)."""
        each = jax.tree.map(lambda x: jnp.moveaxis(x, -1 - arms, 0), self)

        def forward(force: Array, now: tuple) -> tuple[Array, Array]:
            span, z = now
            force = span.force(z, force)
            return force, force

        def backward(last: Array, now: tuple) -> tuple[Array, tuple]:
            span, force, z, end = now
            last = jnp.where(span.closes, product(transpose(span.to_hinge), end), last)
            at_end = product(span.to_hinge, force) - product(span.end, end)
            at_start = -product(transpose(span.across), last) - product(span.start, z)
            found = [(span.closes, at_end), (span.opens, at_start)]
            return last, tuple(jnp.where(there, x, 0.0) for there, x in found)

        _, force = scan(forward, z[0], (each, z[:-1]))
        _, (ends, starts) = scan(backward, z[-1], (each, force, z[:-1], z[1:]), reverse=True)
        return ends + jnp.concatenate([starts[1:], jnp.zeros_like(starts[:1])])


def _with_start(x: Array, across: Array) -> Array:
    """What depends on the motion at the start and on the force, with that force by the motion."""
    motion, force = columns(x, 0, 6), columns(x, 6, 12)
    known = once(motion - product(force, across))
    return jnp.concatenate([known, jnp.zeros_like(known), columns(x, 12, x.shape[1])], axis=1)


def _more(matrix: Array, number: int) -> list[tuple[int, int]]:
    """Padding of a matrix by a number of columns."""
    return [(0, 0), (0, number), *[(0, 0)] * (matrix.ndim - 2)]
