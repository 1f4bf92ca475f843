"""Loads that depend on the pose of their section: closed forms, independent integration, the three
models, derivatives, and what is refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.arm.scene_numbers import replaced
from vsr_jax.elements.problem import loading
from vsr_jax.mechanics.reaction import react
from vsr_jax.solution.stability import arm_of
from vsr_jax.studies.timing import primitives

L, R, E = 0.4, 0.01, 1e6
EI, EA, GJ = E * np.pi * R**4 / 4, E * np.pi * R**2, E / 2.9 * np.pi * R**4 / 2
ROD = vsr.Rod(L, vsr.Circular(R), vsr.Material(E, poisson=0.45, density=1000.0))
TURNED = vsr.Rod(
    L,
    vsr.Circular(R),
    vsr.Material(E, poisson=0.45, density=1000.0),
    base=vsr.se3.exp(jnp.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])),
)
STEPS = vsr.StrainDependent(8)


def field(r):
    """A magnetic field that depends on the place [T]."""
    return jnp.stack([0.1 * r[1], 0.3 + r[0] * r[2], 0.2 * r[0]])


LOADS = {
    "spring": vsr.Spring((0.2, 0.2, 0.1), 1.0, 0.25, length=0.05, offset=(0.0, 0.01, 0.0)),
    "cord": vsr.Spring((0.1, 0.2, 0.1), 2.0, length=0.02, kind="cord"),
    "payload": vsr.Payload(0.01, 0.28, (0.0, 0.0, 0.02), volume=2e-6, fluid_density=900.0),
    "dipole": vsr.MagneticMoment((0.1, 0.02, 0.01), field),
    "uniform": vsr.MagneticMoment((0.05, 0.02, 0.01), (0.0, 0.1, 0.2), X=0.1),
    "magnet": vsr.MagneticDensity((0.1, 0.05, 0.0), field),
    "spinning": vsr.Spinning((0.0, 3.0, 1.0), (0.0, 0.1, 0.0)),
}
ALL = vsr.Scene(
    TURNED,
    [vsr.Tendon(vsr.Helix(0.008, pitch=0.5))],
    [vsr.Gravity(), *LOADS.values(), vsr.TipWrench((0.0, 0.05, 0.0), frame="body")],
)


def wrench_of(load, X, g, rod=ROD):
    """Wrench of a load on the section at X with the pose g."""
    g = jnp.asarray(g)
    return np.asarray(load.wrench(rod, jnp.asarray(X), g[:3, :3], g[:3, 3]))


def posed(turn, place):
    """A pose from a rotation and a position."""
    return np.block([[turn, np.asarray(place)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


@pytest.fixture(scope="module")
def everything():
    return vsr.solve(ALL, [0.5], model=STEPS, throw=True)


@pytest.mark.parametrize("name", LOADS)
def test_the_wrench_is_the_slope_of_the_potential(name):
    load, X = LOADS[name], jnp.asarray(0.2)
    g = np.asarray(vsr.se3.exp(jnp.array([0.4, -0.7, 0.3, 0.1, 0.2, -0.1])))
    wrench = wrench_of(load, X, g)

    def energy(twist):  # a small motion in the world's axes about the section's point
        turn = np.asarray(vsr.se3.exp(jnp.asarray([*twist[:3], 0, 0, 0])))[:3, :3]
        place = jnp.asarray(g[:3, 3] + twist[3:])
        return float(load.potential(ROD, X, jnp.asarray(turn @ g[:3, :3]), place))

    h = 1e-5
    slopes = [(energy(-h * row) - energy(h * row)) / (2 * h) for row in np.eye(6)]
    np.testing.assert_allclose(wrench, slopes, atol=1e-8 * max(1.0, np.abs(wrench).max()))


def test_known_wrenches():
    turn = np.asarray(vsr.se3.exp(jnp.array([0.4, -0.7, 0.3, 0, 0, 0])))[:3, :3]
    place, moment, B = np.array([0.1, 0.2, -0.1]), np.array([0.1, 0.2, 0.3]), np.array([1.0, 0, 2])
    dipole = wrench_of(vsr.MagneticMoment(moment, B), L, posed(turn, place))
    np.testing.assert_allclose(dipole, [*np.cross(turn @ moment, B), 0, 0, 0], atol=1e-14)
    offset = np.array([0.0, 0.03, 0.0])
    weight = np.array([0, 0, -9.81 * 0.2])
    payload = wrench_of(vsr.Payload(0.2, offset=offset), L, posed(turn, place))
    np.testing.assert_allclose(payload, [*np.cross(turn @ offset, weight), *weight], atol=1e-14)
    anchor, point = np.array([0.3, 0.0, 0.2]), place + turn @ offset
    apart = anchor - point
    pull = 5.0 * (np.linalg.norm(apart) - 0.1) * apart / np.linalg.norm(apart)
    load = vsr.Spring(anchor, 5.0, length=0.1, offset=offset)
    spring = wrench_of(load, L, posed(turn, place))
    np.testing.assert_allclose(spring, [*np.cross(turn @ offset, pull), *pull], atol=1e-14)


class Coil(eqx.Module):
    """A field along z that grows with x [T]."""

    slope: jax.Array

    def __call__(self, r):
        return jnp.stack([0.0 * r[0], 0.0 * r[0], self.slope * r[0]])


def test_the_numbers_of_a_field_are_differentiable():
    def tip(slope):
        load = vsr.MagneticMoment((0.05, 0.0, 0.0), Coil(slope))
        return vsr.solve(vsr.Scene(ROD, (), load), [], model=STEPS).tip[2, 3]

    moment = 0.05 * 1e-6 * L  # bends the arm; to first order there is no force
    found, h = jax.jit(jax.value_and_grad(tip)), 1e-4
    assert float(found(1e-6)[0]) == pytest.approx(moment * L**2 / (2 * EI), rel=1e-3)
    difference = (found(0.1 + h)[0] - found(0.1 - h)[0]) / (2 * h)
    assert float(found(0.1)[1]) == pytest.approx(float(difference), rel=1e-6)


def test_a_spring_of_no_length_has_a_slope_where_its_ends_meet():
    slope = jax.jacfwd(
        lambda r: vsr.Spring((0.1, 0.0, 0.0), 3.0).wrench(ROD, jnp.asarray(L), jnp.eye(3), r)
    )(jnp.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(slope[3:], -3.0 * np.eye(3), atol=1e-15)


BENDING = ("bending_z",)


def test_a_spring_stiffens_the_tip_of_a_beam():
    """To first order the tip yields by F / (3 EI / L^3 + k)."""
    k = 0.7

    def tip(force):
        loads = [vsr.Spring((L, 0.0, 0.0), k), vsr.TipWrench((0.0, force, 0.0))]
        return vsr.solve(vsr.Scene(ROD, (), loads, free_strains=BENDING), [], model=STEPS).tip[1, 3]

    assert float(jax.grad(tip)(0.0)) == pytest.approx(1 / (3 * EI / L**3 + k), rel=1e-6)


@pytest.mark.slow
def test_a_column_with_a_spring_buckles_where_theory_says():
    """Clamped, with a lateral spring k at its tip: tan u = u (1 - P / k L), u = L sqrt(P / EI)."""
    k = 3 * EI / L**3
    low, high = 1.6, 4.4
    for _ in range(60):
        u = 0.5 * (low + high)
        low, high = (u, high) if np.tan(u) - u * (1 - EI * u**2 / (k * L**3)) < 0 else (low, u)
    critical = EI * u**2 / L**2

    def margin(push):
        loads = [vsr.Spring((L, 0.0, 0.0), k), vsr.TipWrench((-push, 0.0, 0.0))]
        eq = vsr.solve(
            vsr.Scene(ROD, (), loads, free_strains=BENDING), [], model=vsr.StrainDependent(16)
        )
        return eq.status, eq.stability

    status, margins = jax.jit(jax.vmap(margin))(critical * jnp.array([0.99, 1.01, 0.999]))
    assert list(status) == [vsr.Status.CONVERGED, vsr.Status.UNSTABLE, vsr.Status.CONVERGED]
    # linear in the distance
    assert float(margins[2]) == pytest.approx(0.1 * float(margins[0]), rel=0.02)


def test_an_offset_payload_twists_the_arm():
    """GJ phi / L = m g o cos phi."""
    eq = vsr.solve(
        vsr.Scene(ROD, (), vsr.Payload(0.05, offset=(0, 0.02, 0)), free_strains=("torsion",)), []
    )
    phi, push = 0.0, 0.05 * 9.81 * 0.02 * L / GJ
    for _ in range(200):
        phi = 0.5 * (phi + push * np.cos(phi))
    # the weight pulls the side of +y down, about -x
    assert np.arctan2(eq.tip[2, 1], eq.tip[1, 1]) == pytest.approx(-phi, abs=1e-12)


def test_a_magnetised_beam_is_the_elastica():
    """EI theta'' = -mu B cos theta with theta(0) = 0 and theta'(L) = 0, by Runge-Kutta steps."""
    moment, B, n = 0.3, 0.6, 2000
    push, h = moment * B / EI, L / n

    def rate(y):
        return np.array([y[1], -push * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])])

    def shot(slope):
        y = np.array([0.0, slope, 0.0, 0.0])
        for _ in range(n):
            a = rate(y)
            b = rate(y + h / 2 * a)
            c = rate(y + h / 2 * b)
            y = y + h / 6 * (a + 2 * b + 2 * c + rate(y + h * c))
        return y

    a, b = push * L, 0.5 * push * L
    fa, fb = shot(a)[1], shot(b)[1]
    for _ in range(30):  # secant
        if abs(fb - fa) < 1e-15:
            break
        a, b, fa = b, b - fb * (b - a) / (fb - fa), fb
        fb = shot(b)[1]
    end = shot(b)
    scene = vsr.Scene(ROD, (), vsr.MagneticDensity((moment, 0, 0), (0, B, 0)), free_strains=BENDING)
    eq = vsr.solve(scene, [], model=vsr.StrainDependent(16), throw=True)
    np.testing.assert_allclose(eq.tip[:2, 3], end[2:], atol=1e-9)
    assert end[0] > 1.0  # far from straight


