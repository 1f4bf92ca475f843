"""jit, vmap and grad through every result of every model: forward = reverse = finite
differences."""

import json
import os
import subprocess
import sys
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export
from jax.flatten_util import ravel_pytree
from jax.sharding import AxisType, PartitionSpec
from xla_flags import FLAGS

import vsr_jax as vsr
from vsr_jax.studies import paper

MODELS = {
    "strain-dependent": vsr.StrainDependent(24),
    "prescribed": vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(3)), points=12, steps=24),
    "continuum": vsr.Continuum(rtol=1e-10, atol=1e-12, derivative=vsr.StrainDependent(48)),
}


@pytest.fixture(scope="module")
def scene():
    """A hollow cone, bent at rest, on a turned base, with a helical chamber: each number of it is
    differentiated."""
    arm = vsr.Rod(
        0.6,
        vsr.Annular(vsr.Taper(0.012, 0.010), 0.003),
        vsr.Material(6e5, poisson=0.45),
        rest_strain=(0.0, vsr.Taper(0.2, 1.0), 0.5, 1.0, 0.0, 0.0),
        base=vsr.se3.exp(jnp.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.1])),
    )
    return vsr.Scene(arm, [vsr.Chamber(vsr.Helix(0.005, pitch=0.5, phase=0.2), area=2e-5)])


INPUTS = jnp.array([-2e5])


def results(scene, inputs, model):
    """The tip and, for the exact model, the other results; a pose holds the strains up to it."""
    eq = vsr.solve(scene, inputs, model=model)
    if not isinstance(model, vsr.StrainDependent):
        return eq.tip[:3].ravel()
    return jnp.concatenate([eq.tip[:3].ravel(), eq.pose(0.31)[:3].ravel(), eq.lengths, eq.q])


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == "strain-dependent" else pytest.mark.slow)
        for name in MODELS
    ],
)
def test_derivatives_by_every_number_agree(name, scene):
    model = MODELS[name]
    numbers, rebuild = ravel_pytree((scene, INPUTS))

    def flat(x):
        return results(*rebuild(x), model)

    push = jax.jit(lambda x, v: jax.jvp(flat, (x,), (v,)))
    pull = jax.jit(lambda x, w: jax.vjp(flat, x)[1](w)[0])

    def value(x):
        return push(x, jnp.zeros_like(x))[0]

    cotangent = jnp.asarray(np.random.default_rng(0).normal(size=value(numbers).size))
    reverse = pull(numbers, cotangent)
    assert numbers.size > 30
    accuracy = 2e-5 if name == "continuum" else 2e-7
    for i, x in enumerate(np.asarray(numbers)):
        unit = jnp.zeros_like(numbers).at[i].set(1.0)
        forward, h = push(numbers, unit)[1], 1e-4 * abs(x) or 1e-6
        scale = np.abs(forward).max() + 1e-9
        difference = (
            8 * (value(numbers + h * unit) - value(numbers - h * unit))
            - value(numbers + 2 * h * unit)
            + value(numbers - 2 * h * unit)
        ) / (12 * h)
        np.testing.assert_allclose(
            forward / scale, difference / scale, atol=accuracy, err_msg=f"number {i}, value {x}"
        )
        np.testing.assert_allclose(
            reverse[i] / scale,
            jnp.dot(cotangent, forward) / scale,
            atol=1e-9,
            err_msg=f"number {i}, value {x}",
        )


@pytest.mark.slow
def test_second_derivatives(helix):
    model = MODELS["prescribed"]  # those of the balance have a test of their own

    def height(tau):
        return vsr.solve(helix, tau[None], model=model).tip[2, 3]

    at, h = jnp.asarray(-9.0), 1e-2
    values = [float(height(at + i * h)) for i in (-2, -1, 0, 1, 2)]
    second = (-values[0] + 16 * values[1] - 30 * values[2] + 16 * values[3] - values[4]) / (
        12 * h**2
    )
    np.testing.assert_allclose(jax.jit(jax.grad(jax.grad(height)))(at), second, rtol=1e-6)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == "strain-dependent" else pytest.mark.slow)
        for name in MODELS
    ],
)
def test_vmap_is_the_loop(name, helix):
    taus = jnp.array([[-15.0], [0.0], [8.0]])

    def tip(tau):
        return vsr.solve(helix, tau, model=MODELS[name]).tip

    np.testing.assert_allclose(
        jax.jit(jax.vmap(tip))(taus), jnp.stack([tip(t) for t in taus]), atol=1e-12
    )


