"""The command: a scene file solved, the paper's table and figures for one case, and errors in one
line."""

import contextlib
import io
import json
import pathlib
import re
import subprocess
import sys
import warnings
from typing import NamedTuple

import numpy as np
import pytest

import vsr_jax
from vsr_jax.cli import common as cli_common, main as cli, scene_commands as cli_scene
from vsr_jax.files.scene_file import parse_scene
from vsr_jax.studies import paper

HELIX = str(pathlib.Path(__file__).parents[1] / "notebooks" / "scenes" / "helix.toml")


class Run(NamedTuple):
    """Exit code, what was printed, and the folder of a run of the command."""

    code: int
    out: str
    err: str
    folder: pathlib.Path

    @property
    def arm(self):
        return json.loads((self.folder / "arm.json").read_text())


def solve_helix(folder, tau) -> Run:
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("always", vsr_jax.UnitWarning)
        code = cli.main(
            [
                "solve",
                HELIX,
                "--inputs",
                tau,
                "--json",
                str(folder / "arm.json"),
                "--plot",
                str(folder / "arm.png"),
            ]
        )
    return Run(code, out.getvalue(), err.getvalue(), folder)


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """The paper's helix under 15 N."""
    return solve_helix(tmp_path_factory.mktemp("solved"), "-15")


@pytest.fixture(scope="module")
def collapsed(tmp_path_factory):
    """The paper's helix under more than it can carry."""
    return solve_helix(tmp_path_factory.mktemp("collapsed"), "-5e3")


def test_solve_saves_the_papers_helix(solved):
    assert solved.code == cli_common.DONE
    arm, expected = solved.arm, paper.reference("B1")[0]
    assert expected.tau == -15.0
    assert (arm["status"], arm["converged"], arm["precision"], arm["inputs"]) == (
        "converged",
        True,
        "float64",
        [-15.0],
    )
    assert (arm["title"], arm["model"]) == (
        "One helical thread (case B1 of the paper)",
        "StrainDependent",
    )
    np.testing.assert_allclose(arm["tip"], expected.tip, atol=1e-5)
    np.testing.assert_allclose(arm["X"], np.linspace(0.0, 0.75, 41))
    np.testing.assert_allclose(np.array(arm["position"])[::2], expected.position, atol=1e-5)
    np.testing.assert_allclose(np.array(arm["strain"])[::2], expected.strain, atol=1e-12)
    np.testing.assert_allclose(arm["stability"], expected.stability, rtol=1e-9)
    assert arm["force"] == [-15.0]
    assert 0.6 < arm["length"][0] < 0.75
    assert (solved.folder / "arm.png").stat().st_size > 10_000


def test_solve_prints_the_result_in_words(solved):
    assert solved.err == ""
    title, status, effects, tip, *axes, stability, head, thread = solved.out.splitlines()
    assert title == "One helical thread (case B1 of the paper)"
    assert status.startswith("  status     converged (StrainDependent, float64, ")
    assert effects == "  effects    threads"
    numbers = re.fullmatch(r"  tip        \((.*), (.*), (.*)\) m", tip).groups()
    np.testing.assert_allclose(
        [float(x) for x in numbers], paper.reference("B1")[0].tip[:3, 3], atol=1e-5
    )
    assert [axis[:13] for axis in axes] == ["  its x axis ", "  its y axis ", "  its z axis "]
    assert stability.startswith("  stability  ")
    assert head.split() == ["actuator", "input", "force", "[N]", "length", "[m]"]
    assert thread.split()[:5] == ["0", "Thread", "-15", "N", "-15"]


def test_a_solve_that_fails_says_why(collapsed):
    assert collapsed.code == cli_common.NOT_CONVERGED
    assert re.search(r"status +collapsed: ", collapsed.out)
    doubted, drawn = collapsed.err.splitlines()
    assert drawn.endswith("arm.png: the solve failed, so it shows the arm at rest")
    assert doubted.startswith("vsr-jax: warning: inputs[0]: -5000 N would strain a section by ")
    assert (collapsed.folder / "arm.png").stat().st_size > 10_000
    assert collapsed.arm["converged"] is False
    assert collapsed.arm["status"].startswith("collapsed")
    assert collapsed.arm["tip"] is collapsed.arm["strain"] is collapsed.arm["stability"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.toml"], "vsr-jax: nowhere.toml: No such file or directory"),
        (
            [HELIX, "--inputs", "1", "2"],
            r"vsr-jax: inputs: got shape \(2,\), need \(1,\), one number each for Thread",
        ),
        (
            [HELIX, "--inputs", "nan"],
            r"vsr-jax: inputs\[0\]: got nan, need a finite number \[N\] for a Thread",
        ),
        (
            [HELIX, "--json", "no/such/arm.json"],
            "vsr-jax: no/such/arm.json: there is no folder 'no/such'",
        ),
    ],
    ids=["file", "number of inputs", "nan", "folder"],
)
def test_bad_usage_is_one_line_and_exit_code_2(arguments, message, capsys):
    assert cli.main(["solve", *arguments]) == cli_common.BAD_USAGE
    out, err = capsys.readouterr()
    assert re.match(message, err)
    assert err.count("\n") == 1
    assert out == ""


