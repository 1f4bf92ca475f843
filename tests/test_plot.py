"""Pictures: what is drawn is the solution, at equal scale, on the axes given or on new ones."""

import matplotlib as mpl
import numpy as np
import pytest

mpl.use("Agg")

import matplotlib.pyplot as plt
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import vsr_jax as vsr
from vsr_jax.arm.rod import STRAINS
from vsr_jax.studies import paper
from vsr_jax.viz import annotate, plot
from vsr_jax.viz.body import body_of
from vsr_jax.viz.style import TENSION, ink
from vsr_jax.viz.tendons import tension_scale


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


def test_a_failed_solve_shows_the_arm_at_rest_and_says_why():
    failed = vsr.solve(paper.scene("A1"), [-500.0])
    ax = plot.arm(failed, color="red", stations=5)
    (text,) = ax.get_legend().get_texts()
    assert "at rest; no equilibrium: collapsed:" in " ".join(text.get_text().split())
    axis = ax.lines[-1]
    assert (axis.get_linestyle(), mpl.colors.to_rgb(axis.get_color())) == ("--", ink(0.45))
    rest = np.stack([np.linspace(0, 0.75, 5), np.zeros(5), np.zeros(5)])
    np.testing.assert_allclose(axis.get_data_3d(), rest, atol=1e-12)
    for draw in (plot.sample, plot.strains, annotate.loads):
        with pytest.raises(ValueError, match=r"eq: got a solve that failed \(collapsed"):
            draw(failed)
    plt.close("all")


@pytest.mark.slow
def test_tensions_have_signed_colours_and_slack_tendons_are_dashed():
    scene = vsr.Scene(
        vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(8e5, poisson=0.45)),
        [
            vsr.Tendon(vsr.Parallel(0.005, 0.0)),
            vsr.Tendon(vsr.Parallel(0.0, 0.005)),
            vsr.Thread(vsr.Parallel(0.0, -0.005)),
        ],
    )
    ax = plot.arm(vsr.solve(scene, [2.0, 0.0, 1.0]))
    pulled, slack, pushing, axis = ax.lines
    assert mpl.colors.same_color(pulled.get_color(), TENSION(1.0))
    assert mpl.colors.same_color(pushing.get_color(), TENSION(0.25))  # half the greatest, pushing
    assert mpl.colors.same_color(slack.get_color(), TENSION(0.5))
    assert [line.get_linestyle() for line in ax.lines] == ["-", "--", "-", "-"]
    assert axis.get_linewidth() < pulled.get_linewidth()
    bars = [other for other in ax.figure.axes if other is not ax]
    assert [bar.get_ylabel() for bar in bars] == ["thread tension [N]"]
    assert bars[0].get_ylim() == (-2.0, 2.0)
    assert "slack tendon" in [text.get_text() for text in ax.get_legend().get_texts()]
    plt.close("all")


def test_chambers_have_the_colour_of_their_pressure_on_a_bar_of_their_own():
    at = vsr.Parallel(0.0, 0.005)
    wide, narrow = (vsr.Chamber(at, area=area) for area in (2e-5, 1e-5))
    rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(8e5, poisson=0.45))
    scene = vsr.Scene(rod, [wide, vsr.Tendon(at), narrow])
    ax = plot.arm(vsr.solve(scene, [2e4, 2.0, 5e4]))
    low, pulled, high, _ = ax.lines
    assert mpl.colors.same_color(high.get_color(), TENSION(0.0))
    assert mpl.colors.same_color(low.get_color(), TENSION.reversed()(0.7))
    assert mpl.colors.same_color(pulled.get_color(), TENSION(1.0))
    bars = {x.get_ylabel(): x.get_ylim() for x in ax.figure.axes if x is not ax}
    assert bars == {"thread tension [N]": (0, 2), "chamber pressure [kPa]": (0, 50)}
    plt.close("all")


@pytest.mark.parametrize(
    ("tensions", "ends"),
    [([[1.0, 3.0], [2.0]], (0, 3)), ([[-2.0], [1.0]], (-2, 2)), ([[-1.0]], (-1, 0)), ([], (0, 0))],
)
def test_the_colour_bar_shows_the_signs_there_are(tensions, ends):
    scale = tension_scale([np.array(some) for some in tensions])
    assert (scale.low, scale.high) == ends
    assert scale.norm(0.0) == 0.5


