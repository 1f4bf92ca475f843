"""Figures of a fit: predicted markers are joined to the measured ones, failed shapes are named."""

import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest

import vsr_jax as vsr

mpl.use("Agg")
MODEL = vsr.StrainDependent(3, 4)
X, OFFSET = [0.1, 0.2], [[0.0, 0.0, 0.02], [0.0, 0.0, -0.02]]
INPUTS = np.array([[0.5], [0.9], [400.0], [0.2]])
CRUSHED = 2


@pytest.fixture(scope="module")
def fit():
    """Two markers that are far from the axis; a tension that crushes the arm."""
    rod = vsr.Rod(0.2, vsr.Circular(0.008), vsr.Material(5e5, poisson=0.4))
    scene = vsr.Scene(rod, [vsr.Tendon(vsr.Parallel(0.0, 0.006))])

    def one(u):
        g = vsr.solve(scene, u, model=MODEL).pose(jnp.array(X))
        return g[:, :3, 3] + (g[:, :3, :3] @ jnp.array(OFFSET)[:, :, None])[..., 0]

    places = np.array(jax.vmap(one)(jnp.asarray(INPUTS)))
    places[CRUSHED] = [[0.05, 0.0, 0.03], [0.1, 0.0, 0.02]]
    places += np.random.default_rng(0).normal(0, 2e-3, places.shape)
    data = vsr.Measurements(INPUTS, vsr.Markers(places, X, offset=OFFSET))
    free = {"rod.material.young": (1e5, 1e6)}
    return vsr.fit(scene, free, data, model=MODEL, progress=False)


@pytest.mark.slow
def test_markers_are_joined_to_their_predictions(fit):
    ax = vsr.plot_fit.shapes(fit, axes="xz")
    plane, good = [0, 2], [0, 1, 3]
    seen = np.asarray(fit.problem.data.observations[0].value)
    eqs = [vsr.solve(fit.scene, INPUTS[i], model=MODEL).pose(jnp.array(X)) for i in good]
    drawn = [np.asarray(line.get_xydata()) for line in ax.lines]
    lines = [points for points in drawn if len(points) == 2]
    for k, (i, g) in enumerate(zip(good, eqs, strict=True)):
        predicted = g[:, :3, 3] + (g[:, :3, :3] @ jnp.array(OFFSET)[:, :, None])[..., 0]
        for j in (0, 1):
            ends = np.stack([seen[i, j], predicted[j]])[:, plane]
            np.testing.assert_allclose(lines[2 * k + j], ends, atol=1e-6)
    plt.close("all")


def test_a_failed_shape_is_said_to_be(fit):
    assert fit.failed == (CRUSHED,)
    ax = vsr.plot_fit.shapes(fit, axes="xz")
    legend = ax.get_legend()
    assert legend is not None
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts == ["fitted", "no equilibrium: 2", "measured", "predicted"]
    crosses = [line for line in ax.lines if line.get_marker() == "x"]
    seen = np.asarray(fit.problem.data.observations[0].value)[CRUSHED][:, [0, 2]]
    np.testing.assert_allclose(np.asarray(crosses[0].get_xydata())[:2], seen)
    # its arm is not drawn
    assert sum(len(np.asarray(line.get_xydata())) == 41 for line in ax.lines) == 3
    plt.close("all")


def test_residuals_have_the_unit_of_the_measurement(fit):
    ax = vsr.plot_fit.residuals(fit)
    assert ax.get_ylabel() == "residual [m]"
    plt.close("all")


def test_measured_rings_do_not_cover_their_predictions(fit):
    ax = vsr.plot_fit.shapes(fit, axes="xz")
    rings, points = (
        [line for line in ax.lines if line.get_marker() == "o" and line.get_fillstyle() == style]
        for style in ("none", "full")
    )
    seen = np.asarray(fit.problem.data.observations[0].value)[[0, 1, 3]].reshape(-1, 3)
    np.testing.assert_array_equal(rings[0].get_xydata(), seen[:, [0, 2]])
    assert points[0].get_markersize() < rings[0].get_markersize() / 2
    plt.close("all")


def test_the_overview_is_legible_and_full(fit):
    with vsr.plot.theme():
        figure = vsr.plot_fit.overview(fit)
    figure.canvas.draw()
    texts = [x for x in figure.findobj(mpl.text.Text) if x.get_visible() and x.get_text()]
    assert min(text.get_fontsize() for text in texts) >= 8
    assert [ax.get_xlabel() for ax in figure.axes] == ["x [m]", "x [m]", "", "(1)"]
    boxes = [ax.get_window_extent() for ax in figure.axes]
    inside = sum(box.width * box.height for box in boxes)
    assert inside > 0.65 * figure.bbox.width * figure.bbox.height
    (title,) = [text.get_text() for text in texts if "rod.material.young" in text.get_text()]
    number = fit.numbers["rod.material.young"]
    value, error = 1e-3 * number.value, 1e-3 * number.error
    assert title == f"(1) rod.material.young = {value:.4g} +- {error:.2g} [1e3 Pa]"
    assert not vsr.plot_fit.corner(fit, names=[]).axes
    plt.close("all")