@pytest.mark.slow
def test_a_batch_in_parts_is_the_loop(helix):
    model = vsr.StrainDependent(1)
    taus = jnp.linspace(-15.0, 5.0, 1030)[:, None]  # more than are solved together

    def height(radius, tau):
        scene = eqx.tree_at(lambda s: s.actuators[0].routing.radius, helix, radius)
        return vsr.solve(scene, tau, model=model).tip[2, 3]

    both = jax.value_and_grad(height, argnums=(0, 1))
    batch = jax.jit(jax.vmap(both, (None, 0)))(0.004, taus)
    loop = jax.jit(lambda taus: jax.lax.map(lambda tau: both(0.004, tau), taus))(taus)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-13), batch, loop)
    forward = jax.jit(jax.vmap(jax.jacfwd(height, argnums=1), (None, 0)))(0.004, taus)
    np.testing.assert_allclose(forward, loop[1][1], atol=1e-13)


@pytest.mark.slow
def test_vmap_over_designs(helix):
    radii = jnp.array([0.003, 0.004, 0.005])

    def tip(radius):
        scene = eqx.tree_at(lambda s: s.actuators[0].routing.radius, helix, radius)
        return vsr.solve(scene, jnp.array([-5.0])).tip[:3, 3]

    np.testing.assert_allclose(
        jax.jit(jax.vmap(tip))(radii), jnp.stack([tip(r) for r in radii]), atol=1e-13
    )


@pytest.mark.slow
def test_a_batch_of_equilibria_gives_its_results_under_vmap(helix):
    eqs = jax.vmap(lambda tau: vsr.solve(helix, tau))(jnp.array([[-15.0], [-5.0]]))
    assert "batch=(2,)" in repr(eqs)
    with pytest.raises(ValueError, match=r"got a batch of shape \(2,\), need jax\.vmap"):
        _ = eqs.tip
    tips = jax.vmap(lambda eq: eq.tip)(eqs)
    np.testing.assert_allclose(tips[1], vsr.solve(helix, [-5.0]).tip, atol=1e-14)


def test_a_scene_may_be_built_under_jit():
    @jax.jit
    def tip(radius):
        arm = vsr.Rod(0.75, vsr.Circular(0.01), vsr.Material(5.93e5, shear=2e5))
        return vsr.solve(
            vsr.Scene(arm, [vsr.Thread(vsr.Helix(radius, 1.529))]), jnp.array([-15.0])
        ).tip[:3, 3]

    np.testing.assert_allclose(
        tip(0.005), vsr.solve(paper.scene("B1"), [-15.0]).tip[:3, 3], atol=1e-13
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "quantity",
    [
        "strain",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("position", "reaction", "thread")
        ),
    ],
)
def test_traced_places_beyond_the_arm_are_nan_and_harm_no_others(quantity):
    arm = vsr.Rod(
        0.5,
        vsr.Circular(lambda x: 0.01 + 0.002 * jnp.sqrt(0.5 - x)),
        vsr.Material(1e6, poisson=0.5),
    )  # NaN beyond the arm
    scene = vsr.Scene(
        arm, [vsr.Tendon(vsr.Parallel(0.005, 0.0), end=0.3)], [vsr.TipWrench(force=(0.0, 0.1, 0.0))]
    )
    eq = vsr.solve(scene, jnp.array([1.0]), model=vsr.StrainDependent(8))

    def at(X):
        return eq.thread(0, X) if quantity == "thread" else getattr(eq, quantity)(X)

    @jax.jit
    def found_and_slope(X):
        return at(X), jax.grad(lambda X: jnp.nansum(at(X)))(X)

    on, off = jnp.array([0, 1, 3]), jnp.array([2, 4])
    X = jnp.array([0.0, 0.2, 0.7, 0.3, -0.1])
    found, slope = found_and_slope(X)
    wanted, wanted_slope = found_and_slope(X.at[off].set(0.1))
    assert np.all(np.isnan(found[off]))
    np.testing.assert_array_equal(found[on], wanted[on])
    np.testing.assert_array_equal(slope[off], 0)
    np.testing.assert_array_equal(slope[on], wanted_slope[on])
    assert np.all(np.isfinite(wanted[on]))
    assert np.all(np.isfinite(slope))


