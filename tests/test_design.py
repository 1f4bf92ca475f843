"""Design by gradient: hidden routings are found, constraints hold by independent code, an
interrupted design resumes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import vsr_jax as vsr
from vsr_jax.analysis.constraint import (
    BendRadius,
    Inside,
    MaxTension,
    MinSpacing,
    StabilityMargin,
)
from vsr_jax.optimization import checkpoint
from vsr_jax.optimization.descent import History
from vsr_jax.optimization.objective import (
    Arms,
    CurveError,
    Measure,
    Tension,
    TipCompliance,
    TipError,
    Workspace,
)
from vsr_jax.optimization.problem import formulate

MODEL = vsr.StrainDependent(6)
LENGTH = 0.3
SETS = [[3.0, 1.0], [0.5, 2.0], [2.0, 2.5], [1.0, 0.5]]
FREE = {
    "actuators[*].routing.radius": (0.002, 0.009),
    "actuators[*].routing.angle": (1.4, 1.56),
    "actuators[*].routing.phase": None,
}


def arm(radius=0.005, angle=1.5, phases=(0.3, 2.0)):
    rod = vsr.Rod(LENGTH, vsr.Circular(vsr.Taper(0.011, 0.010)), vsr.Material(8e5, poisson=0.45))
    return vsr.Scene(rod, [vsr.Tendon(vsr.Helix(radius, angle, phase=phase)) for phase in phases])


@pytest.fixture(scope="module")
def scene():
    return arm()


@pytest.fixture(scope="module")
def tips():
    return jax.vmap(lambda u: vsr.solve(arm(0.006, 1.47, (0.8, 1.4)), u, model=MODEL).tip)(
        jnp.array(SETS)
    )


OBJECTIVES = {
    "places": lambda tips: TipError(tips[:, :3, 3]),
    "poses": TipError,
    "curve": lambda tips: CurveError(
        0.9 * tips[:, None, :3, 3] * jnp.linspace(0.3, 1, 4)[:, None], local=True
    ),
    "workspace": lambda tips: Workspace(2),
    "compliance": lambda tips: TipCompliance(direction=(0.0, 1.0, 1.0)),
    "tension": lambda tips: Tension(4.0),
    "several": lambda tips: (
        TipError(tips)
        + 0.1 * Tension(4.0)
        + Measure(lambda arms: jnp.mean(arms.each(lambda eq: eq.tip[0, 3])))
    ),
}


@pytest.mark.slow
def test_a_thread_leaves_the_axis():
    """On the axis the distance to it has no derivative; the gradient of Inside was NaN."""
    start = vsr.Scene(arm().rod, [vsr.Tendon(vsr.Parallel(0.0, 0.0))])
    aim = vsr.solve(
        vsr.Scene(arm().rod, [vsr.Tendon(vsr.Parallel(0.003, 0.002))]), [2.0], model=MODEL
    ).tip[:3, 3]
    free = {f"actuators[0].routing.{axis}": (-0.008, 0.008) for axis in "yz"}
    search = vsr.Search(starts=1, steps=60, candidates=1)
    found = vsr.design(
        start,
        free,
        TipError(aim[None]),
        [[2.0]],
        constraints=[Inside(0.0005)],
        model=MODEL,
        search=search,
        progress=False,
    )
    routing = found.scene.actuators[0].routing
    np.testing.assert_allclose([routing.y, routing.z], [0.003, 0.002], atol=5e-4)
    assert np.all(np.isfinite(found.history.objective))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in ("compliance", "several")))
        for name in OBJECTIVES
    ],
)
def test_gradients_of_objectives_against_differences(scene, tips, name):
    """With respect to radius, angle and all inputs."""
    free = {"actuators[*].routing.radius": (0.002, 0.009), "inputs": (0.1, 5.0)}
    _, terms, given = formulate(scene, free, OBJECTIVES[name](tips), SETS, (), {}, MODEL)
    found = jax.jit(jax.value_and_grad(lambda free: terms(free)[0]))
    slope = found(given)[1]
    for key, place in (("actuators[0].routing.radius", ()), ("inputs", (1, 0)), ("inputs", (2, 1))):
        step = 1e-4 * float(given[key][place])
        ahead, behind = (
            float(found(given | {key: given[key].at[place].add(d)})[0]) for d in (step, -step)
        )
        scale = max(
            abs(float(x))
            for x in jax.tree.leaves(jax.tree.map(lambda x: jnp.max(jnp.abs(x)), slope))
        )
        assert float(slope[key][place]) == pytest.approx(
            (ahead - behind) / (2 * step), rel=2e-6, abs=1e-9 * scale
        )


@pytest.mark.slow
def test_values_of_objectives(scene, tips):
    arms = formulate(scene, FREE, Tension(1.0), SETS, (), {}, MODEL)[1].arms({}, {})
    own = np.array([vsr.solve(scene, jnp.array(u), model=MODEL).tip[:3, 3] for u in SETS])
    wanted = np.asarray(tips[:, :3, 3])
    assert float(TipError(wanted)(arms)) == pytest.approx(
        np.mean(np.sum((own - wanted) ** 2, axis=1)) / LENGTH**2
    )
    assert float(CurveError(wanted[:, None], [LENGTH])(arms)) == pytest.approx(
        np.mean(np.sum((own - wanted) ** 2, axis=1)) / LENGTH**2
    )
    spread = np.linalg.eigvalsh(np.cov(own.T / LENGTH, bias=True))
    assert float(Workspace()(arms)) == pytest.approx(-0.5 * np.mean(np.log(spread)))
    assert float(Tension(2.0)(arms)) == pytest.approx(np.mean(np.array(SETS) ** 2) / 4)
    assert float((3 * TipError(wanted))(arms)) == pytest.approx(3 * float(TipError(wanted)(arms)))


@pytest.mark.slow
def test_margins_of_constraints_against_independent_code(scene):
    arms = formulate(scene, FREE, Tension(1.0), SETS, (), {}, MODEL)[1].arms({}, {})
    phases = 0.3, 2.0
    assert float(jnp.min(MinSpacing(0.004)(arms))) == pytest.approx(
        (2 * 0.005 * np.sin((phases[1] - phases[0]) / 2)) ** 2 / 0.004**2 - 1
    )
    assert float(jnp.min(Inside(0.001)(arms))) == pytest.approx((0.010 - 0.005 - 0.001) / 0.010)
    assert float(jnp.min(MaxTension(6.0)(arms))) == pytest.approx(0.5)
    bent = [
        vsr.solve(scene, jnp.array(u), model=MODEL).strain(jnp.linspace(0, LENGTH, 65))[:, 1:3]
        for u in SETS
    ]
    assert float(jnp.min(BendRadius(0.02)(arms))) == pytest.approx(
        1 - 0.02**2 * np.max(np.sum(np.square(bent), axis=-1))
    )
    assert float(jnp.min(StabilityMargin(0.5)(arms))) == pytest.approx(
        0.5
    )  # it is 1 under tendon tension alone


@pytest.fixture(scope="module")
def found(scene):
    X = LENGTH * jnp.arange(1, 7) / 6
    points = jax.vmap(
        lambda u: vsr.solve(arm(0.006, 1.47, (0.8, 1.4)), u, model=MODEL).position(X)
    )(jnp.array(SETS))
    wanted = CurveError(points, X, local=True)
    return vsr.design(
        scene,
        FREE,
        wanted,
        SETS,
        constraints=[Inside(0.0005)],
        model=MODEL,
        search=vsr.Search(starts=4, steps=600, candidates=8),
        progress=False,
    )


def test_a_hidden_routing_is_found(found):
    assert found.feasible
    assert found.objective < 1e-12
    for thread, phase in zip(found.scene.actuators, (0.8, 1.4), strict=True):
        assert float(thread.routing.radius) == pytest.approx(0.006, abs=1e-6)
        assert float(thread.routing.angle) == pytest.approx(1.47, abs=1e-4)
        assert np.cos(float(thread.routing.phase) - phase) == pytest.approx(1, abs=1e-8)
    assert found.history.objective.shape == (600, 4)
    assert len(found.starts) == 4
    assert found.objective == min(start.objective for start in found.starts if start.violation <= 0)


def test_a_design_survives_a_scene_file(found, tips):
    from vsr_jax.files.scene_file import parse_scene, to_toml

    again = parse_scene(to_toml(found.scene, found.inputs[0])).scene
    np.testing.assert_allclose(
        vsr.solve(again, found.inputs[0], model=MODEL).tip, tips[0], atol=1e-6
    )


@pytest.mark.slow
def test_constraints_hold_where_they_bind():
    """The optimum lies at the wall and at the largest tension; both constraints hold there."""
    scene = vsr.Scene(arm().rod, [vsr.Tendon(vsr.Parallel(0.003, 0.0))])
    free = {"actuators[0].routing.y": (0.0, 0.02), "inputs": (0.1, 9.0)}
    high = Measure(lambda arms: -jnp.mean(arms.each(lambda eq: eq.tip[1, 3])) / LENGTH)
    kept = [Inside(0.002), MaxTension(1.5)]
    found = vsr.design(
        scene,
        free,
        high,
        [[1.0]],
        constraints=kept,
        model=MODEL,
        search=vsr.Search(starts=2, steps=200, candidates=4),
        progress=False,
    )
    assert found.feasible
    assert set(found.margins) == {"Inside(wall=0.002)", "MaxTension(force=1.5)"}
    assert all(0 <= margin < 5e-3 for margin in found.margins.values())
    y, T = float(found.scene.actuators[0].routing.y), float(found.inputs[0, 0])
    assert 0.99 * 0.008 < y <= 0.008  # radius at the tip minus the wall
    assert 0.99 * 1.5 < T <= 1.5


@pytest.mark.slow
def test_an_uncertain_design_is_the_mean_over_its_draws(scene, tips):
    uncertain = {"rod.material.young": 0.1}
    _, terms, given = formulate(scene, FREE, TipError(tips), SETS, (), uncertain, MODEL)
    one = formulate(scene, FREE, TipError(tips), SETS, (), {}, MODEL)[1]
    factors = np.asarray(terms.factors["rod.material.young"])
    assert factors.shape == (8,)
    np.testing.assert_allclose(np.prod(factors), 1, rtol=1e-12)  # each draw with its opposite
    alone = [
        float(one.objective(one.arms(given, {"rod.material.young": jnp.array(f)}))) for f in factors
    ]
    assert float(terms(given)[0]) == pytest.approx(np.mean(alone))


@pytest.mark.slow
def test_an_interrupted_design_resumes_bit_identically(scene, tips, tmp_path, monkeypatch):
    search = {"starts": 2, "steps": 60, "candidates": 2}

    def run(out=None, **changes):
        return vsr.design(
            scene,
            FREE,
            TipError(tips),
            SETS,
            model=MODEL,
            search=vsr.Search(**search | changes),
            out=out,
            progress=False,
        )

    whole = run()
    out, write = tmp_path / "design.eqx", checkpoint.Checkpoint.write

    def dies(self, states, history):
        write(self, states, history)
        if len(history.objective) >= 50:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint.Checkpoint, "write", dies)
        with pytest.raises(KeyboardInterrupt):
            run(out)
    resumed = run(out)
    np.testing.assert_array_equal(resumed.history.objective, whole.history.objective)
    assert resumed.objective == whole.objective
    for other in ({"learning_rate": 0.01}, {"optimizer": optax.sgd(0.1)}):
        with pytest.raises(ValueError, match="belongs to another computation"):
            run(out, **other)


@pytest.mark.slow
def test_it_stops_at_a_given_objective(scene, tips):
    search = vsr.Search(starts=2, steps=60, candidates=2, stop_at=10.0)
    found = vsr.design(
        scene, FREE, TipError(tips), SETS, model=MODEL, search=search, progress=False
    )
    assert len(found.history.objective) == 25


def test_it_stops_when_the_objective_stagnates():
    falls = np.concatenate([np.linspace(2, 1, 50), np.full(50, 1.0)])[:, None]
    feasible, violated = History(falls, 0 * falls), History(falls, 0 * falls + 1)
    assert vsr.Search(patience=30).finished(feasible)
    assert not vsr.Search(patience=60).finished(feasible)
    assert not vsr.Search(patience=30).finished(violated)
    assert vsr.Search(stop_at=1.0).finished(feasible)
    assert not vsr.Search(stop_at=1.0).finished(violated)
    assert vsr.Search(steps=100).finished(violated)
    assert not vsr.Search(steps=101).finished(violated)
    none = np.zeros((0, 1))
    assert not vsr.Search(stop_at=1.0).finished(History(none, none))


@pytest.mark.slow
def test_another_optimiser_and_single_precision(scene, tips):
    found = vsr.design(
        scene,
        FREE,
        TipError(tips.astype(jnp.float32)),
        np.float32(SETS),
        model=MODEL,
        search=vsr.Search(starts=1, steps=30, candidates=1, optimizer=optax.sgd(0.5)),
        progress=False,
    )
    assert found.inputs.dtype == found.scene.rod.length.dtype == jnp.float32
    assert found.objective < found.history.objective[0, 0]


@pytest.mark.slow
def test_starts_without_equilibrium_are_recorded_as_nan(scene):
    """The arm collapses in half of the range of tensions."""
    low = Measure(lambda arms: jnp.mean(arms.each(lambda eq: eq.tip[0, 3])) / LENGTH)
    search = vsr.Search(starts=3, steps=30, candidates=4)
    settings = {"model": MODEL, "search": search, "progress": False}
    found = vsr.design(scene, {"inputs": (0.0, 300.0)}, low, SETS, **settings)
    assert found.feasible
    assert np.isnan(found.history.objective).any()
    with pytest.raises(ValueError, match="no start found an equilibrium"):
        vsr.design(scene, {"inputs": (1e6, 2e6)}, low, [[1e6, 1e6]], **settings)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"free": {}}, "free: got {}, need at least one number"),
        ({"free": {"actuators[0].routing.radius": (0.005, 0.002)}}, "need the least value first"),
        ({"free": {"actuators[0].routing.radius": 0.005}}, "need a pair"),
        ({"free": {"actuators[7].routing.radius": (0.1, 0.2)}}, "the scene has no such number"),
        ({"free": {"inputs": ([1.0, 2.0, 3.0], 4.0)}}, r"need one number or \(4, 2\)"),
        ({"free": {"inputs": (-1.0, 2.0)}}, r"inputs\[0\]: got -1"),
        ({"objective": None}, "objective: got None, need an Objective"),
        ({"objective": TipError(np.zeros((3, 3)))}, "got 3 of them for 4 sets of inputs"),
        (
            {"objective": 2.0 * CurveError(np.zeros((1, 3)), [9.0]) + Tension(1.0)},
            "CurveError.X: got 9 m, need 0 to .* m, the ends of the arm",
        ),
        ({"objective": Workspace(), "inputs": SETS[:2]}, "need more than 3"),
        ({"inputs": [1.0, 2.0]}, r"inputs: got shape \(2,\), need \(sets, 2\)"),
        ({"constraints": [3]}, r"constraints\[0\]: got 3, need a Constraint"),
        ({"uncertain": {"rod.length": -1.0}}, "need a finite number > 0"),
        ({"uncertain": {"inputs": 0.1}}, "uncertain: got 'inputs', need numbers of the scene"),
        ({"search": 3}, "search: got 3, need a Search"),
        ({"out": "nowhere/at/all"}, "need a file in an existing folder"),
    ],
)
def test_errors_name_the_value_and_the_requirement(unchecked, scene, change, message):
    arguments = {
        "free": FREE,
        "objective": Tension(1.0),
        "inputs": SETS,
        "model": MODEL,
        "progress": False,
    } | change
    with pytest.raises(ValueError, match=message):
        vsr.design(scene, **arguments)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TipError(np.zeros(3)), "TipError.targets: got shape"),
        (lambda: CurveError(np.zeros((4, 2))), "CurveError.points: got shape"),
        (lambda: CurveError(np.zeros((4, 3)), [0.1, 0.2]), "CurveError.X"),
        (
            lambda: CurveError(np.zeros((1, 3)), [-0.1]),
            r"CurveError.X: got \[-0.1\], need finite numbers of shape \(1,\) >= 0",
        ),
        (
            lambda: CurveError(np.zeros((1, 3)), [0.0], local=True),
            r"CurveError.X: got \[0.0\], need finite numbers of shape \(1,\) > 0",
        ),
        (lambda: Workspace(4), "need 1, 2 or 3"),
        (lambda: TipCompliance((0.0, 0.0, 0.0)), "need a nonzero vector"),
        (lambda: Inside(-0.1), "Inside.wall"),
        (lambda: Tension(1.0) + 3, "another objective to add"),
        (lambda: vsr.Search(starts=0), "Search.starts: got 0, need an integer >= 1"),
        (lambda: vsr.Search(learning_rate=-1.0), "Search.learning_rate: got -1.0, need a finite"),
        (lambda: vsr.Search(seed=-1), "Search.seed: got -1, need an integer >= 0"),
        (lambda: vsr.Search(stop_at=np.nan), "Search.stop_at: got nan, need a finite number"),
        (lambda: vsr.Search(patience=0), "Search.patience: got 0, need an integer >= 1"),
    ],
)
def test_invalid_settings_are_rejected(unchecked, make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_design_prints_its_numbers_with_units(found):
    text = str(found)
    assert text == repr(found)
    assert text.startswith("objective  ")
    assert "after 600 steps of 4 starts" in text
    assert "actuators[0].routing.angle = 1.47 [rad]" in text
    assert "Inside(wall=0.0005): satisfied, margin 0." in text
    assert "inputs" not in text
    shapes = []
    eqx.filter_eval_shape(
        lambda scene: shapes.append(str(found._replace(scene=scene))), found.scene
    )
    assert "routing.angle = " in shapes[0]


def test_arms_have_one_equilibrium_per_set(scene):
    arms = formulate(scene, FREE, Tension(1.0), SETS, (), {}, MODEL)[1].arms({}, {})
    assert isinstance(arms, Arms)
    assert arms.each(lambda eq: eq.tip).shape == (4, 4, 4)