@pytest.mark.slow
def test_a_spinning_bar_stretches():
    """EA (r' - 1) is the pull, so r'' = -rho omega^2 / E r: r = sin(b X) / (b cos(b L))."""
    omega = 40.0
    b = np.sqrt(1000.0 / E) * omega
    scene = vsr.Scene(ROD, (), vsr.Spinning((0, 0, omega)), free_strains=("elongation",))
    eq = vsr.solve(scene, [], throw=True)
    X = np.array([0.1, 0.3, L])
    np.testing.assert_allclose(
        eq.position(X)[:, 0], np.sin(b * X) / (b * np.cos(b * L)), atol=1e-12
    )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), [("spring", 1.0), ("dipole", 0.3), ("payload", 1.0)])
def test_the_shape_is_that_under_the_dead_wrench_of_the_load(name, size):
    load = LOADS[name].scaled(jnp.asarray(size))
    eq = vsr.solve(vsr.Scene(ROD, (), load), [], model=STEPS, throw=True)
    X = load.place(ROD)
    wrench = wrench_of(load, X, eq.pose(X))
    dead = vsr.PointWrench(X, wrench[3:], wrench[:3])
    same = vsr.solve(vsr.Scene(ROD, (), dead), [], model=STEPS, start=eq, throw=True)
    np.testing.assert_allclose(same.tip, eq.tip, atol=1e-8)
    assert np.linalg.norm(eq.tip[1:3, 3]) > 0.02  # it bends the arm


