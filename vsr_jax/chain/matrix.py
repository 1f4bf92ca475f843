r"""The matrix of a chain: how the balance of all cross-sections of an arm changes with its strain.

A change of strain $\delta\xi$ at a node turns and shifts all that lies beyond it, and that changes
the wrenches there. The residual changes by

$$b = H \, \delta\xi - \delta\Lambda,$$

with the stiffness H of the sections and the change $\delta\Lambda$ of the wrench on each: see
`step_passes` for loads that change with the turns of sections, if at all, and `hinges` for what
depends on positions. All rows and columns are those of the sections' free strains; what else
couples far places is stiffness across a span (`spans`) or a border (`border`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics import component as c
from ..numerics.component import Matrix, Vector
from ..numerics.once import once
from ..numerics.quadrature import Grid
from ..numerics.stacked import components, cross, matmul, rows, stack, total, transpose, turned
from .coupled import Coupled
from .definiteness import UNSTABLE_SECTION, Definiteness, definiteness
from .hinge_passes import multiplied_by_hinges, solved_by_hinges, solved_by_joints
from .hinges import Hinge, hinges_of
from .nodes import whole
from .spans import Spans, SpanStiffness
from .step_passes import changes_by_steps, solved_by_steps, step_nodes


class Chain(NamedTuple):
    """The matrix of a chain, for arms in the last axes.

    - `stiffness`: lower triangle of H, components (stages, steps, *arms); `free`: the strains that
      are not locked; `flexible`: 0 on rigid pieces and 1 elsewhere, None without.
    - `coupled`: None where each section is balanced by itself.
    """

    stiffness: Matrix
    free: tuple[int, ...]
    flexible: Array | None
    coupled: Coupled | None
    grid: Grid

    def solve(
        self, right: Vector, push: Array | None = None, *, apart: bool = False
    ) -> tuple[Vector, Definiteness]:
        r"""Solution $\delta\xi$ for right sides b, and the `Definiteness` of the matrix.

        **Arguments:**
        - `right`: six components (sides, stages, steps, *arms).
        - `push`: given changes (sides, 6, stages, steps, *arms) of the wrenches in the cells in the
          world's axes, about the nodes: right sides too.
        - `apart`: one arm node by node too, whose derivative by the right sides is the smaller
          program, and takes three quarters of the time.

        **Returns:** six components, zero for locked strains and on rigid pieces; meaningless where
        the matrix is singular.
        """
        coupled = self.coupled
        if coupled is None or min(self.free) > 2:
            return self._each_alone(right)
        b, push = self._sides(right, push)
        if coupled.motion < 6:
            return self._by_steps(coupled, b)
        # by steps, single precision loses signs of pivots of a limp arm under tension, for which a
        # step without what lies beyond it is indefinite
        limp = push is not None and b.dtype == jnp.float32
        by_hinges, spans = apart or b.ndim > 4 or limp, self._spans(coupled, b)
        unknowns = 0 if by_hinges and spans is None else 6
        hinges = self._hinges(coupled, b, push, unknowns)
        solved = solved_by_hinges if by_hinges else solved_by_joints
        strain, negative, asymmetry = solved(hinges, self.grid, self.free, spans)
        found = self._free_part(self._turned(transpose(coupled.rotation), strain))
        return found, definiteness(negative, asymmetry, self.grid)

    def product(self, strain: Vector) -> Vector:
        r"""The product b with changes of strain $\delta\xi$, six components (sides, stages, steps,
        *arms), both zero for locked strains and on rigid pieces."""
        coupled, H = self.coupled, c.symmetric(self.stiffness)
        if coupled is None or min(self.free) > 2:
            return c.times(self.flexible, self._free_part(jnp.stack(c.matvec(H, strain))))
        change, _ = self._sides(strain, None)
        world, back = self._turned(coupled.rotation, change), transpose(coupled.rotation)
        if coupled.motion == 6:
            hinges = self._hinges(coupled, jnp.zeros_like(change), None, 0)
            wrench = multiplied_by_hinges(hinges, world, self.grid, self._spans(coupled, change))
            return c.times(self.flexible, self._free_part(self._turned(back, wrench)))
        nodes = step_nodes(H, change[:, 0], coupled, self.grid, self.flexible)
        moved = jax.vmap(lambda x: changes_by_steps(nodes, x, self.grid), 1, 1)(world)
        stiff = jnp.stack(c.matvec(H, tuple(change)))
        return c.times(self.flexible, self._free_part(stiff - self._turned(back, moved)))

    def motions(self, strain: Vector) -> Array:
        """Rotations and displacements (6, stages, steps, *arms) in the world's axes, behind the
        `part` of each cell, by a change of strain, components (stages, steps, *arms)."""
        coupled, weight = self.coupled, self.grid.weight
        assert coupled is not None
        change = weight * turned(coupled.rotation, stack(strain))

        def summed(x: Array) -> Array:
            """Sums over the cells from the base, that of each itself included."""
            of_step = total(x, 1)
            before = jnp.cumsum(of_step, axis=1) - of_step
            return before[:, None] + jnp.cumsum(x, axis=1)

        bent, slid = rows(change, 0, 3), rows(change, 3, 6)
        ends, reach = summed(bent), 0.5 * weight * coupled.axis
        moved = cross(2.0 * ends - bent, reach) + slid
        there = summed(moved) - cross(ends, reach)  # behind the hinge at the node
        ahead = 1.0 if coupled.part is None else 1.0 - coupled.part
        return once(jnp.concatenate([ends - ahead * bent, there - ahead * slid]))

    def to_dense(self) -> Float[Array, "n n"]:
        """The matrix of one arm, for the free strains of the flexible nodes."""
        shape = self.grid.X.shape
        bends = np.ones(shape, bool) if self.flexible is None else np.asarray(self.flexible) > 0
        places = np.argwhere(np.broadcast_to(bends, (len(self.free), *shape)))
        places[:, 0] = np.array(self.free)[places[:, 0]]
        unit = np.zeros((len(places), 6, *shape))
        unit[np.arange(len(places)), *places.T] = 1.0
        columns = self.product(tuple(jnp.asarray(unit[:, i]) for i in range(6)))
        return jnp.stack(columns)[places[:, 0], :, places[:, 1], places[:, 2]]

    def _each_alone(self, right: Vector) -> tuple[Vector, Definiteness]:
        """The solution where no section acts on another."""
        right = c.free_components(c.times(self.flexible, right), self.free)
        x = c.cholesky_solve(c.cholesky(c.free_block(self.stiffness, self.free)), right)
        unstable = jnp.any(jnp.isnan(x[-1]), axis=(0, 1, 2))
        negative = jnp.where(unstable, UNSTABLE_SECTION, 0).astype(jnp.int32)
        return c.spread(x, self.free), Definiteness(negative, jnp.zeros_like(unstable))

    def _by_steps(self, coupled: Coupled, b: Array) -> tuple[Vector, Definiteness]:
        """The solution where sections only turn what acts on others."""
        H = c.symmetric(self.stiffness)

        def one(b: Array) -> tuple[Array, Definiteness]:
            nodes = step_nodes(H, b, coupled, self.grid, self.flexible)
            strain, negative, stable, asymmetry = solved_by_steps(nodes, self.grid, self.free)
            found = turned(transpose(coupled.rotation), strain)
            return found, definiteness(negative, asymmetry, self.grid, stable)

        if b.shape[1] == 1:
            found, definite = one(b[:, 0])
            return self._free_part(found[:, None]), definite
        found, definite = jax.vmap(one, 1, (1, 0))(b)
        return self._free_part(once(found)), jax.tree.map(lambda x: x[0], definite)

    def _hinges(self, coupled: Coupled, b: Array, push: Array | None, unknowns: int) -> Hinge:
        H, linear = c.symmetric(self.stiffness), max(self.free) > 2
        return hinges_of(H, b, coupled, self.grid, self.flexible, push, unknowns, linear=linear)

    def _spans(self, coupled: Coupled, like: Array) -> SpanStiffness | None:
        """The stiffness across spans about the hinges, for arrays `like` the right sides."""
        if coupled.spans is None:
            return None
        shape = like.shape[2:]
        reach = 0.5 * whole(self.grid.weight, shape) * whole(coupled.axis, shape)
        start, end = (jnp.broadcast_to(x, (*x.shape[:2], *shape[1:])) for x in coupled.spans[:2])
        opens = jnp.broadcast_to(coupled.spans.opens, shape[1:])
        return Spans(start, end, opens).stiffness(reach[:, 0])

    def _sides(self, right: Vector, push: Array | None) -> tuple[Array, Array | None]:
        """Right sides as arrays (6, sides, stages, steps, *arms)."""
        coupled = self.coupled
        shapes = [x.shape[2:] for x in (*self.stiffness[0], self.grid.weight)]
        shapes += [] if coupled is None else [coupled.axis.shape[3:]]
        arms = jnp.broadcast_shapes(*shapes, *(x.shape[3:] for x in right))
        size = (len(right[0]), *self.grid.X.shape[:2], *arms)
        b = jnp.stack([jnp.broadcast_to(x, size) for x in right])
        return b, None if push is None else jnp.broadcast_to(push.swapaxes(0, 1), b.shape)

    @staticmethod
    def _turned(R: Array, vectors: Array) -> Array:
        """Moments and forces, or turns and shifts, (3 or 6, sides, ...) in other axes."""
        parts = jnp.split(vectors, len(vectors) // 3)
        return jnp.concatenate([matmul(R, part) for part in parts])

    def _free_part(self, x: Array) -> Vector:
        """Six components, zero for locked strains: turning a strain into the world's axes and back
        leaves rounding in these."""
        return c.spread(c.free_components(components(x), self.free), self.free)