@pytest.mark.slow
def test_gradients_in_single_precision(helix):
    def height(scene, tau):
        return vsr.solve(scene, tau, model=MODELS["strain-dependent"]).tip[2, 3]

    double = jax.jit(jax.grad(height))(helix, jnp.array([-9.0])).actuators[0].routing
    single = (
        jax.jit(jax.grad(height))(helix.astype(jnp.float32), jnp.array([-9.0], jnp.float32))
        .actuators[0]
        .routing
    )
    assert single.radius.dtype == jnp.float32
    np.testing.assert_allclose(single.radius, double.radius, rtol=2e-4)
    np.testing.assert_allclose(single.angle, double.angle, rtol=2e-4)


LOADED = vsr.Scene(
    vsr.Rod(
        0.3, vsr.Circular(vsr.Taper(0.011, 0.009)), vsr.Material(1e6, poisson=0.45, density=1000.0)
    ),
    [
        vsr.Tendon(vsr.Parallel(0.007, 0.0), control="length", stiffness=2e3, friction=0.1),
        vsr.Tendon(vsr.Helix(0.007, pitch=0.4), end=0.2),
    ],
    [vsr.Gravity(), vsr.PointWrench(0.15, force=(0.0, 0.03, 0.0), frame="body")],
)
STEPS = {
    "strain-dependent": vsr.StrainDependent(8),
    "prescribed": vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(2)), steps=8),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "precision"),
    [
        ("strain-dependent", "float64"),
        ("prescribed", "float32"),
        pytest.param("strain-dependent", "float32", marks=pytest.mark.slow),
        pytest.param("prescribed", "float64", marks=pytest.mark.slow),
    ],
)
def test_loaded_solves_mix_no_precisions(name, precision):
    """Tracing is enough: under strict promotion JAX refuses a single operation between two
    precisions."""

    def height(inputs):
        eq = vsr.solve(LOADED, inputs, model=STEPS[name])
        return eq.tip[2, 3] + eq.error.tip

    inputs = jnp.array([-0.01, 2.0], precision)
    with jax.numpy_dtype_promotion("strict"):
        assert jax.eval_shape(jax.grad(height), inputs).dtype == precision


@pytest.mark.parametrize("name", STEPS)
def test_an_empty_batch_of_loaded_scenes_is_empty(name):
    hanging = vsr.Scene(LOADED.rod, [vsr.Tendon(vsr.Parallel(0.007, 0.0))], [vsr.Gravity()])

    def height(inputs):
        return vsr.solve(hanging, inputs, model=STEPS[name]).tip[2, 3]

    both = jax.vmap(jax.value_and_grad(height))
    value, slope = jax.eval_shape(both, jnp.zeros((0, 1)))
    assert (value.shape, slope.shape) == ((0,), (0, 1))


FLOOR = [vsr.Plane((0.0, 0.0, -0.02), (0.0, 0.0, 1.0))]
BATCHES = {
    "bare": ([], [], STEPS["strain-dependent"], "tip"),
    "loaded": ([vsr.Gravity()], [], STEPS["strain-dependent"], "tip"),
    "in contact": ([vsr.Gravity()], FLOOR, STEPS["strain-dependent"], "tip"),
    "prescribed": ([vsr.Gravity()], [], STEPS["prescribed"], "tip"),
    "margin": ([vsr.Gravity()], [], STEPS["strain-dependent"], "stability"),
}
"""Loads, obstacles, model and quantity of arms that are solved together."""


