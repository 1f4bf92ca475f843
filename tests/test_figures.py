"""Figures look as they did: each is compared with a small image in `data/figures`, which
`python benchmarks/figures.py --out tests/data/figures --themes light --dpi 50` writes."""

import pathlib

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.testing.compare import compare_images

from benchmarks import figures
from vsr_jax.viz import plot

FOLDER = pathlib.Path(__file__).parent / "data" / "figures"
TOLERANCE = 3.0
"""Root mean square of the difference of two images, of 255. Other versions of matplotlib and of its
fonts differ by less, a figure without one of its tendons by more."""
SLOW = ("catheter", "thin_catheter", "design", "workspace_by_tension", "finger", "hexapod")


def difference(figure, name, folder):
    """Root mean square difference of a figure from the image that is kept."""
    path = folder / f"{name}.png"
    figure.savefig(path, dpi=50)
    plt.close(figure)
    found = compare_images(str(FOLDER / f"{name}.png"), str(path), 0.0, in_decorator=True)
    return 0.0 if found is None else found["rms"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=pytest.mark.slow if x in SLOW else ()) for x in figures.FIGURES],
)
def test_a_figure_is_as_it_was_and_nothing_is_cut_off(name, tmp_path):
    with plot.theme("light"):
        figure = figures.FIGURES[name]()
        assert difference(figure, name, tmp_path) < TOLERANCE
    pixels = plt.imread(tmp_path / f"{name}.png")[..., :3]
    for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]):
        np.testing.assert_array_equal(edge, 1.0)


@pytest.mark.slow
def test_a_missing_tendon_is_seen(tmp_path):
    with plot.theme("light"):
        complete = difference(figures.soft_arm(), "soft_arm", tmp_path)
        figure = figures.soft_arm()
        dashed = [line for line in figure.axes[0].lines if line.get_linestyle() == "--"]
        threads = [line for line in figure.axes[0].lines if line.get_linewidth() == 1.6]
        assert len(threads) == 2  # the chamber and the taut tendon; the third is slack
        assert dashed
        threads[1].remove()
        assert difference(figure, "soft_arm", tmp_path) > TOLERANCE > complete


def test_there_is_an_image_for_every_figure():
    assert {path.stem for path in FOLDER.glob("*.png")} == set(figures.FIGURES)


def test_themes_are_light_and_dark(unchecked):
    with plot.theme("dark"):
        figure = plt.figure()
        assert np.mean(mpl.colors.to_rgb(figure.get_facecolor())) < 0.2
        plt.close(figure)
    with pytest.raises(ValueError, match="theme: got 'blue', need one of 'light', 'dark'"):
        plot.theme("blue").__enter__()