@pytest.mark.slow
def test_all_models_agree(everything):
    fine = vsr.solve(ALL, [0.5], model=vsr.StrainDependent(24), throw=True)
    continuum = vsr.Continuum(rtol=1e-10, atol=1e-12, derivative=vsr.StrainDependent(24))
    there = vsr.solve(ALL, [0.5], model=continuum, throw=True)
    np.testing.assert_allclose(there.tip, fine.tip, atol=1e-8)
    basis = vsr.Basis.uniform(vsr.Legendre(8))
    projected = vsr.solve(ALL, [0.5], model=vsr.Prescribed(basis, steps=16), throw=True)
    np.testing.assert_allclose(projected.tip, fine.tip, atol=5e-5)  # polynomials over the jumps
    np.testing.assert_allclose(everything.tip, fine.tip, atol=1e-5)


@pytest.mark.slow
def test_the_reaction_changes_as_its_derivative_says(everything):
    """The derivative of the rotations is a rule of its own; differences of fourth order know
    nothing of it."""
    random = np.random.default_rng(1)
    nodes, loads = everything.nodes, loading(everything.scene, everything.nodes.grid)
    shape = nodes.grid.X.shape
    xi = tuple(jnp.broadcast_to(x, shape) for x in nodes.xi)
    change = tuple(
        jnp.asarray(size * random.normal(size=shape)) for size in (1, 1, 1, 0.01, 0.01, 0.01)
    )

    @jax.jit
    def wrench(step):
        moved = tuple(x + step * y for x, y in zip(xi, change, strict=True))
        return react(moved, nodes.grid, loads).wrench

    h = 1e-3
    _, exact = jax.jvp(wrench, (0.0,), (1.0,))
    differences = 8 * (wrench(h) - wrench(-h)) - (wrench(2 * h) - wrench(-2 * h))
    size = np.abs(exact).max()
    assert np.abs(exact - differences / (12 * h)).max() < 1e-9 * size


