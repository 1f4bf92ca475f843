"""Design by gradient: hidden routings identified from the shapes they produce, and the cost of a
descent step.

    pip install . && python benchmarks/bench_design.py [--starts 10] [--arms 5] [--json FILE]

The radii, angles and phases of two helical threads are hidden; ten points of the arm's axis are
known for each of five sets of tensions. For each random start the result is the largest distance of
the threads found from the hidden ones. All starts run as a batch in one call of `vsr.design`; the
time of the first arm includes compilation, that of the others does not. The time of one step is
compared with that of its solves alone, both timed in turn.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.optimization.descent import adam, begin, descend, penalty_weight
from vsr_jax.optimization.problem import formulate
from vsr_jax.studies.timing import Timed, machine, take_turns

MODEL = vsr.StrainDependent(12)
LENGTH, STEPS, TRIED, WITHIN = 0.75, 400, 64, 1e-4
TENSIONS = np.array([[9.0, 1.0], [1.0, 9.0], [6.0, 6.0], [12.0, 3.0], [3.0, 12.0]])
FREE = {
    "actuators[*].routing.radius": (0.002, 0.009),
    "actuators[*].routing.angle": (1.45, 1.565),
    "actuators[*].routing.phase": None,
}


def arm(helices: Any) -> vsr.Scene:
    """An arm with helical threads of given radius, angle and phase."""
    rod = vsr.Rod(LENGTH, vsr.Circular(vsr.Taper(0.012, 0.010)), vsr.Material(5.93e5, shear=2.0e5))
    return vsr.Scene(
        rod, [vsr.Tendon(vsr.Helix(radius, angle, phase=phase)) for radius, angle, phase in helices]
    )


def unknowing() -> vsr.Scene:
    return arm([(0.005, 1.5, 0.0)] * 2)


def hidden(seed: int) -> vsr.Scene:
    return arm(
        np.random.default_rng(seed).uniform((0.004, 1.49, -np.pi), (0.008, 1.55, np.pi), (2, 3))
    )


def shapes(scene: vsr.Scene) -> vsr.objective.CurveError:
    """The objective that is zero for the shapes of a scene."""
    X = jnp.asarray(LENGTH * np.arange(1, 11) / 10)
    return vsr.objective.CurveError(
        jax.vmap(lambda u: vsr.solve(scene, u, model=MODEL).position(X))(jnp.asarray(TENSIONS)),
        X,
        local=True,
    )


def paths(scene: vsr.Scene) -> np.ndarray:
    """Positions of the threads in the sections [m], shape (threads, stations, 2)."""
    X = jnp.linspace(0, LENGTH, 101)
    return np.asarray(
        [jnp.stack(jax.vmap(actuator.routing)(X), axis=-1) for actuator in scene.actuators]
    )


def found(seed: int, starts: int) -> dict[str, Any]:
    """Largest distance of the threads found from those of a hidden arm, for each random start; the
    start at the given scene is left out."""
    secret = hidden(seed)
    wanted = shapes(secret)
    start = time.perf_counter()
    result = vsr.design(
        unknowing(),
        FREE,
        wanted,
        TENSIONS,
        model=MODEL,
        search=vsr.Search(starts=starts + 1, steps=STEPS, candidates=TRIED, seed=seed),
        progress=False,
    )
    seconds = time.perf_counter() - start
    off = [
        float(np.max(np.linalg.norm(paths(one.scene) - paths(secret), axis=-1)))
        for one in result.starts[1:]
    ]
    return {
        "arm": seed,
        "seconds": seconds,
        "found": sum(x <= WITHIN for x in off),
        "of": starts,
        "off": off,
    }


def step_cost(starts: int, rounds: int) -> dict[str, Any]:
    """Times [us] of a step of all starts, and of its evaluation of the objective alone."""
    problem, _, given = formulate(unknowing(), FREE, shapes(hidden(0)), TENSIONS, (), {}, MODEL)
    optimizer = adam(0.05, STEPS)
    states = begin(problem, optimizer, given, starts, 4, 0)
    penalty = penalty_weight(0, STEPS)
    step = Timed(lambda states: descend(problem, optimizer, states, penalty), states)
    alone = Timed(lambda z: jax.vmap(lambda z: problem.loss(z, penalty)[0])(z), states.z)
    take_turns([step, alone], rounds)
    ratio = step.summary()["median_us"] / alone.summary()["median_us"]
    return {
        "starts": starts,
        "step / solves": ratio,
        "step": step.summary(),
        "solves": alone.summary(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--arms", type=int, default=5, help="hidden arms (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    arms = [found(seed, options.starts) for seed in range(options.arms)]
    for one in arms:
        print(
            f"arm {one['arm']}: {one['found']} of {one['of']} starts within {WITHIN:g} m, "
            f"{one['seconds']:.1f} s"
        )
    costs = [step_cost(starts, options.rounds) for starts in (1, options.starts)]
    for cost in costs:
        print(
            f"{cost['starts']} starts: a step takes {cost['step / solves']:.2f} times its solves "
            f"({cost['step']['median_us']:.0f} us)"
        )
    if options.json:
        record = {"machine": machine(), "jax": jax.__version__, "arms": arms, "steps": costs}
        Path(options.json).write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
