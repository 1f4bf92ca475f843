"""The eliminated tangent against the exact derivative of the residual."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.elements.problem import problem_of
from vsr_jax.mechanics.arm_balance import (
    ArmImbalance,
    ArmUnknown,
    imbalance_of,
    state_of,
)
from vsr_jax.mechanics.arm_tangent import approximate_solve

LENGTH = 0.4
ROD = vsr.Rod(LENGTH, vsr.Circular(0.01), vsr.Material(6e5, poisson=0.45, density=500.0))
TENDON = vsr.Tendon(vsr.Helix(0.006, pitch=0.5))
LOADS = {
    "gravity": [vsr.Gravity()],
    "dead wrench": [vsr.Gravity(), vsr.TipWrench((0.02, 0.01, 0.03), (2e-4, 4e-4, 0.0))],
    "follower tip": [vsr.Gravity(), vsr.TipWrench((0.02, 0.01, 0.03), frame="body")],
    "follower inside": [vsr.PointWrench(0.4 * LENGTH, (0.02, 0.01, 0.03), frame="body")],
    "follower density": [vsr.DistributedWrench((0.02, 0.08, 0.04), frame="body"), vsr.Gravity()],
}


BY_POSITION = {
    "spring": [vsr.Gravity(), vsr.Spring((0.2, 0.1, 0.3), 0.5, 0.3)],
    "spinning": [vsr.Spinning((0.0, 0.0, 8.0)), vsr.TipWrench((0.02, 0.01, 0.03), frame="body")],
}


def error(loads, order, steps=16):
    """Relative error of a smooth change of strain that is found again from the exact change of the
    residual along it."""
    scene, model = vsr.Scene(ROD, [TENDON], loads), vsr.StrainDependent(steps, order)
    free, problem = scene.free, problem_of(scene, jnp.array([5.0]), model.grid(scene))
    x, rng = problem.grid.X / LENGTH, np.random.default_rng(0)
    sizes = np.array([2.0, 4.0, 4.0, 0.01, 0.01, 0.01])
    change = tuple(
        size * jnp.sin(2 * x + phase)
        for size, phase in zip(sizes, rng.uniform(0, 6, 6), strict=True)
    )
    xi = tuple(
        rest + size * jnp.sin(3 * x + phase)
        for rest, size, phase in zip(
            problem.sections.rest, sizes, rng.uniform(0, 6, 6), strict=True
        )
    )

    @jax.jit
    def change_found(problem, xi, change):
        def wrench(xi):
            return imbalance_of(ArmUnknown(xi, ()), state_of(xi, (), problem), problem, free).wrench

        _, right = jax.jvp(wrench, (xi,), (change,))
        at, right = state_of(xi, (), problem), ArmImbalance(right, ())
        return approximate_solve(ArmUnknown(xi, ()), at, right, problem, free)[0]

    found = change_found(problem, xi, change)
    off, size = (
        sum(jnp.sum(y**2) for y in part)
        for part in (
            [a - b for a, b in zip(found.xi[:3], change[:3], strict=True)],
            change[:3],
        )
    )
    return float(jnp.sqrt(off / size))


@pytest.mark.slow
@pytest.mark.parametrize("name", LOADS)
@pytest.mark.parametrize(
    ("order", "bound"),
    [pytest.param(2, 1e-2, marks=pytest.mark.slow), (4, 3e-4), (6, 3e-5)],
)
def test_it_is_that_of_the_collocation(name, order, bound):
    """Cells by the midpoint rule, one per node, were off by a few percent at orders 4 and 6."""
    assert error(LOADS[name], order) < bound


@pytest.mark.slow
@pytest.mark.parametrize("name", BY_POSITION)
@pytest.mark.parametrize(
    ("order", "ratio"), [(2, 0.27), pytest.param(4, 0.52, marks=pytest.mark.slow)]
)
def test_by_positions_it_converges_with_the_cells(name, order, ratio):
    """Each node is a cell of its own then, which only at order 2 has the node in its middle."""
    coarse, fine = (error(BY_POSITION[name], order, steps) for steps in (16, 32))
    assert coarse < 1.5e-2
    assert fine < ratio * coarse


@pytest.mark.slow
def test_a_small_change_of_a_heavy_arm_takes_few_steps():
    scene = vsr.Scene(ROD, [TENDON], LOADS["gravity"])
    model = vsr.StrainDependent(16)
    near = vsr.solve(scene, [5.0], model=model)
    warm, cold = (vsr.solve(scene, [5.05], model=model, start=start) for start in (near, None))
    assert bool(warm.converged)
    assert int(warm.steps) <= 4
    np.testing.assert_allclose(warm.tip, cold.tip, atol=1e-11)


@pytest.mark.slow
def test_a_batch_in_parts_is_the_same_as_each_arm_alone():
    """300 arms are solved in three parts, the last one filled up."""
    scene, model = vsr.Scene(ROD, [TENDON], LOADS["gravity"]), vsr.StrainDependent(4)

    @jax.jit
    def tip(tension):
        return vsr.solve(scene, tension[None], model=model).tip

    tensions = jnp.linspace(0.0, 6.0, 300)
    batch = jax.jit(jax.vmap(tip))(tensions)
    for i in (0, 99, 100, 199, 200, 299):
        np.testing.assert_allclose(batch[i], tip(tensions[i]), atol=1e-10)


@pytest.mark.slow
def test_locked_strains_stay_at_rest():
    """Newton's method works in single precision: rounding that its steps leave in a locked strain
    would become an error of the shape, which no residual shows."""
    rest = (0.8, 1.0, -0.5, 1.0, 0.0, 0.0)
    rod = vsr.Rod(
        LENGTH,
        vsr.Circular(0.01),
        vsr.Material(1e6, poisson=0.45, density=1000.0),
        rest_strain=rest,
    )
    scene = vsr.Scene(rod, [TENDON], LOADS["dead wrench"], free_strains=("torsion", "bending_y"))
    model = vsr.StrainDependent(8)

    def tip(inputs):
        return vsr.solve(scene, inputs, model=model).tip[:3, 3]

    at, h = jnp.array([2.0]), 1e-4
    _, slope = jax.jvp(tip, (at,), (jnp.ones(1),))
    np.testing.assert_allclose(slope, (tip(at + h) - tip(at - h)) / (2 * h), rtol=1e-6, atol=1e-9)


ACROSS = vsr.Cylinder(0.02, pose=vsr.pose((0.2, 0.0, -0.03), pointing=(0.0, 1.0, 0.0)))
BY_STEPS = {
    "spring": {"loads": BY_POSITION["spring"]},
    "spinning": {"loads": BY_POSITION["spinning"]},
    "bending only": {
        "loads": BY_POSITION["spring"],
        "free_strains": ("torsion", "bending_y", "bending_z"),
    },
    "in the plane": {"loads": BY_POSITION["spring"], "free_strains": ("bending_y", "elongation")},
    "contact": {"loads": [vsr.Gravity()], "obstacles": ACROSS},
    "held": {"loads": BY_POSITION["spring"], "held": vsr.Held(0.3, position=(0.2, 0.1, 0.0))},
    "rigid": {"loads": BY_POSITION["spring"], "rigid": [vsr.RigidPiece(0.1, 0.25)]},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BY_STEPS)
def test_one_arm_step_by_step_is_a_batch_node_by_node(name):
    """The same solution and the same verdict of definiteness, for states of all kinds."""
    scene, model = dict(BY_STEPS[name]), vsr.StrainDependent(8)
    rod = vsr.Rod(LENGTH, ROD.section, ROD.material, rigid=scene.pop("rigid", ()))
    scene = vsr.Scene(rod, [TENDON], **scene)
    free, problem = scene.free, problem_of(scene, jnp.array([5.0]), model.grid(scene))
    coupled = tuple(one.guess(problem.forces, problem.grid) for one in problem.couplings)
    rng = np.random.default_rng(0)

    def smooth(sizes):
        x = problem.grid.X / LENGTH
        return [size * np.sin(3 * x + rng.uniform(0, 6)) for size in sizes]

    @jax.jit
    def solved(unknown, problem, wrench):
        at = state_of(unknown.xi, unknown.coupled, problem)
        right = imbalance_of(unknown, at, problem, free)._replace(wrench=wrench)
        return approximate_solve(unknown, at, right, problem, free)

    def flat(step):
        return np.concatenate([np.ravel(x) for x in jax.tree.leaves(step)])

    verdicts = set()
    for bend in (1.0, 3.0, 8.0, 20.0, 40.0):
        change = smooth([bend] * 3 + [0.01] * 3)
        xi = tuple(r + x for r, x in zip(problem.sections.rest, change, strict=True))
        unknown = ArmUnknown(xi, coupled)
        wrench = tuple(jnp.asarray(x) for x in smooth([1e-3] * len(free)))
        step, definite, _ = solved(unknown, problem, wrench)
        given = jax.tree.map(lambda x: x[..., None], (unknown, problem, wrench))
        others, same, _ = solved(*given)
        one, other = flat(step), flat(others)
        # in single precision, but for contacts, whose stiffness takes half of the digits
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-4 * np.max(np.abs(other)))
        assert bool(definite) == bool(same[0])
        verdicts.add(bool(definite))
    assert True in verdicts
    assert (False in verdicts) == (name not in ("in the plane", "held"))
