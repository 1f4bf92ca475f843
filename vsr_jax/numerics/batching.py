"""Batches of arms in the last axis of a solver's arrays, so that passes along the arm use
contiguous rows."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array

from ..typing import Shape, Size
from .compiling import on_cpu
from .component import select
from .loops import alike, while_loop

TOGETHER = 136
"""Arms that are solved together on a CPU, at most: the arrays of one pass then stay in the
cache."""

_ELSEWHERE = 128
"""Other devices solve so many times as many arms together: they take as long for thousands as for a
hundred. The arrays of arms without loads, with loads or in contact then take about one GiB."""

_ALIASED = 64
"""Numbers of arms that are multiples of this are raised by eight: their rows would all map to the
same few cache lines."""


def side_by_side(solve: Callable, together: int = TOGETHER) -> Callable:
    """`solve` with a rule for `jax.vmap` that puts the batch into the last axis of every array.

    With the batch in the first axis, every array is transposed before and after each pass along the
    arm, which took most of the time. A large batch is cut into equal parts, one solved after
    another. Copies of the last arm fill the last part: eight of them cost less than rows whose
    length is a power of two.

    **Arguments:** `solve`: takes pytrees of arrays and returns one. For a batch each array has one
    more axis at its end, of size 1 where it is the same for all arms. `together`: size of a part
    on a CPU, at most (see `at_once`).
    """

    @custom_vmap
    def batched_solve(*arguments: Any) -> Any:
        return solve(*arguments)

    @batched_solve.def_vmap
    def _(size: Size, batched: list, *arguments: Any) -> tuple[Any, Any]:
        rows = lanes(size, together)

        def solved(arguments: tuple) -> Any:
            every = jax.tree.map(
                lambda x, own: jnp.moveaxis(x, 0, -1) if own else x[..., None],
                arguments,
                tuple(batched),
            )
            result = solve(*every)
            return jax.tree.map(
                lambda x: jnp.moveaxis(jnp.broadcast_to(x, (*x.shape[:-1], rows)), -1, 0), result
            )

        return _by_parts(solved, arguments, batched, size, rows)

    return batched_solve


def lanes(size: Size, together: int) -> Size:
    """Number of arms side by side, each in one place of the last axis: equal parts of a batch, of
    at most `together` on a CPU (see `at_once`)."""
    rows = _rows(size, together)
    return rows + 8 if known(size) and rows % _ALIASED == 0 else rows


def at_once(on_a_cpu: int) -> int:
    """Number of arms that are solved together, at most, on the device in use, from that on a
    CPU."""
    return on_a_cpu if on_cpu() else _ELSEWHERE * on_a_cpu


def in_parts(solve: Callable, together: int) -> Callable:
    """`solve` with a rule for `jax.vmap` that cuts a batch of more than `together` arms (see
    `at_once`) into equal parts, one solved after another, so that the arrays of a part stay in the
    cache."""

    @custom_vmap
    def batched_solve(*arguments: Any) -> Any:
        return solve(*arguments)

    @batched_solve.def_vmap
    def _(size: Size, batched: list, *arguments: Any) -> tuple[Any, Any]:
        axes = jax.tree.map(lambda own: 0 if own else None, tuple(batched))
        solved = jax.vmap(solve, axes)
        if not known(size) or size <= at_once(together):
            return (result := solved(*arguments)), jax.tree.map(lambda _: True, result)
        rows = _rows(size, together)
        return _by_parts(lambda part: solved(*part), arguments, batched, size, rows)

    return batched_solve


def known(size: Size) -> bool:
    """Whether a size is a number. In `jax.export` it may be a symbol, which cannot be compared with
    numbers: such a batch is solved together, whatever its size."""
    return isinstance(size, int)


def _rows(size: Size, together: int) -> Size:
    """Size of equal parts of a batch, none larger than `at_once`."""
    if not known(size):
        return size
    parts = -(-size // at_once(together)) or 1
    return -(-size // parts) or 1


def _by_parts(
    solved: Callable, arguments: tuple, batched: list, size: Size, rows: Size
) -> tuple[Any, Any]:
    """Results of a batch whose axis comes first, from those of parts of a number of `rows`, the
    last one filled with copies of the last arguments, and that all of them are batched."""
    if not known(size):
        return (result := solved(arguments)), jax.tree.map(lambda _: True, result)
    parts = -(-size // rows) or 1
    place = jnp.minimum(jnp.arange(parts * rows), max(size - 1, 0))
    leaves, tree = jax.tree.flatten(arguments)
    own = jax.tree.leaves(batched)

    def part(x: Any) -> Any:
        x = x if size else jnp.zeros((1, *x.shape[1:]), x.dtype)
        return x[place].reshape(parts, rows, *x.shape[1:])

    def one(varying: list) -> Any:
        given = iter(varying)
        every = [next(given) if o else x for x, o in zip(leaves, own, strict=True)]
        return solved(jax.tree.unflatten(tree, every))

    result = lax.map(one, [part(x) for x, o in zip(leaves, own, strict=True) if o])
    result = jax.tree.map(lambda x: x.reshape(parts * rows, *x.shape[2:])[:size], result)
    return result, jax.tree.map(lambda _: True, result)


def arms_in(tree: Any, axes: int) -> Shape:
    """Shape of the batch of arms: what the last `axes` axes of all arrays broadcast to."""
    shapes = [np.shape(x) for x in jax.tree.leaves(tree)]
    return jnp.broadcast_shapes(*(shape[len(shape) - axes :] for shape in shapes if shape))


def of_each_arm(function: Callable, arms: Shape, *arguments: Any) -> Any:
    """A function of the numbers of one arm, for a batch of shape `arms` (one axis, or none) in the
    last axis of all arguments, of size 1 where they are the same for all arms."""
    if not arms:
        return function(*arguments)
    every = jax.tree.map(lambda x: jnp.broadcast_to(x, (*np.shape(x)[:-1], *arms)), arguments)
    return jax.vmap(function, -1, -1)(*every)


class Iteration(NamedTuple):
    """An iteration of several problems, with one entry per problem in the last axis of each array:
    the state at its beginning, given any state or None; the step to the next state, which leaves
    problems alone that are done; which of them are not; and what a state means as a result."""

    begin: Callable[[Any], Any]
    advance: Callable[[Any], Any]
    busy: Callable[[Any], Array]
    result: Callable[[Any], Any]


class _Queue(NamedTuple):
    """State of `queued`: that of the problems in the lanes, which ones they are, and their data;
    the first problem that has not begun; and the results of those that are done."""

    state: Any
    place: Array
    data: Any
    waiting: Array
    results: Any


def iterated(iteration: Iteration) -> Any:
    """The results of all problems at the end."""
    end = while_loop(
        lambda state: jnp.any(iteration.busy(state)), iteration.advance, iteration.begin(None)
    )
    return iteration.result(end)


def queued(
    iteration: Callable[[Any], Iteration], data: Any, problems: int, lanes: int, slow: int
) -> Any:
    """As `iterated`, with as many problems at a time as there are `lanes`: where they are done, the
    next ones begin, so that few wait for the slowest.

    **Arguments:** `iteration`: that of the problems with some data; `data`: arrays whose last axis
    is that of all problems, or of size 1; `slow`: the next problems begin once at most so many are
    not done, since each beginning takes the time of a step or so.
    """

    def chosen(place: Array) -> Any:
        return jax.tree.map(lambda x: x if x.shape[-1] == 1 else x[..., place], data)

    def advance(queue: _Queue) -> _Queue:
        current = iteration(queue.data)
        state = current.advance(queue.state)
        begun, busy = queue.place < problems, current.busy(state)
        done = begun & ~busy
        left = jnp.sum(begun & busy)
        refill = left <= jnp.where(queue.waiting < problems, slow, 0)
        queue, _ = alike(queue._replace(state=state), data)  # both branches return one type
        return lax.cond(refill & jnp.any(done), refilled, lambda queue, _: queue, queue, done)

    def refilled(queue: _Queue, done: Array) -> _Queue:
        found = iteration(queue.data).result(queue.state)
        target = jnp.where(done, queue.place, problems)
        results = jax.tree.map(
            lambda every, x: every.at[..., target].set(x, mode="drop"), queue.results, found
        )
        following = queue.waiting + jnp.cumsum(done) - 1
        place = jnp.where(done, jnp.minimum(following, problems), queue.place)
        given = chosen(jnp.minimum(place, problems - 1))
        begins = done & (place < problems)
        state = select(begins, iteration(given).begin(queue.state), queue.state)
        found = _Queue(state, place, given, queue.waiting + jnp.sum(done), results)
        return alike(found, queue)[0]

    given = chosen(jnp.arange(lanes))
    first = iteration(given)
    state = first.begin(None)
    shapes = jax.eval_shape(first.result, state)
    results = jax.tree.map(lambda x: jnp.zeros((*x.shape[:-1], problems), x.dtype), shapes)
    begin = _Queue(state, jnp.arange(lanes), given, jnp.array(lanes), results)
    return while_loop(lambda queue: jnp.any(queue.place < problems), advance, begin).results
