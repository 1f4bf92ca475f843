"""Pictures: what is drawn is the solution, at equal scale, on the axes given or on new ones."""

import matplotlib as mpl
import numpy as np
import pytest

mpl.use("Agg")

import matplotlib.pyplot as plt

import vsr_jax as vsr
from vsr_jax.arm.rod import STRAINS
from vsr_jax.studies import paper
from vsr_jax.viz import plot


@pytest.fixture(scope="module")
def eq():
    return vsr.solve(paper.scene("B1"), [-15.0])


def test_arm_draws_axis_and_threads_at_equal_scale(eq):
    ax = plot.arm(eq, stations=31, label="B1")
    lines = [np.array(line.get_data_3d()).T for line in ax.lines]
    X = np.linspace(0, 0.75, 31)
    assert any(
        line.shape == (31, 3) and np.allclose(line, eq.position(X), atol=1e-9) for line in lines
    )
    assert any(
        line.shape == (31, 3) and np.allclose(line, eq.thread(0, X), atol=1e-9) for line in lines
    )
    spans = [np.ptp(limit()) for limit in (ax.get_xlim3d, ax.get_ylim3d, ax.get_zlim3d)]
    np.testing.assert_allclose(
        spans / np.array(ax.get_box_aspect()) * ax.get_box_aspect()[0], spans[0], rtol=1e-6
    )
    plt.close(ax.figure)


def test_strains_draws_the_named_ones_on_given_axes(eq):
    figure, axes = plt.subplots(2)
    plot.strains(eq, axes, names=STRAINS[:2], stations=31)
    for i, ax in enumerate(axes):
        x, y = ax.lines[0].get_data()
        np.testing.assert_allclose(y, eq.strain(x)[:, i], atol=1e-12)
    plt.close(figure)


def test_stations_beyond_the_arm_are_refused(eq):
    for draw in (
        plot.sample,
        lambda eq, stations: plot.arm(eq, stations=stations),
        lambda eq, stations: plot.strains(eq, stations=stations),
    ):
        with pytest.raises(
            ValueError, match=r"stations: got 0\.8 m, need 0 to 0\.75 m, the ends of the arm"
        ):
            draw(eq, [0.1, 0.8])


def test_a_failed_solve_is_not_drawn():
    failed = vsr.solve(paper.scene("A1"), [-500.0])
    with pytest.raises(ValueError, match="collapsed"):
        plot.arm(failed)


def test_a_workspace_shows_every_finite_tip_once():
    tips = np.random.default_rng(0).normal(size=(90, 3))
    tips[::3] = np.nan
    axes = plot.workspace(tips, values=np.arange(90), label="number")
    np.testing.assert_array_equal(
        axes[2].collections[0].get_offsets(), tips[np.isfinite(tips[:, 0])][:, [0, 2]]
    )
    assert len(plot.workspace(tips, most=20)[1].collections[0].get_offsets()) == 20
    with pytest.raises(ValueError, match=r"positions: got shape \(90, 2\), need \(samples, 3\)"):
        plot.workspace(tips[:, :2])
    plt.close("all")


@pytest.mark.parametrize(
    ("section", "point"),
    [
        (vsr.Circular(0.01), (0.01, 0.0)),
        (vsr.Annular(0.01, 0.005), (0.01, 0.0)),
        (vsr.Rectangular(0.02, 0.01), (0.01, 0.0)),
        (vsr.Elliptic(0.02, 0.01), (0.02, 0.0)),
    ],
)
def test_outlines_lie_on_the_wall(section, point):
    import jax.numpy as jnp

    X, L = jnp.asarray(0.1), jnp.asarray(1.0)
    np.testing.assert_allclose(section.outline(jnp.asarray(0.0), X, L), point, atol=1e-15)
    for angle in np.linspace(0, 2 * np.pi, 9):
        assert abs(section.clearance(*section.outline(jnp.asarray(angle), X, L), X, L)) < 1e-12