def quantities_of(name):
    """A quantity of arms of one length, each with its inputs."""
    loads, obstacles, model, quantity = BATCHES[name]

    def quantities(length, inputs):
        rod = vsr.Rod(length, vsr.Circular(0.006), vsr.Material(1e6, poisson=0.45, density=1000.0))
        scene = vsr.Scene(rod, [vsr.Tendon(vsr.Parallel(0.005, 0.0))], loads, obstacles=obstacles)

        def found(inputs):
            return getattr(vsr.solve(scene, inputs, model=model), quantity)

        return jax.vmap(found)(inputs)

    return quantities


def with_slopes(quantities):
    """Quantities of arms and the derivatives of the sum of their squares."""

    def both(*given):
        found, pull = jax.vjp(quantities, *given)
        return found, pull(2 * found)

    return both


def deviations_of_mapped(name):
    """Largest deviations of arms that are solved on two devices from those of `jax.vmap`, relative
    to the largest value: of the quantities, and of their derivatives by the length, which the
    devices share, and the inputs, taken inside and outside `jax.shard_map`."""
    # nothing varies over the second axis: JAX refuses the results where they are typed so
    mesh = jax.make_mesh((2, 1), ("arms", "others"), axis_types=(AxisType.Auto,) * 2)
    shared, split = PartitionSpec(), PartitionSpec("arms")
    mapped = partial(jax.shard_map, mesh=mesh, in_specs=(shared, split))
    quantities = quantities_of(name)
    inside = mapped(with_slopes(quantities), out_specs=(split, (shared, split)))
    outside = with_slopes(mapped(quantities, out_specs=split))

    @jax.jit
    def all_of(*given):
        return inside(*given), outside(*given), with_slopes(quantities)(*given)

    arms = 100 if name == "in contact" else 4  # so many wait in a queue
    *found, expected = all_of(jnp.array(0.3), jnp.linspace(0.1, 1.0, arms)[:, None])
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(expected))
    return [
        float(np.max(np.abs(x - y)) / np.max(np.abs(y)))
        for one in found
        for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(expected), strict=True)
    ]


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name == "loaded" else pytest.mark.slow) for name in BATCHES],
)
def test_arms_on_two_devices_are_those_of_vmap(name):
    """In a process of its own: the number of devices is set before the first use of JAX."""
    if name == "in contact" and jax.__version_info__ < (0, 10):
        pytest.skip("lax.split has no transpose inside shard_map where a part is not used")
    flags = " ".join([*FLAGS, "--xla_force_host_platform_device_count=2"])
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_ENABLE_X64": "1"}
    code = f"import test_transforms as t; print(t.deviations_of_mapped({name!r}))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parent,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    deviations = json.loads(done.stdout.splitlines()[-1])
    assert len(deviations) == 6
    assert max(deviations) < 1e-12


@pytest.mark.parametrize(
    "name",
    [
        "bare",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("loaded", "in contact", "prescribed")
        ),
    ],
)
def test_an_exported_batch_has_any_size(name):
    both = with_slopes(partial(quantities_of(name), 0.3))
    (size,) = export.symbolic_shape("size")
    exported = export.export(jax.jit(both))(jax.ShapeDtypeStruct((size, 1), jnp.float64))
    if find_spec("flatbuffers"):  # JAX needs it to write programs
        exported = export.deserialize(exported.serialize())
    inputs = jnp.array([[0.1], [0.2], [1.0]])
    expected = jax.tree.leaves(jax.jit(both)(inputs))
    for size in (1, 3):
        found = jax.tree.leaves(exported.call(inputs[:size]))
        for x, y in zip(found, expected, strict=True):
            np.testing.assert_allclose(x, y[:size], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("half", ["float16", "bfloat16"])
def test_half_precision_is_refused_by_name(half, unchecked):
    half = jnp.dtype(half)
    for make, name in (
        (lambda: vsr.solve(LOADED, jnp.zeros(2, half)), "inputs"),
        (lambda: LOADED.astype(half), "dtype"),
        (lambda: vsr.Circular(jnp.asarray(0.01, half)), "Circular.radius"),
    ):
        with pytest.raises(ValueError, match=f"{name}: got {half}, need float32 or float64"):
            make()
