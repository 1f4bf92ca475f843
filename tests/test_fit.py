"""Calibration: known numbers are found again, derivatives agree with differences, errors are one
line."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.arm.scene_numbers import replaced

MODEL = vsr.StrainDependent(3, 4)
HANGING = [[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]
X = [0.1, 0.2]
OFFSET = [[0.0, 0.0, 0.01], [0.004, 0.0, 0.0]]
SERIES = ["A", "A", "A", "A", "B", "B", "B", "B"]
INPUTS = np.random.default_rng(7).uniform(0.1, 1.0, (8, 2))


FIXED = 3  # the second gain
SLOPES = "actuators[*].routing.slope_y"


def arm(loads=(), **options):
    """Two oblique tendons; without loads it compiles fast."""
    material = vsr.Material(5e5, poisson=0.4, density=1100.0)
    rod = vsr.Rod(0.2, vsr.Circular(0.008), material, base=HANGING)
    routes = [vsr.Linear(0.006, 0.0, -0.01), vsr.Linear(-0.003, 0.005, -0.01, -0.02)]
    return vsr.Scene(rod, [vsr.Tendon(route, **options) for route in routes], loads)


TRUTH = {"young": 4.2e5, "slope": -0.006, "gain": 0.9, "base": [0.002, -0.001, 0.0015]}
FREE = {
    "rod.material.young": (1e5, 1e6),
    SLOPES: vsr.Unknown(-0.02, 0.02, shared=True),
    "inputs.gain": vsr.Unknown([0.5, 1.0], [1.5, 1.0]),
    "base.position[*]": vsr.Unknown(-0.01, 0.01, prior=(0.0, 0.01)),
}


def truth():
    numbers = {"rod.material.young": TRUTH["young"]}
    numbers |= {f"actuators[{i}].routing.slope_y": TRUTH["slope"] for i in (0, 1)}
    return replaced(arm(), {name: jnp.array(value) for name, value in numbers.items()})


def positions(scene, inputs):
    """Markers of the arm, by one solve after another, without the code of the fit."""

    def one(u):
        g = vsr.solve(scene, u, model=MODEL).pose(jnp.array(X))
        return g[:, :3, 3] + (g[:, :3, :3] @ jnp.array(OFFSET)[:, :, None])[..., 0]

    return np.asarray(jax.vmap(one)(jnp.asarray(inputs)))


@pytest.fixture(scope="module")
def clean():
    true = positions(truth(), INPUTS * [TRUTH["gain"], 1.0])
    return true + np.where(np.array(SERIES)[:, None, None] == "A", TRUTH["base"], 0.0)


def measured(value, sd=2e-4, **options):
    markers = vsr.Markers(value, X, offset=OFFSET, sd=sd, **options)
    return vsr.Measurements(INPUTS.astype(np.asarray(value).dtype), markers, series=SERIES)


def fitted(data, free=FREE, **options):
    return vsr.fit(arm(), free, data, model=MODEL, progress=False, **options)


@pytest.fixture(scope="module")
def exact(clean):
    return fitted(measured(clean))


@pytest.fixture(scope="module")
def noisy(clean):
    return fitted(measured(clean + np.random.default_rng(3).normal(0, 2e-4, clean.shape), None))


def values(found):
    return {name: one.value for name, one in found.numbers.items()}


def true_values():
    base = [*TRUTH["base"], 0.0, 0.0, 0.0]
    return np.array([TRUTH["young"], TRUTH["slope"], TRUTH["gain"], 1.0, *base])


def test_known_numbers_are_found_again(exact):
    """The priors of the base pull by far less than a standard error."""
    assert exact.converged
    errors = np.nan_to_num(np.sqrt(np.diag(exact.covariance)))
    assert np.all(np.abs(exact.x - true_values()) <= 0.05 * errors)
    assert np.all(errors[:3] < 0.05 * np.abs(true_values()[:3]))
    assert exact.rms()["markers[1]"] < 2e-6
    assert exact.undetermined == ()
    assert "fixed" in str(exact)


@pytest.mark.slow
def test_the_scene_of_a_fit_predicts_the_measurements(exact, clean):
    for series, shift in (("A", TRUTH["base"]), ("B", np.zeros(3))):
        scene = exact.scene_of(series)
        found = positions(scene, exact.inputs(INPUTS[:2]))
        np.testing.assert_allclose(found - shift, clean[:2] - np.array(TRUTH["base"]), atol=5e-6)
    np.testing.assert_allclose(
        exact.solve(INPUTS[0]).position(0.1),
        exact.predict(INPUTS[:1], [0.1]).position[0, 0],
        atol=1e-9,
    )


def test_slopes_are_differences_of_solves(noisy):
    """Against differences of solves that start without a guess."""
    problem, x = noisy.problem, noisy.x
    slopes = problem.at(x).slopes
    scale = np.nan_to_num(np.sqrt(np.diag(noisy.covariance)), nan=0.01)
    for k, h in enumerate(1e-2 * scale):
        step = h * np.eye(x.size)[k]
        change = (problem.at(x + step).residual - problem.at(x - step).residual) / (2 * h)
        np.testing.assert_allclose(slopes[..., k] * scale[k], change * scale[k], atol=1e-9)


def test_standard_errors_are_those_of_the_linear_model(noisy):
    """Where the standard deviation is estimated, chi squared is the degrees of freedom."""
    assert noisy.reduced_chi_squared == pytest.approx(1, abs=0.02)
    sd = noisy.adjusted.sd[0, 0]
    assert sd == pytest.approx(2e-4, rel=0.25)
    free = np.arange(noisy.x.size) != FIXED
    J = noisy.problem.at(noisy.x).slopes.reshape(-1, noisy.x.size)[:, free] / sd
    covariance = np.linalg.inv(J.T @ J + np.diag(noisy.problem.box.sd[free] ** -2.0))
    found = noisy.covariance[np.ix_(free, free)]
    np.testing.assert_allclose(found, covariance, rtol=1e-5, atol=1e-30)
    assert np.all(np.abs(noisy.x - true_values())[free] < 4 * np.sqrt(np.diag(covariance)))
    np.testing.assert_allclose(np.diag(noisy.correlation)[free], 1)


def test_missing_measurements_do_not_count(clean, exact):
    value = clean.copy()
    value[2, 0] = np.nan
    value[5] = np.nan
    found = fitted(measured(value))
    assert found.freedom == pytest.approx(exact.freedom - 9, abs=0.1)
    np.testing.assert_allclose(found.x, exact.x, rtol=1e-2, atol=1e-5)
    assert np.isnan(found.residuals["markers[0]"][2]).all()


def test_a_robust_loss_ignores_an_outlier(clean):
    value = clean + np.random.default_rng(3).normal(0, 2e-4, clean.shape)
    value[3, 1] += 0.02
    far, near = (fitted(measured(value), loss=loss) for loss in ("linear", "cauchy"))
    error = [abs(values(f)["rod.material.young"] / TRUTH["young"] - 1) for f in (far, near)]
    assert error[1] < 0.1 * error[0]
    assert far.reduced_chi_squared > 50
    assert "times the given sd" in str(far)


def test_shapes_without_an_equilibrium_are_named(clean):
    """A tension that crushes the arm."""
    inputs = INPUTS.copy()
    inputs[6] = 400.0
    data = vsr.Measurements(inputs, vsr.Markers(clean, X, offset=OFFSET, sd=2e-4), series=SERIES)
    found = fitted(data)
    assert found.failed == (6,)
    assert "FAILED: 1 shapes have no equilibrium (or no derivatives there)" in str(found)
    assert "no weight: 6" in str(found)
    np.testing.assert_allclose(values(found)["rod.material.young"], TRUTH["young"], rtol=2e-3)
    with pytest.raises(ValueError, match="got no equilibrium for any of the 8 shapes"):
        fitted(vsr.Measurements(0 * INPUTS + 400.0, data.observations, series=SERIES))


def test_the_start_does_not_matter(exact, clean):
    found = fitted(measured(clean), starts=3)
    np.testing.assert_allclose(found.x, exact.x, rtol=1e-3, atol=1e-6)
    assert len(found.start_costs) == 3


def test_fewer_unknowns(noisy):
    parallel = noisy.refit({SLOPES: 0.0})
    assert values(parallel)[SLOPES] == 0.0
    one = noisy.refit(shared=["base.position[*][1]"])
    assert "base.position[*][1]" in one.names
    table = vsr.compare({"all": noisy, "parallel": parallel, "one y": one}, folds=4)
    assert table.best == "all"
    assert table.models["all"].criterion < table.models["parallel"].criterion
    assert [row.unknowns for row in table.models.values()] == [9, 8, 8]
    assert "AICc" in str(table)


def test_held_out_series_refit_only_their_base(noisy):
    checked = vsr.cross_validate(noisy, "series")
    moved = np.abs(checked.x[1] - noisy.x)  # fold 1 holds out series B
    assert np.all(moved[-3:] < 5e-4)
    error = checked.rms("B")["markers[1]"]
    assert 1e-4 < error < 1.5e-3
    # a held-out shape has no influence on its own prediction
    folds = vsr.cross_validate(noisy, 8)
    assert sorted(folds.fold.tolist()) == list(range(8))
    assert folds.mean_square > noisy.chi_squared / noisy.counted.sum()


@pytest.mark.slow
def test_other_measurements_get_only_a_base_of_their_own(exact, clean):
    shift = np.array([0.004, 0.001, -0.002])
    markers = vsr.Markers(clean[4:] + shift, X, offset=OFFSET, sd=2e-4)
    other = vsr.Measurements(INPUTS[4:], markers, series=["C"] * 4)
    found = exact.on(other)
    got = values(found)
    base = [got[f"base.position[C][{i}]"] for i in range(3)]
    np.testing.assert_allclose(base, shift, atol=2e-6)
    assert got["rod.material.young"] == values(exact)["rod.material.young"]
    assert np.isnan(found.numbers["rod.material.young"].error)
    assert found.rms()["markers[1]"] < 3e-6


def test_the_profile_of_a_nearly_linear_unknown_is_its_parabola(noisy):
    name = "base.position[A][0]"
    found, one = vsr.likelihood_profile(noisy, name, points=5), noisy.numbers["base.position[A][0]"]
    shape = ((found.values - one.value) / one.error) ** 2
    np.testing.assert_allclose(found.rise, shape, atol=0.02, rtol=0.02)
    np.testing.assert_allclose(found.high - one.value, 1.96 * one.error, rtol=0.02)
    np.testing.assert_allclose(one.value - found.low, 1.96 * one.error, rtol=0.02)


def test_the_next_measurement_is_the_best_of_all(noisy):
    """Against the determinants of the whole information matrix with each candidate added."""
    candidates = np.array([[0.2, 0.1], [1.2, 1.3], [0.0, 1.2]])
    found = vsr.next_measurement(noisy, candidates, 2)
    box, sd = noisy.problem.box, noisy.adjusted.sd[0, 0]
    J = noisy.problem.at(noisy.x).slopes.reshape(-1, noisy.x.size) / sd
    free = np.arange(noisy.x.size) != FIXED
    span = (box.high - box.low)[free]
    before = J[:, free].T @ J[:, free] + np.diag(box.sd[free] ** -2.0 + 12 / span**2)
    fresh = (
        noisy.problem.evaluate(
            noisy.x, jnp.asarray(candidates), ["A"] * 3, (jnp.zeros((3, 2, 3)),)
        ).slopes
        / sd
    )
    gains = [
        0.5 * (np.linalg.slogdet(before + j.T @ j)[1] - np.linalg.slogdet(before)[1])
        for j in fresh[..., free]
    ]
    assert found.chosen[0] == np.argmax(gains)
    np.testing.assert_allclose(found.gain[0], max(gains), rtol=1e-4)


@pytest.mark.slow
def test_bands_are_those_of_the_linear_model(noisy):
    """Position of the tip for new inputs, against differences of the fitted scene."""
    new = np.array([[0.7, 0.3]])
    found = noisy.predict(new, [0.2])
    rows = []
    free = np.flatnonzero(np.arange(noisy.x.size) != FIXED)
    covariance = noisy.covariance[np.ix_(free, free)]
    for k, h in zip(free, 1e-3 * np.sqrt(np.diag(covariance)), strict=True):
        ends = []
        for sign in (1, -1):
            moved = noisy.adjusted._replace(x=noisy.x + sign * h * np.eye(noisy.x.size)[k])
            ends.append(vsr.Fit(noisy.problem, moved).solve(new[0]).position(0.2))
        rows.append((ends[0] - ends[1]) / (2 * h))
    sd = np.sqrt(np.einsum("ki,kl,li->i", rows, covariance, rows))
    np.testing.assert_allclose(found.sd[0, 0], sd, rtol=1e-4)


@pytest.mark.slow
def test_modulus_and_gain_without_gravity_are_not_determined():
    scene = arm()
    data = measured(positions(scene, INPUTS))
    free = {"rod.material.young": (1e5, 1e6), "inputs.gain": vsr.Unknown([0.3, 1.0], [3.0, 1.0])}
    found = vsr.fit(scene, free, data, model=MODEL, progress=False)
    # a gain of one tendon of two: the other, which is known, tells the modulus
    assert found.undetermined == ()
    shared = {"rod.material.young": (1e5, 1e6), "inputs.gain": (0.3, 3.0)}
    found = vsr.fit(scene, shared, data, model=MODEL, progress=False)
    assert len(found.undetermined) == 1
    assert "rod.material.young" in found.undetermined[0]
    assert np.isinf(found.numbers["rod.material.young"].error)
    one = found.refit({"inputs.gain[1]": 1.0})
    assert np.isfinite(one.numbers["rod.material.young"].error)


@pytest.mark.slow
def test_single_precision(clean):
    found = fitted(measured(clean.astype(np.float32)))
    assert found.scene.rod.length.dtype == np.float32
    np.testing.assert_allclose(values(found)["rod.material.young"], TRUTH["young"], rtol=0.01)


class TipHeight(vsr.Observation):
    value: jax.Array
    sd: jax.Array | None = None
    name: str = eqx.field(static=True, default="height")

    def predicted(self, eq):
        return eq.tip[2, 3].reshape(1, 1)


@pytest.mark.slow
def test_every_kind_of_observation():
    """Poses, curvatures, tensions of length-driven tendons and one of the user's own, together with
    an offset of the cables and an offset of the markers."""
    scene = arm(control="length", stiffness=500.0)
    true = replaced(scene, {"rod.material.young": jnp.array(4e5)})
    lengths = -np.random.default_rng(1).uniform(0.002, 0.006, (6, 2))

    def one(u):
        eq = vsr.solve(true, u, model=MODEL)
        return eq.tip, eq.strain(jnp.array(X))[:, 1:3], -eq.forces, eq.tip[:3, 3]

    tip, bend, tension, place = jax.vmap(one)(jnp.asarray(lengths + np.array([4e-4, -3e-4])))
    tip = np.array(tip)
    tip[1] = np.nan
    shift = np.einsum("nij,j->ni", tip[:, :3, :3], [0.0, 0.002, -0.001])
    kinds = [
        vsr.Poses(tip, sd=1e-4, sd_angle=1e-3),
        vsr.Curvatures(bend, X, sd=0.01),
        vsr.Tensions(tension, [0, 1], sd=0.01),
        vsr.Markers(tip[:, :3, 3] + shift, sd=1e-4),
        TipHeight(place[:, 2:, None], jnp.array(1e-4)),
    ]
    free = {
        "rod.material.young": (1e5, 1e6),
        "inputs.offset": (-0.001, 0.001),
        "markers.offset": vsr.Unknown([[0, -0.01, -0.01]], [[0, 0.01, 0.01]]),
    }
    data = vsr.Measurements(lengths, kinds)
    found = vsr.fit(scene, free, data, model=MODEL, progress=False)
    got = values(found)
    np.testing.assert_allclose(got["rod.material.young"], 4e5, rtol=1e-3)
    np.testing.assert_allclose(
        [got[f"inputs.offset[{i}]"] for i in (0, 1)], [4e-4, -3e-4], rtol=1e-2
    )
    np.testing.assert_allclose(
        [got[f"markers.offset[0][{i}]"] for i in (1, 2)], [2e-3, -1e-3], rtol=1e-2
    )
    assert found.numbers["markers.offset[0][0]"].value == 0.0
    assert set(found.rms()) == {
        "poses",
        "poses rotation",
        "curvatures[0]",
        "curvatures[1]",
        "tensions[0]",
        "tensions[1]",
        "markers",
        "height[0]",
    }
    assert max(found.rms().values()) < 1e-3


def test_a_frame_turns_positions_into_the_world():
    turn = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    seen = vsr.Markers([[1.0, 2.0, 3.0]], frame=turn)
    np.testing.assert_allclose(seen.value, [[[-1.9, 1.2, 3.3]]])


def bad(free=FREE, value=None, scene=None, **options):
    value = np.full((8, 2, 3), [0.0, 0.0, -0.1]) if value is None else value
    return vsr.fit(
        arm() if scene is None else scene,
        free,
        measured(value),
        model=MODEL,
        progress=False,
        **options,
    )


@pytest.mark.parametrize(
    ("problem", "message"),
    [
        (lambda: bad({}), "free: got {}, need bounds of at least one number"),
        (lambda: bad({"rod.material.youn": (1, 2)}), "did you mean 'rod.material.young'"),
        (lambda: bad({"base.position[C]": (0, 1)}), "base.position"),
        (lambda: bad({"rod.material.young": 3.0}), "need a pair"),
        (lambda: bad({"rod.material.young": (2, 1)}), "need the least first"),
        (lambda: bad({"rod.material.young": (2, 2)}), "got equal bounds everywhere"),
        (
            lambda: bad({"inputs.gain": vsr.Unknown(0.5, 2.0, shared=True)}),
            "shared: got True for one array",
        ),
        (lambda: bad({"rod.material.young": vsr.Unknown(1, 2, prior=(1, 0))}), "a number > 0"),
        (lambda: bad({"inputs.gain": ([1, 2, 3], 4)}), r"got shape \(3,\)"),
        (lambda: bad({**FREE, "actuators[0].routing.slope_y": (0, 1)}), "by 'actuators"),
        (lambda: bad(loss="square"), "loss: got 'square'"),
        (lambda: bad(value=np.full((8, 2, 3), -90.0)), "these look like millimetres"),
        (lambda: bad(value=np.full((8, 2, 3), -0.3)), r"need positions that it can reach"),
        (lambda: bad(value=np.full((8, 2, 3), 1e-4)), "is the scene in millimetres"),
        (lambda: bad(value=np.full((8, 2, 3), np.nan)), "got no measured value"),
        (lambda: vsr.Measurements(np.zeros((0, 2)), []), "at least one shape"),
        (lambda: vsr.Measurements(INPUTS, vsr.Markers(np.zeros((3, 3)))), "got 3 shapes, need 8"),
        (lambda: vsr.Markers(np.zeros((8, 3)), sd=0.0), "markers.sd"),
        (lambda: vsr.Markers(np.zeros((8, 2, 3))), "need an abscissa"),
        (lambda: vsr.Poses(np.zeros((8, 4, 4)), sd=1.0), "need both"),
        (lambda: vsr.Measurements(INPUTS, vsr.Tensions(INPUTS, [0, 1]), series="AB"), "got 2 n"),
    ],
)  # fmt: skip
def test_errors_are_one_line(problem, message, unchecked):
    with pytest.raises(ValueError, match=message) as caught:
        problem()
    assert "\n" not in str(caught.value)


def test_more_unknowns_than_numbers():
    data = vsr.Measurements(INPUTS[:1], vsr.Markers([[0.0, 0.0, -0.1]]))
    free = {"rod.material.young": (1e5, 1e6), "inputs.gain": (0.5, 1.5), "inputs.offset": (0, 1)}
    with pytest.raises(ValueError, match="got 5 unknowns for 3 measured numbers and 0 priors"):
        vsr.fit(arm(), free, data, progress=False)
