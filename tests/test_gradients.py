"""Forward mode = reverse mode = differences of the solve, whatever a scene has; and batches over
every number of a scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import central_differences
from jax.flatten_util import ravel_pytree

import vsr_jax as vsr

STEPS = vsr.StrainDependent(8)
PATHS = vsr.Parallel(0.007, 0.0), vsr.Helix(0.007, pitch=0.4, phase=2.0)
TENSIONS, CHANGES = jnp.array([3.0, 1.5]), jnp.array([-0.010, -0.005])
JET = vsr.PointWrench(0.15, force=(0.0, 0.05, 0.0), frame="body")


def arm(young=1e6):
    return vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(young, poisson=0.45, density=1000.0))


def rubbing(loads=(), young=1e6, **options):
    return vsr.Scene(
        arm(young), [vsr.Tendon(path, friction=0.2, **options) for path in PATHS], loads
    )


def slopes(function, at, step=5e-3):
    """Fourth-order differences by numbers of any size, each with a step that is a share of it."""
    h = step * np.asarray(at)
    return central_differences(
        lambda unit: np.asarray(function(at + h * unit)), at.size
    ) / h.reshape(-1, *(1,) * jnp.ndim(function(at)))


@pytest.fixture(scope="module")
def deflection():
    """Deflection of an arm under friction, by its modulus and the tensions, and its gradient in
    reverse mode."""

    def tip(young, tensions):
        return (
            jnp.array([0.3, 1.0, -0.7])
            @ vsr.solve(rubbing(young=young), tensions, model=STEPS).tip[:3, 3]
        )

    return jax.value_and_grad(tip, (0, 1))


@pytest.mark.slow
def test_reverse_mode_under_friction_is_the_difference(deflection):
    """A solution of the transposed tangent system that is judged by its residual alone was off by
    2e-4 here."""
    both, at = jax.jit(deflection), jnp.array([1e6, *TENSIONS])
    reverse = jnp.hstack(both(at[0], at[1:])[1]) * at
    differences = slopes(lambda x: both(x[0], x[1:])[0], at) * at
    np.testing.assert_allclose(
        reverse, differences, rtol=0, atol=1e-8 * np.linalg.norm(differences)
    )


@pytest.mark.slow
def test_modulus_batched_alone_under_friction(deflection):
    """`jax.vmap` over one number of the scene; the shape depends on the tensions by the modulus
    alone."""
    moduli = jnp.array([7e5, 1e6, 2e6])
    values, (by_young, by_tensions) = jax.jit(jax.vmap(deflection, (0, None)))(moduli, TENSIONS)
    np.testing.assert_allclose(moduli * by_young, -by_tensions @ TENSIONS, rtol=1e-9)
    assert values[0] > values[1] > values[2] or values[0] < values[1] < values[2]


@pytest.mark.slow
def test_locked_strains_that_single_precision_cannot_hold():
    """A tendon at the distance d that takes in c bends an inextensible arm by c / d L; EI of that
    is T d."""
    d, taken_in = 0.007, 0.01
    rod = vsr.Rod(
        0.3,
        vsr.Circular(0.01),
        vsr.Material(1e6, poisson=0.45),
        rest_strain=(0.0, 0.0, 0.0, 1.1, 0.0, 0.0),
    )
    scene = vsr.Scene(
        rod,
        [vsr.Tendon(vsr.Parallel(d, 0.0), control="length")],
        free_strains=("bending_y", "bending_z"),
    )
    eq = vsr.solve(scene, [-taken_in], model=STEPS, throw=True)
    np.testing.assert_allclose(
        -eq.forces[0], 1e6 * np.pi / 4 * 0.01**4 * taken_in / (d**2 * 0.3), rtol=1e-10
    )


CASES = {
    "friction": ([], {}),
    "gravity, length control, friction and a follower force": (
        [vsr.Gravity(), JET],
        {"control": "length"},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_both_modes_are_the_differences(name):
    """All coordinates of the tip by the inputs."""
    loads, options = CASES[name]
    scene, at = rubbing(loads, **options), CHANGES if options else TENSIONS

    def tip(inputs):
        place = vsr.solve(scene, inputs, model=STEPS).tip[:3, 3]
        return place, place

    @jax.jit
    def both(inputs):
        forward, place = jax.jacfwd(tip, has_aux=True)(inputs)
        return place, forward * inputs, jax.jacrev(lambda x: tip(x)[0])(inputs) * inputs

    differences = slopes(lambda x: both(x)[0], at).T * at
    for jacobian in both(at)[1:]:
        np.testing.assert_allclose(
            jacobian, differences, rtol=0, atol=1e-8 * np.linalg.norm(differences)
        )


def full():
    """A scene with everything and its inputs; two wrenches at one place would be no smooth case:
    their kinks add up once apart."""
    rod = vsr.Rod(
        0.3,
        vsr.Circular(vsr.Taper(0.011, 0.009)),
        vsr.Material(1e6, poisson=0.45, density=1000.0),
        rest_strain=(0.2, 0.5, -0.4, 1.0, 0.0, 0.0),
        base=vsr.se3.exp(jnp.array([0.1, 0.2, 0.3, 0.02, -0.01, 0.1])),
    )
    threads = [
        vsr.Tendon(PATHS[0], control="length", stiffness=2e3, friction=0.2),
        vsr.Tendon(PATHS[1], end=0.2, friction=0.3, motion="release"),
        vsr.Chamber(vsr.Linear(0.0, -0.004, 0.003, 0.002), area=2e-5),
    ]
    loads = [
        vsr.Gravity((0.3, 1.0, -9.7), fluid_density=300.0),
        vsr.PointWrench(0.1, force=(0.02, 0.05, -0.03), moment=(1e-3, 2e-3, 0.0)),
        JET,
    ]
    return vsr.Scene(rod, threads, loads), jnp.array([-0.010, 2.0, 2e4])


def mixture(scene, inputs):
    """A number that depends on all of them."""
    eq = vsr.solve(scene, inputs, model=STEPS)
    return eq.tip[2, 3] + 0.5 * eq.tip[0, 3] + 0.1 * eq.tip[0, 1] + 0.01 * eq.forces[0]


@pytest.fixture(scope="module")
def everything():
    """All numbers of the full scene in a row, a direction, and what gives the value, the gradient
    and the derivative along it."""
    numbers, rebuild = ravel_pytree(full())
    way = np.random.default_rng(3).normal(size=numbers.size) * np.where(
        numbers == 0, 1e-2, np.abs(numbers)
    )

    def derivatives(x, v):
        gradient = jax.grad(lambda x: mixture(*rebuild(x)))(x)
        value, forward = jax.jvp(lambda x: mixture(*rebuild(x)), (x,), (v,))
        return value, gradient, forward

    return numbers, jnp.asarray(way), derivatives, jax.jit(derivatives)


@pytest.mark.slow
def test_the_modes_agree_on_everything(everything):
    numbers, way, _, single = everything
    _, gradient, forward = single(numbers, way)
    np.testing.assert_allclose(gradient @ way, forward, rtol=1e-12)
    differences = slopes(lambda t: single(numbers + (t - 1) * way, way)[0], jnp.ones(1), 1e-3)
    np.testing.assert_allclose(differences[0], forward, rtol=1e-8)


@pytest.mark.slow
def test_every_number_batched_at_once_is_the_loop(everything):
    numbers, way, derivatives, single = everything
    batch = numbers + jnp.array([[-0.03], [0.0], [0.02]]) * way
    together = jax.jit(jax.vmap(derivatives, (0, None)))(batch, way)
    for i, x in enumerate(batch):
        for found, alone in zip(together, single(x, way), strict=True):
            np.testing.assert_allclose(
                found[i], alone, rtol=1e-9, atol=1e-12 * np.max(np.abs(alone))
            )


@pytest.mark.slow
@pytest.mark.parametrize("bit", range(6))
def test_every_number_may_be_batched_without_any_other(bit):
    """By tracing, half of the scene's leaves batched: those whose place has a bit, or has it not.
    Any two leaves differ in a bit, so that each is batched once while the other is not."""
    leaves, tree = jax.tree.flatten(full())
    assert len(leaves) <= 2**6

    def value(leaves):
        return mixture(*jax.tree.unflatten(tree, leaves))

    for wanted, function in ((1, jax.value_and_grad(value)), (0, value)):
        batched = [i >> bit & 1 == wanted for i in range(len(leaves))]
        axes = [0 if along else None for along in batched]
        stacked = [jnp.stack([x, x]) if b else x for x, b in zip(leaves, batched, strict=True)]
        shapes = jax.tree.leaves(jax.eval_shape(jax.vmap(function, (axes,)), stacked))
        assert {shape.shape[0] for shape in shapes} == {2}


@pytest.mark.slow
def test_a_design_of_a_modulus_under_friction_runs():
    scene, inputs = rubbing(), TENSIONS[None]
    wanted = vsr.solve(rubbing(young=8e5), TENSIONS, model=STEPS).tip[:3, 3]
    objective = vsr.objective.TipError(wanted[None])
    found = vsr.design(
        scene,
        {"rod.material.young": (5e5, 2e6)},
        objective,
        inputs,
        model=STEPS,
        search=vsr.Search(starts=2, candidates=2, steps=3),
        progress=False,
    )
    assert 5e5 < float(found.scene.rod.material.young.value) < 1e6


def test_what_the_search_takes_for_wrong():
    """Of the sine at 1, computed with noise: a difference too rough to tell is no agreement, and a
    derivative off by 1e-6 is wrong."""
    from benchmarks.gradient_check import Found, difference, verdict

    steps, exact, random = 0.02 * 0.5 ** np.arange(11), np.cos(1.0), np.random.default_rng(0)
    odd = np.sin(1 + steps) - np.sin(1 - steps)
    for noise, words in ((0.0, "agrees"), (1e-13, "agrees"), (1e-6, "difference too rough")):
        found = difference(odd + noise * random.normal(size=steps.size), steps)
        assert abs(found[0] - exact) <= found[1]
        assert verdict(Found(0, exact, exact, *found)) == words
    found = difference(odd, steps)
    assert (
        verdict(Found(0, exact * (1 + 1e-6), exact * (1 + 1e-6), *found))
        == "wrong: not the difference"
    )
    assert verdict(Found(0, exact, exact * (1 + 1e-6), *found)) == "wrong: the modes differ"
    assert verdict(Found(0, exact, np.nan, *found)) == "NaN in one mode"
    assert verdict(Found(6, 0.0, 1.0, *found)).startswith("wrong")
    assert (
        verdict(Found(0, exact, exact, *difference(np.full(steps.size, np.nan), steps)))
        == "at a switch"
    )


@pytest.mark.slow
def test_a_dozen_drawn_scenes_have_the_right_gradient_or_none():
    from benchmarks.gradient_check import verdict
    from benchmarks.gradient_search import search, structures

    chosen = [
        made
        for made in structures(12)
        if len(made.effects) in (4, 5) and (made.pull or made.release)
    ][:2]
    said = [verdict(found) for made in chosen for found in search(made, 6)]
    assert not [words for words in said if words.startswith("wrong")], said
    assert said.count("agrees") >= 8, said
