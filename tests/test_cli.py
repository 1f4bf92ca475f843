"""The command: the paper's table and figures for one case, and errors in one line."""

import json

import pytest

import vsr_jax
from vsr_jax import cli


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


def test_version(capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["--version"])
    assert exit_.value.code == 0
    assert capsys.readouterr().out.strip() == f"vsr-jax {vsr_jax.__version__}"
