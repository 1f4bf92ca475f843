"""The study of accuracy against time: its errors against the reference solutions and finite
differences of finer solves."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.cli import common as cli_common, main as cli, study_commands as cli_studies
from vsr_jax.solution.step_choice import gradient_error
from vsr_jax.studies import accuracy, accuracy_figures, paper

WAYS = [accuracy.Setting("steps of order 6", "8", vsr.StrainDependent(8))]
INPUTS = jnp.array([[-15.0], [-5.0]])


@pytest.fixture(scope="module")
def rows():
    (row,) = accuracy.measure(paper.scene("B1"), INPUTS, WAYS, rounds=2)
    return [row, row._replace(dtype="float32", strain=1e-7)]


@pytest.mark.slow
def test_tip_error_against_the_independent_reference(rows):
    entries = {float(entry.tau[0]): entry for entry in paper.reference("B1")}
    true = [
        np.linalg.norm(
            np.asarray(vsr.solve(paper.scene("B1"), u, model=vsr.StrainDependent(8)).tip)[:3, 3]
            - entries[float(u[0])].tip[:3, 3]
        )
        for u in INPUTS
        if float(u[0]) in entries
    ]
    assert true
    assert rows[0].tip == pytest.approx(max(true), rel=1e-3)


@pytest.mark.slow
def test_strain_is_exact_to_rounding(rows):
    assert rows[0].strain < 1e-13


@pytest.mark.slow
def test_gradient_error_against_central_differences_at_ten_times_the_steps(rows):
    scene, inputs = paper.scene("B1"), INPUTS[0]
    numbers, rest = eqx.partition((scene, inputs), eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(numbers)
    values = jnp.concatenate([leaf.reshape(-1) for leaf in leaves])
    ends = np.cumsum([leaf.size for leaf in leaves])[:-1]

    def tip(values, steps):
        parts = [
            part.reshape(leaf.shape)
            for part, leaf in zip(jnp.split(values, ends), leaves, strict=True)
        ]
        scene, inputs = eqx.combine(jax.tree.unflatten(tree, parts), rest)
        return vsr.solve(scene, inputs, model=vsr.StrainDependent(steps)).tip[:3, 3]

    size = 1e-4 * jnp.where(values == 0, 1.0, jnp.abs(values))
    fine = jax.jit(jax.vmap(lambda values: tip(values, 80)))
    f = {k: fine(values + k * jnp.diag(size)) for k in (-2, -1, 1, 2)}
    true = ((f[-2] - 8 * f[-1] + 8 * f[1] - f[2]) / (12 * size[:, None])).T
    found = jax.jit(jax.jacrev(lambda values: tip(values, 8)))(values)
    assert float(gradient_error(found, true, values)) == pytest.approx(rows[0].gradient, rel=0.02)


@pytest.mark.slow
def test_advice_and_table(rows):
    text = accuracy.advice(rows)
    assert text[0].startswith("for 1 mm use steps of order 6, 8")
    assert text[1] == "for 1 um: no measured setting is accurate enough"
    assert len(accuracy.table(rows)) == 4
    assert accuracy.cheapest(rows, 1e-9) is None


@pytest.mark.slow
def test_figure(rows):
    figure = accuracy_figures.work_precision(
        {"B1": rows}, others={"B1": {"another": ([10.0], [1e-3])}}
    )
    assert figure.axes[0].get_title() == "B1"
    assert len(figure.axes[0].lines) == 3
    with pytest.raises(ValueError, match="error: got 'shape', need one of"):
        accuracy_figures.work_precision({"B1": rows}, error="shape")


def test_settings_span_the_models():
    found = accuracy.settings(paper.scene("B1"), own=paper.basis("B1"))
    assert {type(way.model) for way in found} == {
        vsr.StrainDependent,
        vsr.Prescribed,
        vsr.Continuum,
    }
    assert cli_studies._GROUPS == accuracy.GROUPS


@pytest.mark.slow
def test_the_command(tmp_path, capsys, monkeypatch, rows):
    def measure(scene, inputs, settings, report):
        assert inputs.shape == (2, 2)
        assert {way.family for way in settings} == {
            "steps of order 2",
            "steps of order 4",
            "steps of order 6",
        }
        return rows

    monkeypatch.setattr(accuracy, "measure", measure)
    out = tmp_path / "rows.json"
    arguments = [
        "accuracy",
        "--inputs",
        "-5",
        "-5",
        "--batch-size",
        "2",
        "--groups",
        "steps",
        "--json",
        str(out),
        "--plot",
        str(tmp_path / "a.png"),
    ]
    assert cli.main(arguments) == cli_common.DONE
    assert "for 1 mm use steps of order 6, 8" in capsys.readouterr().out
    assert json.loads(out.read_text())["B2, two helices"][0]["lost"] == 0
    assert (tmp_path / "a.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_command_reads_a_scene_file(tmp_path, capsys, monkeypatch, rows):
    def measure(scene, inputs, settings, report):
        assert [type(actuator) for actuator in scene.actuators] == [vsr.Tendon]
        assert np.all((inputs > 0.1 * 2.5) & (inputs < 2.5))
        return rows

    monkeypatch.setattr(accuracy, "measure", measure)
    path, out = tmp_path / "arm.toml", tmp_path / "rows.json"
    rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(1e6, poisson=0.45))
    vsr.save(vsr.Scene(rod, [vsr.Tendon(vsr.Parallel(0.0, 0.008))]), path, [2.5], "An arm")
    arguments = ["accuracy", str(path), "--batch-size", "3", "--groups", "steps"]
    assert cli.main([*arguments, "--json", str(out)]) == cli_common.DONE
    assert "for 1 mm use steps of order 6, 8" in capsys.readouterr().out
    assert list(json.loads(out.read_text())) == ["An arm"]