@pytest.mark.slow
def test_the_form_of_the_tangent_is_its_product(everything):
    random = np.random.default_rng(1)

    @eqx.filter_jit
    def form_and_product(eq, free):
        arm = arm_of(eq.scene, eq.inputs, eq.sound_forces, eq.nodes)
        return arm.form(free / arm.units), jnp.sum(
            free / arm.units * arm.product()(free / arm.units)
        )

    sizes = np.array([1, 1, 1, 0.01, 0.01, 0.01]).reshape(6, 1, 1)
    free = jnp.asarray(sizes * random.normal(size=(6, *everything.nodes.grid.X.shape)))
    form, product = form_and_product(everything, free)
    assert float(form) == pytest.approx(float(product), rel=1e-10)


@pytest.mark.slow
def test_the_energy_is_stationary(everything):
    """Its slope by a number of a load is the explicit one: half the stretch squared for a spring's
    stiffness, minus the height for a mass."""
    scene = vsr.Scene(
        TURNED,
        [vsr.Tendon(vsr.Helix(0.008, pitch=0.5))],
        [vsr.Gravity(), *(LOADS[name] for name in ("spring", "payload", "magnet", "spinning"))],
    )

    def total(stiffness, mass):
        spring = vsr.Spring((0.2, 0.2, 0.1), stiffness, 0.25, 0.05)
        loads = (
            scene.loads[0],
            spring,
            vsr.Payload(mass, 0.28, (0.0, 0.0, 0.02)),
            *scene.loads[3:],
        )
        model = vsr.StrainDependent(16)
        eq = vsr.solve(vsr.Scene(scene.rod, scene.actuators, loads), [0.5], model=model)
        return eq.energy.total, (eq.pose(0.25), eq.pose(0.28))

    slopes, (at_spring, at_mass) = jax.jit(jax.jacfwd(total, (0, 1), has_aux=True))(1.0, 0.01)
    stretch = np.linalg.norm(at_spring[:3, 3] - np.array([0.2, 0.2, 0.1])) - 0.05
    assert float(slopes[0]) == pytest.approx(0.5 * stretch**2, rel=1e-6)
    height = (at_mass[:3, 3] + at_mass[:3, :3] @ np.array([0, 0, 0.02]))[2]
    assert float(slopes[1]) == pytest.approx(9.81 * float(height), rel=1e-6)


@pytest.mark.slow
def test_both_modes_are_the_differences_by_every_number():
    numbers = {name: p.value for name, p in vsr.parameters(ALL).items()}
    leaves, tree = jax.tree.flatten(numbers)
    random = np.random.default_rng(3)
    way = [jnp.asarray(0.01 * np.abs(x) * random.uniform(-1, 1, x.shape)) for x in leaves]

    def tip(*leaves):
        scene = replaced(ALL, jax.tree.unflatten(tree, leaves))
        eq = vsr.solve(scene, jnp.array([0.5]), model=STEPS)
        return jnp.sum(eq.tip[:3] * jnp.arange(1.0, 13.0).reshape(3, 4))

    gradient = jax.jit(jax.grad(tip, tuple(range(len(leaves)))))(*leaves)
    reverse = float(sum(jnp.sum(g * v) for g, v in zip(gradient, way, strict=True)))
    forward = float(jax.jit(lambda *x: jax.jvp(tip, x, tuple(way))[1])(*leaves))
    at = jax.jit(jax.vmap(lambda t: tip(*(x + t * v for x, v in zip(leaves, way, strict=True)))))
    h = 0.05
    low2, low, high, high2 = at(h * jnp.array([-2.0, -1.0, 1.0, 2.0]))
    difference = float((8 * (high - low) - (high2 - low2)) / (12 * h))
    assert reverse == pytest.approx(forward, rel=1e-8)
    assert forward == pytest.approx(difference, rel=1e-6)


