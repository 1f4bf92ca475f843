"""Cost of each effect: the scenes compared, and timing."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.cli import main as cli
from vsr_jax.studies import effects
from vsr_jax.studies.timing import Timed, take_turns


def test_every_scene_adds_one_effect():
    scenes = effects.scenes()
    added = [
        [name for name in b.scene.effects if name not in a.scene.effects]
        for a, b in itertools.pairwise(scenes)
    ]
    # a wrench between base and tip breaks the steps too: the second section adds no new effect, but
    # a break of its own
    assert added == [
        [],
        ["gravity"],
        ["tip wrench"],
        ["follower point wrench", "sections"],
        [],
        ["length control"],
        ["friction"],
        ["payload"],
        ["spring"],
    ]
    assert [len(one.scene.breakpoints) for one in scenes[4:6]] == [1, 3]
    assert [one.pose for one in scenes] == [False] + [True] * 9


def test_timed_measures_operations_and_times():
    job = Timed(lambda x: x @ x, jnp.ones((8, 8)), calls=2)
    np.testing.assert_array_equal(job.output, 8.0)
    assert job.operations is None or 900 <= job.operations <= 1100  # 2 * 8^3
    take_turns([job], 3)
    summary = job.summary()
    assert len(job.samples) == 6
    assert 0 < summary["low_us"] <= summary["median_us"] <= summary["high_us"]


def test_table_compares_each_row_with_the_one_above():
    def cost(name, operations, time):
        summary = {
            "compile_s": 2.0,
            "median_us": time,
            "low_us": time,
            "high_us": time,
            "cpu_us": time,
        }
        return effects.Cost(name, (), operations, summary, summary, 10, 1.0)

    lines = effects.table([cost("bare", 1000, 40.0), cost("+ load", 3000, 60.0)])
    assert lines[2] == "| bare | 1,000 | 2.0 | 40 (40-40) | 4 (4-4) | 100 % |"
    assert (
        lines[3]
        == "| + load | 3,000, x 3 | 2.0, x 1 | 60 (60-60), x 1.5 | 6 (6-6), x 1.5 | 100 % |"
    )


def test_command_rejects_an_empty_batch(capsys):
    with pytest.raises(SystemExit) as refusal:
        cli.main(["effects", "--batch-size", "0"])
    assert refusal.value.code == cli.BAD_USAGE
    assert "--batch-size: got 0, need an integer >= 1" in capsys.readouterr().err


@pytest.mark.slow
def test_all_scenes_are_measured():
    costs = effects.measure(batch_size=4, rounds=1, model=vsr.StrainDependent(4))
    assert all(cost.converged == 1 for cost in costs)
    operations = [cost.operations for cost in costs]
    assert operations[2] > operations[1]
    assert operations[-1] > operations[2]