def test_a_file_without_inputs_asks_for_them(tmp_path, capsys):
    path = tmp_path / "arm.toml"
    path.write_text(re.sub("inputs = .*", "", pathlib.Path(HELIX).read_text()))
    assert cli.main(["solve", str(path)]) == cli_common.BAD_USAGE
    assert (
        "arm.toml: has no inputs, need --inputs, one number each for Thread"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    "option", [["--model", "exact"], ["--precision", "float16"], ["--inputs", "many"]]
)
def test_arguments_that_cannot_be_read_exit_with_2(option, capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["solve", HELIX, *option])
    assert exit_.value.code == cli_common.BAD_USAGE
    assert option[0] in capsys.readouterr().err


def test_every_model_has_a_name(helix):
    kinds = [type(cli_scene._model(name, None, helix)).__name__ for name in cli_scene.MODELS]
    assert kinds == ["StrainDependent", "Prescribed", "Continuum"]
    assert cli_scene._model(None, None, helix) is None


def test_help_shows_a_scene_file_that_loads(capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["solve", "--help"])
    assert exit_.value.code == 0
    text = capsys.readouterr().out
    scene = text[text.index("a scene file:") + len("a scene file:") : text.index("exit codes")]
    assert len(parse_scene(scene).scene.actuators) == 2