@pytest.mark.slow
def test_batches_and_single_precision(everything):
    """A batch over the numbers of the loads, in both precisions."""
    where = [(0.2, 0.2, 0.1), (0.3, 0.1, 0.0), (0.25, 0.0, 0.2)]

    def tip(anchor, mass):
        loads = [vsr.Gravity(), vsr.Spring(anchor, 1.0), vsr.Payload(mass, offset=(0.0, 0.0, 0.02))]
        return vsr.solve(vsr.Scene(ROD, (), loads), [], model=STEPS).tip

    anchors, masses = jnp.array(where), jnp.array([0.0, 0.005, 0.01])
    batch = jax.jit(jax.vmap(tip))(anchors, masses)
    single = jax.jit(tip)
    for i in range(3):
        np.testing.assert_allclose(batch[i], single(anchors[i], masses[i]), atol=1e-9)
    half = ALL.astype(jnp.float32)
    coarse = vsr.solve(half, jnp.array([0.5], jnp.float32), model=STEPS)
    assert coarse.converged
    assert coarse.tip.dtype == jnp.float32
    np.testing.assert_allclose(coarse.tip, everything.tip, atol=2e-4)


def test_what_no_load_depends_on_is_not_computed():
    def size(loads):
        """Size of the residual's program; that of the whole solve depends on the elimination."""
        scene = vsr.Scene(ROD, (), loads)
        grid = STEPS.grid(scene)
        xi = scene.sections(grid.X).rest
        return primitives(jax.make_jaxpr(lambda: react(xi, grid, loading(scene, grid)))()).total()

    dead, turning = vsr.TipWrench((0, 1, 0)), vsr.TipWrench((0, 1, 0), frame="body")
    payload, spring = vsr.Payload(0.1, offset=(0, 0.01, 0)), vsr.Spring((0, 0, 0), 1.0)
    assert size([dead]) < size([turning]) < size([payload]) < size([spring])


def test_scene_files_hold_them(tmp_path):
    loads = [load for name, load in LOADS.items() if name not in ("dipole", "magnet")]
    scene = vsr.Scene(ROD, (), [*loads, vsr.MagneticDensity((0.1, 0, 0), (0, 0, 0.1))])
    vsr.save(scene, tmp_path / "scene.toml")
    again = vsr.load(tmp_path / "scene.toml").scene
    assert repr(again) == repr(scene)
    with pytest.raises(ValueError, match=r"loads\[0\]\.field: a .* cannot be stored"):
        vsr.save(vsr.Scene(ROD, (), LOADS["dipole"]), tmp_path / "other.toml")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: vsr.Spring((0, 0, 0), -1.0), r"Spring\.stiffness: got -1\.0, need .* >= 0"),
        (lambda: vsr.Spring((0, 0), 1.0), r"Spring\.anchor: got shape \(2,\)"),
        (lambda: vsr.Spring((0, 0, 0), 1.0, kind="rope"), r"Spring\.kind: got 'rope'"),
        (lambda: vsr.Payload(-0.1), r"Payload\.mass: got -0\.1"),
        (
            lambda: vsr.Scene(ROD, (), vsr.Spring((0, 0, 0), 1.0, 0.5)),
            r"Scene\.loads\[0\]\.X: got 0\.5 m, need a place on the arm of 0\.4 m",
        ),
        (
            lambda: vsr.Scene(ROD, (), vsr.MagneticMoment((1, 0, 0), lambda r: r[0])),
            r"MagneticMoment\.field: got a function that returns shape \(\), need \(3,\)",
        ),
        (
            lambda: vsr.Scene(
                vsr.Rod(L, vsr.Circular(R), vsr.Material(E, poisson=0.45)),
                (),
                vsr.Spinning((0, 0, 1)),
            ),
            r"got a Spinning and a rod whose material has no density",
        ),
    ],
)
def test_what_is_refused(make, message, unchecked):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.slow
def test_second_derivatives_at_the_natural_length_of_a_spring():
    """Along the arm: by symmetry, aside and up do not mix, and the other entries are those of an
    anchor a little off the axis."""
    arm = vsr.Rod(0.3, vsr.Circular(0.006), vsr.Material(1e6, poisson=0.45))

    def up(anchor):
        spring = vsr.Spring(anchor, 2.0, length=0.1)
        return vsr.solve(vsr.Scene(arm, loads=[spring]), [], model=vsr.StrainDependent(8)).tip[2, 3]

    slope = jax.jit(jax.grad(up))
    h = 1e-5
    found = jax.jit(jax.hessian(up))(jnp.array([0.4, 0.0, 0.0]))
    columns = []
    for unit in np.eye(3):
        ahead, behind = (slope(jnp.array([0.4, 0.0, 0.0]) + s * h * unit) for s in (1, -1))
        columns.append((ahead - behind) / (2 * h))
    np.testing.assert_allclose(found, np.stack(columns), atol=1e-4 * np.abs(found).max())
    assert found[0, 2] > 100
