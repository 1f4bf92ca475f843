"""Fits from files: the command finds known numbers, and errors name the file and the place."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.calibration.fit_file import load_fit
from vsr_jax.cli import main as cli

SCENE = """
[[actuators]]
type = "Tendon"
routing = { type = "Linear", y = 0.006, z = 0.0, slope_y = -0.01 }

[rod]
length = 0.2
section = { type = "Circular", radius = 0.008 }
material = { young = 5e5, poisson = 0.4 }
"""
FIT = """
title = "A bent arm"
scene = "arm.toml"

[data]
file = "shapes.csv"
inputs = ["tension"]
series = "series"

[[observations]]
type = "Markers"
columns = ["x", "y", "z"]
scale = 0.001
X = [0.2]
sd = 1e-4

[free]
"rod.material.young" = [1e5, 1e6]
"base.position[*]" = { low = -0.01, high = 0.01, prior = [0.0, 0.005] }

[fit]
steps = 20
"""
YOUNG, SHIFT = 4e5, [0.0, 0.002, -0.001]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene, a fit, and the exact tip of an arm with another modulus and base."""
    place = tmp_path_factory.mktemp("fit")
    (place / "arm.toml").write_text(SCENE.replace("5e5", "4e5"))
    true = vsr.load(place / "arm.toml").scene
    (place / "arm.toml").write_text(SCENE)
    (place / "fit.toml").write_text(FIT)
    tensions = np.linspace(0.2, 2.0, 6)
    tips = jax.vmap(lambda u: vsr.solve(true, u[None]).tip[:3, 3])(jnp.asarray(tensions))
    lines = ["series,tension,x,y,z"]
    for i, (tension, tip) in enumerate(zip(tensions, np.asarray(tips), strict=True)):
        cells = [f"{1e3 * x:.9f}" for x in tip + (np.array(SHIFT) if i < 3 else 0)]
        cells[0] = "" if i == 5 else cells[0]
        lines.append(",".join(["A" if i < 3 else "B", f"{tension:.12f}", *cells]))
    (place / "shapes.csv").write_text("\n".join(lines) + "\n")
    return place


@pytest.mark.slow
def test_the_command_finds_the_numbers(folder, capsys):
    out, record, plot = folder / "found.toml", folder / "found.json", folder / "found.png"
    arguments = ["fit", str(folder / "fit.toml"), "--out", str(out), "--json", str(record)]
    assert cli.main([*arguments, "--plot", str(plot)]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("A bent arm\n")
    assert "rms residual of B" in printed
    scene = vsr.load(out).scene
    np.testing.assert_allclose(scene.rod.material.young.value, YOUNG, rtol=1e-3)
    np.testing.assert_allclose(scene.rod.base[:3, 3], SHIFT, atol=1e-5)
    numbers = json.loads(record.read_text())
    assert numbers["status"] == "converged"
    assert numbers["numbers"]["rod.material.young"]["unit"] == "Pa"
    assert plot.stat().st_size > 20_000


def test_an_empty_cell_is_missing(folder):
    data = load_fit(folder / "fit.toml").data
    assert np.isnan(data.observations[0].value[5, 0, 0])
    assert data.present.sum() == 17


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[data]", "[dat]", "unknown key 'dat'"),
        ('"x", "y"', '"x", "Y"', "observations[0].columns: shapes.csv has no column 'Y'"),
        ('"y", "z"]', '"y"]', "got 2 columns, need 3 for each row of a Markers"),
        ('type = "Markers"', 'type = "Marker"', "did you mean 'Markers'"),
        ("steps = 20", "step = 20", "fit: unknown key 'step'"),
        ("high = 0.01", "hih = 0.01", "did you mean 'high'"),
        ("shapes.csv", "shape.csv", "No such file"),
        ('series = "series"', 'series = "day"', "shapes.csv has no column 'day'"),
        ('inputs = ["tension"]', 'inputs = ["series"]', "got 'A' in line 2, column 'series'"),
    ],
)
def test_errors_name_the_place(folder, old, new, message):
    (folder / "bad.toml").write_text(FIT.replace(old, new, 1))
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        load_fit(folder / "bad.toml")
    assert str(caught.value).startswith(str(folder / "bad.toml"))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