@pytest.mark.slow
def test_rigid_pieces_have_a_wall_of_their_own():
    pieces = [vsr.RigidPiece(0.101, 0.122), vsr.RigidPiece(0.25)]
    rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(6e5, poisson=0.4), rigid=pieces)
    eq = vsr.solve(vsr.Scene(rod, vsr.Tendon(vsr.Parallel(0.006, 0.0))), [2.0])
    body = body_of(eq, 31)
    ends = [(body.samples.X[part][[0, -1]], rigid) for part, rigid in body.parts]
    np.testing.assert_allclose(
        [pair for pair, _ in ends], [(0, 0.101), (0.101, 0.122), (0.122, 0.25), (0.25, 0.3)]
    )
    assert [rigid for _, rigid in ends] == [False, True, False, True]
    walls = [x for x in plot.arm(eq, stations=31).collections if isinstance(x, Poly3DCollection)]
    alphas = [wall.get_alpha() for wall in walls if wall.get_alpha() is not None]
    assert len(alphas) == 4
    assert min(alphas[1], alphas[3]) > max(alphas[0], alphas[2])
    plt.close("all")


@pytest.mark.slow
def test_discs_are_drawn_where_they_are():
    discs = vsr.Discs(places=[0.05, 0.11, 0.2], radius=0.01)
    rod = vsr.Rod(0.3, vsr.Circular(1e-3), vsr.Material(2e9, poisson=0.3), discs=discs)
    tendon = vsr.Tendon(vsr.Parallel(0.008, 0.0), straight=True)
    eq = vsr.solve(vsr.Scene(rod, tendon), [0.1])
    middle = body_of(eq).discs[:, :-1].mean(axis=1)
    np.testing.assert_allclose(middle, eq.position([0.05, 0.11, 0.2]), atol=1e-6)


@pytest.mark.slow
def test_discs_are_drawn_and_a_thin_arm_is_widened():
    thread = [vsr.Tendon(vsr.Parallel(0.0005, 0.0))]
    for guide, widened in ((None, True), (0.01, False)):
        rod = vsr.Rod(
            0.3,
            vsr.Circular(0.001),
            vsr.Material(2e9, poisson=0.3),
            discs=vsr.Discs(10, radius=guide),
        )
        eq = vsr.solve(vsr.Scene(rod, thread), [0.1])
        body = body_of(eq)
        assert len(body.discs) == (0 if guide is None else 10)
        assert (body.widening > 1) == widened
        for disc in body.discs:
            np.testing.assert_allclose(np.linalg.norm(disc - disc[:-1].mean(axis=0), axis=1), 0.01)
        wide = body.widened(3.0)
        np.testing.assert_allclose(
            wide.samples.threads[0] - wide.samples.position,
            3 * (body.samples.threads[0] - body.samples.position),
            atol=1e-15,
        )
        ax = plot.arm(eq)
        legend = [] if ax.get_legend() is None else ax.get_legend().get_texts()
        assert any("times as wide" in text.get_text() for text in legend) == widened
    plt.close("all")


@pytest.mark.slow
def test_labels_do_not_lie_on_ticks(eq):
    """Also of a box that is much longer than wide."""
    for arm in (eq, vsr.solve(vsr.Scene(eq.scene.rod), [])):
        ax = plot.arm(arm)
        ax.figure.canvas.draw()
        for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
            label = axis.label.get_window_extent()
            ticks = [tick.label1 for tick in axis.get_major_ticks() if tick.label1.get_text()]
            assert ticks
            assert not any(label.overlaps(tick.get_window_extent()) for tick in ticks)
    plt.close("all")


def test_a_workspace_shows_every_finite_tip_once():
    tips = np.random.default_rng(0).normal(size=(90, 3))
    tips[::3] = np.nan
    axes = plot.workspace(tips, values=np.arange(90), label="number", most=1000)
    np.testing.assert_array_equal(
        axes[2].collections[0].get_offsets(), tips[np.isfinite(tips[:, 0])][:, [0, 2]]
    )
    assert len(plot.workspace(tips, most=20)[0].collections[0].get_offsets()) == 20
    for panel in plot.workspace(tips, most=20)[1:]:  # the density is that of all points
        assert np.sum(panel.collections[0].get_array()) == 60
        (low, high), (left, right) = panel.get_ylim(), panel.get_xlim()
        shown = panel.collections[0].get_datalim(panel.transData)
        assert left <= shown.x0 < shown.x1 <= right
        assert low <= shown.y0 < shown.y1 <= high
    with pytest.raises(ValueError, match="positions: got no finite row"):
        plot.workspace(np.full((3, 3), np.nan))
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
