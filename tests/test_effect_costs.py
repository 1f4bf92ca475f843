"""Cost of each effect: the scenes compared, and timing."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vsr_jax as vsr
from vsr_jax.cli import main as cli
from vsr_jax.studies import effects
from vsr_jax.studies.timing import Timed, primitives, take_turns


def test_every_scene_adds_one_effect():
    scenes = effects.added_scenes()
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


def test_other_scenes_add_one_effect_to_the_scene_that_they_name():
    named = {one.name: one for one in effects.scenes()}
    assert len(named) == len(effects.scenes())
    added = []
    for one in effects.single_scenes():
        assert one.base is not None
        base = named[one.base]
        assert one.inputs == base.inputs
        added.append([x for x in one.scene.effects if x not in base.scene.effects])
        if one.followed and base.followed:  # friction is a number of the obstacle
            assert base.scene.obstacles[0].friction is None
            assert one.scene.replace("obstacles[0].friction", 0.1).obstacles[0].friction == 0.1
    assert added == [
        ["sections", "straight tendons"],
        ["rubber"],
        ["inclusions"],
        ["sections", "rigid pieces"],
        ["held section"],
        ["cylinder"],
        ["cylinder"],
        [],
        [],
    ]
    assert [one.followed for one in effects.single_scenes()] == [False] * 7 + [True] * 2


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

    costs = [cost("bare", 1000, 40.0), cost("+ load", 3000, 60.0), cost("held", 1500, 80.0)]
    lines = effects.table([*costs[:2], costs[2]._replace(base="bare")])
    assert lines[2] == "| bare | 1,000 | 2.0 | 40 (40-40) | 4 (4-4) | 100 % |"
    assert (
        lines[3]
        == "| + load | 3,000, x 3 | 2.0, x 1 | 60 (60-60), x 1.5 | 6 (6-6), x 1.5 | 100 % |"
    )
    assert (
        lines[4]
        == "| held (over bare) | 1,500, x 1.5 | 2.0, x 1 | 80 (80-80), x 2 | 8 (8-8), x 2 | 100 % |"
    )


def test_command_rejects_an_empty_batch(capsys):
    with pytest.raises(SystemExit) as refusal:
        cli.main(["effects", "--batch-size", "0"])
    assert refusal.value.code == cli.BAD_USAGE
    assert "--batch-size: got 0, need an integer >= 1" in capsys.readouterr().err


@pytest.mark.slow
def test_scenes_are_measured():
    """Of each kind one: strains alone, poses, loads, all effects, and a path of inputs."""
    named = {one.name: one for one in effects.scenes()}
    names = ["tendons only", "+ poses", "+ gravity", "+ spring", "+ friction of contact"]
    chosen = [named[name] for name in names]
    costs = effects.measure(batch_size=4, rounds=1, model=vsr.StrainDependent(4), compared=chosen)
    assert [cost.name for cost in costs] == names
    operations = [cost.operations or 0 for cost in costs]
    assert 0 < operations[1] < operations[2] < operations[3]
    assert all(cost.converged == 1 for cost in costs)


@pytest.mark.slow
@pytest.mark.parametrize(
    "one", [one for one in effects.scenes() if not one.followed], ids=lambda one: one.name
)
def test_every_scene_has_a_solution(one):
    def status(share):
        inputs = share * jnp.array(one.inputs)
        return vsr.solve(one.scene, inputs, model=vsr.StrainDependent(4)).status

    found = jax.jit(jax.vmap(status))(jnp.array([0.5, 0.8, 1.2, 1.5]))
    assert np.all(found == vsr.Status.CONVERGED)


@pytest.mark.slow
def test_obstacles_and_their_friction_add_to_the_program():
    """Equations, since operations count a pass along the arm in a loop as one of its steps."""
    model, named = vsr.StrainDependent(4), {one.name: one for one in effects.scenes()}

    def size(name):
        def tip(inputs):
            if named[name].followed:
                path = vsr.follow(named[name].scene, inputs[None], model=model)
                return jax.vmap(lambda eq: eq.tip)(path)
            return vsr.solve(named[name].scene, inputs, model=model).tip

        program = jax.make_jaxpr(tip)(jnp.array(named[name].inputs))
        return sum(primitives(program).values())

    assert size("pillar, not touched") > 1.25 * size("+ gravity")
    path = f"touched, path of {effects.SAMPLES}"
    assert size(path) > size("pillar, touched")
    assert size("+ friction of contact") > 1.05 * size(path)


@pytest.mark.slow
def test_the_arm_lies_on_one_pillar_and_not_on_the_other():
    """For the smallest and the largest inputs of a batch; friction acts along the path."""
    named = {one.name: one for one in effects.single_scenes()}

    def pressed(name, share):
        one = named[name]
        inputs = share * np.outer([0.5, 1.0], one.inputs)
        path = jax.jit(lambda u: vsr.follow(one.scene, u, model=vsr.StrainDependent(8)))(inputs)
        assert np.all(path.status == vsr.Status.CONVERGED)
        contacts = jax.vmap(lambda eq: eq.contacts)(path)
        return np.sum(contacts.force, (1, 2)), np.linalg.norm(np.sum(contacts.friction, (1, 2)))

    for share in (0.5, 1.5):
        np.testing.assert_allclose(pressed("pillar, not touched", share)[0], 0.0, atol=1e-9)
        smooth = pressed(f"touched, path of {effects.SAMPLES}", share)
        rough = pressed("+ friction of contact", share)
        assert np.all(smooth[0] > 0.1)
        assert smooth[1] == 0.0
        assert rough[1] > 0.01