@pytest.mark.slow
def test_paper_writes_table_and_figures(tmp_path, capsys):
    assert cli.main(["paper", "--cases", "A1", "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "table.json").read_text())["rows"]
    assert {row["model"] for row in rows} == {"Continuum", "StrainDependent", "Prescribed"}
    assert len(rows) == 12
    assert all(row["tip_error_mm"] < 1e-6 for row in rows)
    assert [row["dofs"] for row in rows if row["model"] == "Prescribed"] == [2] * 4
    table = (tmp_path / "table.md").read_text()
    assert table.count("| A1 |") == 12
    assert "CPU cores" in table
    for name in ("fig2.png", "fig2.pdf"):
        assert (tmp_path / name).stat().st_size > 10_000
    assert "StrainDependent: tip error at most" in capsys.readouterr().out


def test_a_wrong_case_is_one_line_and_exit_code_2(tmp_path, capsys):
    assert cli.main(["paper", "--cases", "Z9", "--out", str(tmp_path / "new")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("vsr-jax: cases: got 'Z9', need one of")
    assert error.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_the_help_lists_the_commands_without_importing_jax():
    """With JAX it would take a second."""
    code = (
        "import sys; from vsr_jax.cli import main\n"
        "try: main.main(['--help'])\n"
        "except SystemExit: print([m for m in ('jax', 'equinox') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    for name, command in cli.COMMANDS.items():
        assert re.search(rf"^    {name} +{re.escape(command.help)}$", done.stdout, re.MULTILINE)
        assert f"\n  {command.example}\n" in done.stdout


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_has_a_help(name, capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main([name, "--help"])
    assert exit_.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: vsr-jax {name} ")
    assert "example:" in text


def test_version(capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["--version"])
    assert exit_.value.code == 0
    assert capsys.readouterr().out.strip() == f"vsr-jax {vsr_jax.__version__}"


@pytest.mark.slow
def test_sweep_keeps_and_draws_a_workspace(tmp_path, capsys):
    arguments = [
        "sweep",
        HELIX,
        "--samples",
        "50",
        "--low",
        "-15",
        "--high",
        "-1",
        "--steps",
        "8",
        "--outputs",
        "lengths",
    ]
    assert (
        cli.main([*arguments, "--out", str(tmp_path / "w.zarr"), "--plot", str(tmp_path / "w.png")])
        == cli_common.DONE
    )
    out = capsys.readouterr().out
    assert "inputs      -15 to -1\nsamples     50 converged\ntip x" in out
    assert (tmp_path / "w.png").stat().st_size > 10_000
    kept = pytest.importorskip("zarr").open_group(tmp_path / "w.zarr", mode="r")
    shapes = {"inputs": (50, 1), "tip": (50, 4, 4), "lengths": (50, 1), "status": (50,)}
    assert {name: kept[name].shape for name in shapes} == shapes
    (tmp_path / "w.zarr" / "status" / "c" / "0").unlink()
    assert cli.main([*arguments, "--out", str(tmp_path / "w.zarr")]) == cli_common.DONE
    said = capsys.readouterr().err.splitlines()[0]
    assert said.startswith(
        f"vsr-jax: sweep.out: {tmp_path / 'w.zarr'} has missing or damaged chunks"
    )
    assert said.endswith(": status[0:50]")


@pytest.mark.slow
def test_matplotlib_is_imported_only_to_draw():
    code = (
        "import sys; from vsr_jax.cli import main; "
        f"main.main(['solve', {HELIX!r}, '--steps', '4']); print('matplotlib' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False"


def test_a_sweep_to_disk_without_zarr_is_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    assert (
        cli.main(["sweep", HELIX, "--low", "-5", "--out", str(tmp_path / "w.zarr")])
        == cli_common.BAD_USAGE
    )
    assert (
        capsys.readouterr().err
        == 'vsr-jax: sweep.out: Zarr is not installed, need pip install "vsr-jax[sweep]"\n'
    )


@pytest.mark.slow
def test_a_sweep_without_a_solution_exits_with_1(capsys):
    assert (
        cli.main(
            ["sweep", HELIX, "--samples", "3", "--low", "-9e3", "--high", "-5e3", "--steps", "8"]
        )
        == cli_common.NOT_CONVERGED
    )
    assert "samples     3 collapsed\n" in capsys.readouterr().out


def test_the_default_bounds_of_negative_forces_end_at_zero(capsys):
    arguments = ["sweep", HELIX, "--samples", "3", "--steps", "8"]
    assert cli.main(arguments) == cli_common.DONE
    assert "inputs      -5 to 0\nsamples     3 converged\n" in capsys.readouterr().out
    threads = [vsr_jax.Thread(vsr_jax.Parallel(y, 0.0)) for y in (-0.001, 0.0, 0.001)]
    rod = vsr_jax.Rod(0.2, vsr_jax.Circular(0.004), vsr_jax.Material(1e6, poisson=0.4))
    scene = vsr_jax.Scene(rod, threads)
    low, high = cli_common.bounds(None, None, scene, np.array([-2.0, 0.0, 3.0]))
    assert (low.tolist(), high.tolist()) == ([-2.0, 0.0, 0.0], [0.0, 0.0, 3.0])
    scene = vsr_jax.Scene(rod, threads[:1], driven=vsr_jax.Input("rod.length", low=0.1))
    low, high = cli_common.bounds([-1.0], None, scene, np.array([-2.0, 0.3]))
    assert (low.tolist(), high.tolist()) == ([-1.0, -1.0], [0.0, 0.3])
    scene = vsr_jax.Scene(rod, driven=vsr_jax.Input("rod.length", low=0.1, high=0.3))
    low, high = cli_common.bounds(None, None, scene, np.array([0.25]))
    assert (low.tolist(), high.tolist()) == ([0.1], [0.3])


def test_bounds_of_a_sweep_are_in_order(capsys):
    assert cli.main(["sweep", HELIX, "--low", "1", "--high", "-1"]) == cli_common.BAD_USAGE
    assert capsys.readouterr().err == "vsr-jax: --low: got 1, need at most --high, -1\n"


def test_bounds_of_a_sweep_are_one_or_one_an_actuator(capsys):
    assert cli.main(["sweep", HELIX, "--low", "1", "2"]) == cli_common.BAD_USAGE
    assert (
        "--low: got 2 numbers, need one for all inputs or 1, one for each"
        in capsys.readouterr().err
    )


@pytest.mark.slow
def test_a_tolerance_chooses_the_steps_and_tells_the_error(capsys):
    assert cli.main(["solve", HELIX, "--tolerance", "1e-4"]) == cli_common.DONE
    error = re.search(
        r"  error      (\S+) m of the tip from a finer solve, with "
        r"StrainDependent\(steps=(\d+), order=6\)",
        capsys.readouterr().out,
    )
    assert error
    assert 1e-6 < float(error[1]) < 1e-4
    assert int(error[2]) < 32


def test_a_tolerance_goes_without_steps(capsys):
    assert cli.main(["solve", HELIX, "--tolerance", "1e-4", "--steps", "8"]) == cli_common.BAD_USAGE
    assert (
        "--tolerance: got --model or --steps too, need one or the other" in capsys.readouterr().err
    )
