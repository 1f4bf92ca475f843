"""The site of docs/: all pages are in its navigation, all public names have an entry, numbers are
those of the records. `docs/build.py` checks the links when it builds the site."""

import ast
import json
import pathlib
import re
import tomllib

import pytest

import vsr_jax as vsr
from benchmarks import first_task

ROOT = pathlib.Path(__file__).parents[1]
DOCS = ROOT / "docs"
RESULTS = ROOT / "benchmarks" / "results"


def read(path):
    return path.read_text(encoding="utf-8")


def leaves(entries):
    """Pages of a navigation, in its order."""
    for entry in entries:
        values = entry.values() if isinstance(entry, dict) else [entry]
        for value in values:
            yield from [value] if isinstance(value, str) else leaves(value)


def test_every_page_is_in_the_navigation_once():
    listed = list(leaves(tomllib.loads(read(DOCS / "zensical.toml"))["project"]["nav"]))
    pages = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    pages |= {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert sorted(listed) == sorted(pages | {"index.md", "CONTRIBUTING.md", "CHANGELOG.md"})


def entries(page):
    return re.findall(r"^::: vsr_jax\.(\w+)$", read(page), flags=re.MULTILINE)


def test_every_public_name_has_one_entry_in_the_reference():
    named = [name for page in (DOCS / "api").glob("*.md") for name in entries(page)]
    assert sorted(named) == sorted(vsr.__all__)


def test_the_reference_has_the_concepts_of_the_list_of_names():
    concepts = re.split(r"^## (.+)\n", read(DOCS / "api.md"), flags=re.MULTILINE)[1:]
    listed = {
        heading: re.findall(r"^\| `(\w+)` \|", text, flags=re.MULTILINE)
        for heading, text in zip(concepts[::2], concepts[1::2], strict=True)
    }
    pages = (DOCS / "api").glob("*.md")
    assert {
        read(page).splitlines()[0].removeprefix("# "): entries(page) for page in pages
    } == listed


def test_members_of_modules_that_the_reference_names_exist():
    for page in (DOCS / "api").glob("*.md"):
        found = re.findall(
            r"^::: vsr_jax\.(\w+)\n.*\n +members: \[(.*)\]", read(page), re.MULTILINE
        )
        for module, members in found:
            missing = [x for x in members.split(", ") if not hasattr(getattr(vsr, module), x)]
            assert missing == []


# -------------------------------------------------------------------------------------------------
# Numbers


def two_digits(value):
    return f"{value:.1e}".replace("e-0", "e-")


def test_the_errors_of_the_papers_cases_are_those_of_the_record():
    rows = json.loads(read(RESULTS / "paper" / "table.json"))["rows"]
    text = read(DOCS / "validation.md")

    def largest(model, key, cases="ABC"):
        chosen = [row for row in rows if row["model"] == model and row["case"][0] in cases]
        return max(chosen, key=lambda row: row[key])

    for model in ("StrainDependent", "Continuum"):
        tip, strain = (largest(model, key) for key in ("tip_error_mm", "strain_error"))
        assert (
            f"| {two_digits(tip['tip_error_mm'])} mm ({tip['case']}) "
            f"| {two_digits(strain['strain_error'])} |" in text
        )
    for model, cases, digits in (("Prescribed", "AB", 1), ("Prescribed", "C", 0), ("PCS", "A", 0)):
        tip, strain = (largest(model, key, cases) for key in ("tip_error_mm", "strain_error"))
        percent = f"{tip['tip_error_percent']:.2g} % of L"
        assert f"| {tip['tip_error_mm']:.{digits}f} mm" in text
        assert percent in text
        assert f"| {strain['strain_error']:.2g}" in text


def test_the_distances_of_other_tools_are_those_of_the_record():
    case = json.loads(read(RESULTS / "bench_peers_B1_2cores.json"))["scenes"]["B1"]
    theirs = min(row["tip_error_max"] for row in case["rows"] if row["tool"] == "SoRoMoX")
    scipy = min(row["tip_error"] for row in case["slow"] if row["tool"].startswith("SciPy"))
    assert f"{two_digits(theirs)} m and {two_digits(scipy)} m" in read(DOCS / "validation.md")


def test_the_distances_to_sorosim_are_those_of_the_record():
    rows = json.loads(read(RESULTS / "sorosim_statics.json"))
    for name in ("steel", "tpu"):
        texts = [f"{1e3 * x:.2f}" for key, x in rows[name].items() if key.endswith("[m]")]
        assert "| {} | {} | {}, {} |".format(*texts) in read(DOCS / "validation.md")


def test_the_errors_of_the_measured_tentacle_are_those_of_the_record():
    models = json.loads(read(RESULTS / "measured_tentacle.json"))["models"]
    text = " ".join(read(DOCS / "validation.md").split())
    fitted, held_out = (
        max(models["calibrated"][key]) for key in ("rms on A [mm]", "rms on B, held out [mm]")
    )
    assert f"{fitted:.2f} mm on the eight holds of series A" in text
    assert f"{held_out:.2f} mm on the eight of series B" in text
    assert f"{fitted / 3.6:.1f} and {held_out / 3.6:.1f} % of the arm's 360 mm" in text


@pytest.fixture(scope="module")
def record():
    return json.loads(read(first_task.RECORD))


def test_the_first_task_is_the_record(record):
    assert f"<!-- table -->\n{first_task.table(record)}<!-- table -->\n" in read(first_task.PAGE)


def test_the_first_task_was_recorded_with_the_present_programs(record):
    for tool, program in first_task.PROGRAMS.items():
        path = first_task.FOLDER / program
        ast.parse(read(path))
        assert record["runs"][tool]["lines"] == first_task.lines(path)
        assert tuple(first_task.lines(path)) == first_task.PARTS


def test_the_first_task_is_done_by_both_within_a_micrometre(record):
    assert record["reference off Continuum [m]"] < 1e-8
    for run in record["runs"].values():
        assert run["tip error [m]"] < 1e-6
        assert run["workspace"] == 10_000
        assert run["gradient error"] < 1e-3
