"""The matrix of a chain: its solution and the signs of its eigenvalues against the dense matrix, of
random chains of every kind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vsr_jax.chain import Border, Chain, Coupled, Spans, bordered_solve
from vsr_jax.numerics.component import cholesky
from vsr_jax.numerics.quadrature import beyond, make_grid

STAGES, STEPS = 2, 3
EVERY, BENDING, PLANE, STRETCH = (0, 1, 2, 3, 4, 5), (0, 1, 2), (1, 3), (3,)
KINDS = {
    "dead forces": {},
    "dead forces, bending only": {"free": BENDING},
    "dead forces, in a plane": {"free": PLANE},
    "dead forces and a rigid piece": {"rigid": True},
    "loads that turn": {"motion": 3},
    "springs along the arm": {"motion": 6},
    "springs, bending only": {"motion": 6, "free": BENDING},
    "springs in the cells": {"motion": 6, "cells": True},
    "springs in the cells and a rigid piece": {"motion": 6, "cells": True, "rigid": True},
    "springs across spans": {"spans": True},
    "springs across spans, bending only": {"spans": True, "free": BENDING},
    "springs across spans, in the cells and a rigid piece": {
        "spans": True,
        "motion": 6,
        "cells": True,
        "rigid": True,
    },
    "nothing is coupled": {"coupled": False},
    "stretch alone": {"free": STRETCH},
}


def by_motion(kind):
    """Whether what acts on the chain depends on positions."""
    return kind.get("motion") == 6 or kind.get("spans", False)


WITH_POTENTIAL = [
    (name, pressed)
    for name in KINDS
    for pressed in (0.3, 2.0, 6.0)
    if by_motion(KINDS[name]) or (KINDS[name].get("motion") is None and pressed < 6.0)
    if name != "nothing is coupled"
]
"""Those whose matrix is symmetric, but for errors of the quadrature, and forces that press them.
Under dead forces the pivots are those of an arm of which no single step buckles."""


def by_cells(forces, axis, weight):
    """Wrenches at the nodes, and their density, by forces on the links behind them."""
    wrench, after, link = np.zeros((6, *weight.shape)), np.zeros(6), np.zeros(3)
    for step in reversed(range(weight.shape[1])):
        for stage in reversed(range(weight.shape[0])):
            force, reach = forces[:, stage, step], 0.5 * weight[stage, step] * axis[:, stage, step]
            moment = after[:3] + np.cross(reach + link, after[3:]) + np.cross(reach, force)
            after, link = np.concatenate([moment, after[3:] + force]), reach
            wrench[:, stage, step] = after
    return wrench, np.zeros_like(wrench)


def by_steps(forces, axis, grid):
    """Wrenches at the nodes, and their density, by the forces beyond each."""
    moving = np.cross(axis, forces, axis=0)
    wrench = np.concatenate([beyond(jnp.asarray(moving), grid), forces])
    return wrench, np.concatenate([moving, np.zeros_like(moving)])


def chain(
    seed, *, free=EVERY, coupled=True, motion=0, cells=False, rigid=False, spans=False, pressed=1.0
):
    """A chain of random sections under random dead forces of a size `pressed`, and springs where
    motions have the size 6: all of a potential, but for loads that turn."""
    rng = np.random.default_rng(seed)
    grid = make_grid(jnp.array([0.0, 0.5, 1.0]), STEPS, STAGES)
    shape = grid.X.shape
    factor = rng.standard_normal((*shape, 6, 6))
    H = np.moveaxis(factor @ factor.swapaxes(-1, -2) / 6 + np.eye(6), (2, 3), (0, 1))
    lower = tuple(tuple(jnp.asarray(H[i, j]) for j in range(i + 1)) for i in range(6))
    flexible = jnp.asarray(np.arange(grid.h.size) != 1, float) * jnp.ones(shape) if rigid else None
    if not coupled:
        return Chain(lower, free, flexible, None, grid)
    rotation = np.linalg.qr(rng.standard_normal((*shape, 3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))[..., None, None]
    rotation = np.moveaxis(rotation, (2, 3), (0, 1))
    axis = np.eye(3)[0].reshape(3, 1, 1) + 0.2 * rng.standard_normal((3, *shape))
    forces = pressed * rng.standard_normal((3, *shape))
    if motion == 6 or spans:
        wrenches = by_cells(forces, axis, np.broadcast_to(grid.weight, shape))
    else:
        wrenches = by_steps(forces, axis, grid)

    def springs(*shape, size=motion):
        a = 0.3 * rng.standard_normal((6, size, *shape))
        return jnp.asarray(a + a.swapaxes(0, 1) if size == 6 else a)

    return Chain(
        lower,
        free,
        flexible,
        Coupled(
            *(jnp.asarray(x) for x in (rotation, axis, *wrenches)),
            springs(*shape) if motion else None,
            springs(shape[1]) if motion else None,
            springs(*shape) if cells else None,
            jnp.asarray(rng.uniform(size=shape)) if cells else None,
            across(rng, shape[1]) if spans else None,
        ),
        grid,
    )


def across(rng, steps):
    """Four springs across each of two spans: the first of one step, the second of the others."""
    a, b = rng.standard_normal((2, 6, 4, 2))
    of_step = np.minimum(np.arange(steps), 1)
    return Spans(
        *(jnp.asarray(x) for x in (a[..., of_step], b[..., of_step], 1.0 * (np.arange(steps) < 2)))
    )


def sides(of, count=2, seed=1):
    rng = np.random.default_rng(seed)
    shape = (count, *of.grid.X.shape[:2])
    return tuple(jnp.asarray(rng.standard_normal(shape)) for _ in range(6))


def rows(of, vectors):
    """Vectors (sides, stages, steps) as the rows of the dense matrix have them."""
    shape = of.grid.X.shape
    bends = np.ones(shape, bool) if of.flexible is None else np.asarray(of.flexible) > 0
    return np.concatenate([np.asarray(vectors[i])[:, bends] for i in of.free], axis=1)


def weights(of):
    """Weight of the node of each row."""
    weight = np.broadcast_to(of.grid.weight, of.grid.X.shape)[None]
    return rows(of, (weight,) * 6)[0]


def stacked(trees):
    """Chains, or right sides, side by side."""
    return jax.tree.map(
        lambda *x: jnp.stack(x, -1) if isinstance(x[0], jax.Array) else x[0], *trees
    )


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("name", KINDS)
def test_the_solution_is_that_of_the_dense_matrix(name, apart):
    of = chain(0, **KINDS[name])
    b = sides(of)
    found, _ = jax.jit(lambda b: of.solve(b, apart=apart))(b)
    expected = np.linalg.solve(np.asarray(of.to_dense()), rows(of, b).T).T
    np.testing.assert_allclose(rows(of, found), expected, atol=1e-11 * np.abs(expected).max())
    for i, x in enumerate(found):
        if i not in of.free:
            assert np.all(x == 0)


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize(("name", "pressed"), WITH_POTENTIAL)
def test_the_pivots_count_the_negative_eigenvalues(name, apart, pressed):
    of = chain(2, **KINDS[name], pressed=pressed)
    dense = weights(of)[:, None] * np.asarray(of.to_dense())
    if by_motion(KINDS[name]):  # each row with the weight of its node
        np.testing.assert_allclose(dense, dense.T, atol=1e-13 * np.abs(dense).max())
    _, definiteness = of.solve(sides(of), apart=apart)
    values = np.linalg.eigvals(dense)
    assert int(definiteness.negative) == np.sum((values.real < 0) & (values.imag == 0))


@pytest.mark.parametrize("name", KINDS)
def test_the_product_with_the_solution_is_the_right_side(name):
    """Of chains side by side, whose nodes are steps of their own."""
    each = [chain(seed, **KINDS[name]) for seed in (3, 4, 5)]
    both, b = stacked(each), stacked([sides(one) for one in each])
    found, _ = both.solve(b)
    for i, (x, y) in enumerate(zip(both.product(found), b, strict=True)):
        if i in both.free:
            y = y if both.flexible is None else both.flexible * y
            np.testing.assert_allclose(x, y, atol=1e-11)


def test_chains_side_by_side_are_those_alone():
    """Where one is solved by the same cells."""
    each = [chain(seed, **KINDS["springs in the cells"]) for seed in (3, 4, 5)]
    found, definiteness = stacked(each).solve(stacked([sides(one) for one in each]))
    for i, one in enumerate(each):
        expected, alone = one.solve(sides(one))
        for x, y in zip(found, expected, strict=True):
            np.testing.assert_allclose(x[..., i], y, atol=1e-11)
        assert definiteness.negative[i] == alone.negative


def test_a_push_in_the_cells_is_a_right_side():
    """The solution does not change if the push by a spring in a cell is given in place of the
    spring."""
    held = chain(6, motion=6, cells=True)
    loose = held._replace(coupled=held.coupled._replace(cells=jnp.zeros_like(held.coupled.cells)))
    b = sides(held, 1)
    strain, _ = held.solve(b)
    motions = held.motions(tuple(x[0] for x in strain))
    push = jnp.einsum("abij,bij->aij", held.coupled.cells, motions)
    again, _ = loose.solve(b, push[None])
    for x, y in zip(strain, again, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-12)


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("name", ["springs in the cells", "springs, bending only"])
def test_a_nearly_rigid_spring_in_any_direction(name, apart):
    """As a contact that is closed: with it the chain moves as if it were held there."""
    of, b, stiffness = chain(6, **KINDS[name], pressed=0.3), sides(chain(6)), 1e10
    place, normal = (1, 1), np.array([0.48, 0.64, -0.6])
    pull = np.concatenate([np.zeros(3), normal])
    cells = np.zeros((6, 6, *of.grid.X.shape))
    cells[:, :, *place] = -stiffness * np.outer(pull, pull)
    coupled = of.coupled._replace(cells=jnp.asarray(cells), part=jnp.full(of.grid.X.shape, 0.4))
    without = of._replace(coupled=coupled._replace(cells=jnp.zeros_like(coupled.cells)))
    push = np.zeros((3, 6, *of.grid.X.shape))
    push[2, :, *place] = pull
    pushed = tuple(jnp.concatenate([x, jnp.zeros((1, *x.shape[1:]))]) for x in b)
    free, _ = without.solve(pushed, jnp.asarray(push), apart=apart)
    moved = [
        pull @ np.asarray(without.motions(tuple(x[i] for x in free)))[:, *place] for i in range(3)
    ]
    found, definiteness = of._replace(coupled=coupled).solve(b, apart=apart)
    for x, y in zip(found, free, strict=True):
        for i in range(2):
            expected = y[i] - moved[i] / moved[2] * y[2]
            np.testing.assert_allclose(x[i], expected, atol=1e-5 * np.abs(y).max())
    assert int(definiteness.negative) == 0


def test_stiffness_across_spans():
    """The dense matrix with springs across spans is that without them and the product of what
    stretches the springs."""
    of = chain(7, spans=True)
    bare = of._replace(
        coupled=of.coupled._replace(
            spans=of.coupled.spans._replace(
                start=0 * of.coupled.spans.start, end=0 * of.coupled.spans.end
            )
        )
    )
    w = weights(of)
    more = w[:, None] * (np.asarray(of.to_dense()) - np.asarray(bare.to_dense()))
    np.testing.assert_allclose(more, more.T, atol=1e-13 * np.abs(more).max())
    values = np.linalg.eigvalsh(more)
    assert np.sum(values > 1e-10 * values[-1]) == 8
    assert values[0] > -1e-12 * values[-1]


def test_a_border():
    of = chain(9)
    columns, b, right = sides(of, seed=10), sides(of, 1), jnp.array([0.3, -0.2])
    border = Border(columns, columns, -jnp.ones(2), jnp.array([0.5, 0.0]), jnp.ones(2, int))
    found, answers = of.solve(b)[0], of.solve(columns)[0]
    strain, x, _ = bordered_solve(tuple(x[0] for x in found), answers, right, border, of.grid)
    w = rows(of, columns)
    whole = np.block([[np.asarray(of.to_dense()), w.T], [-w * weights(of), np.diag([0.5, 0.0])]])
    expected = np.linalg.solve(whole, np.concatenate([rows(of, b)[0], right]))
    got = np.concatenate([rows(of, tuple(s[None] for s in strain))[0], x])
    np.testing.assert_allclose(got, expected, atol=1e-11 * np.abs(expected).max())


def test_a_section_that_is_unstable_by_itself_is_reported():
    of = chain(11, coupled=False)
    less = (0.0, 0.0, 20.0, 0.0, 0.0, 0.0)
    bad = tuple((*row[:-1], row[-1] - x) for row, x in zip(of.stiffness, less, strict=True))
    assert np.any(np.isnan(cholesky(bad)[-1]))
    _, definiteness = of._replace(stiffness=bad).solve(sides(of))
    assert int(definiteness.negative) > 1000
