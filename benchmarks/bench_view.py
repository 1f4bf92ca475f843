"""Answer time of the live view: from a slider's move to the update that is handed to the browser,
after compiling.

    pip install ".[viewer]" && python benchmarks/bench_view.py [--moves 200] [--json FILE]

A bare arm (case B1 of the paper) and a loaded one (three tendons, gravity and a tip force), each
with a slider for Young's modulus; every second move changes the modulus, the others a tension. An
answer is the solve, the stability margin, strain and stress at the wall, the meshes and the
messages in viser's queue. Then the tip is dragged on a circle within reach. Messages from and to
the browser and its drawing are not included.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import vsr_jax as vsr
from vsr_jax.studies import paper
from vsr_jax.studies.timing import machine

YOUNG = "rod.material.young"


def bare() -> tuple[vsr.Scene, list[float]]:
    return paper.scene("B1"), [-5.0]


def loaded() -> tuple[vsr.Scene, list[float]]:
    rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(8e5, poisson=0.45, density=1000.0))
    angles = 2 * np.pi / 3 * np.arange(3)
    paths = [vsr.Parallel(0.007 * np.cos(a), 0.007 * np.sin(a)) for a in angles]
    loads = [vsr.Gravity(), vsr.TipWrench(force=(0.0, 0.0, -0.1))]
    return vsr.Scene(rod, [vsr.Tendon(path) for path in paths], loads), [4.0, 2.0, 1.0]


def spread(seconds: list[float]) -> dict[str, float]:
    """Median, and the 10 and 90 % quantiles [ms]."""
    low, middle, high = np.quantile(1e3 * np.array(seconds), (0.1, 0.5, 0.9))
    return {"median_ms": float(middle), "p10_ms": float(low), "p90_ms": float(high)}


def timed(answers: list[Any]) -> list[float]:
    """Times from handing over each move to its answer."""
    times = []
    for answer in answers:
        start = time.perf_counter()
        answer().wait()
        times.append(time.perf_counter() - start)
    return times


def measure(scene: vsr.Scene, inputs: list[float], moves: int) -> dict[str, Any]:
    """Times of one arm."""
    start = time.perf_counter()
    with vsr.view(scene, inputs, numbers=[YOUNG], browser=False, block=False) as page:
        session = page.session
        page.move({}).wait()
        first = time.perf_counter() - start
        modulus = {x.name: session.value(x) for x in session.sliders}[YOUNG]
        factors = 1 + 0.2 * np.sin(0.3 * np.arange(moves))
        slides = [
            {YOUNG: modulus * x} if i % 2 else {"inputs[0]": inputs[0] * x}
            for i, x in enumerate(factors.tolist())
        ]
        slid = timed([lambda values=values: page.move(values) for values in slides])
        failed = session.answer.failure
        page.move({YOUNG: modulus, "inputs[0]": inputs[0]}).wait()
        shape = session.answer.shape
        assert failed is None
        assert shape is not None
        steps = 2e-3 * np.sin(0.3 * np.arange(moves // 4 + 1))[:, None] * across(page)
        start = time.perf_counter()
        page.drag(shape.tip + steps[0]).wait()
        compiled = time.perf_counter() - start
        targets = shape.tip + steps[1:]
        dragged = timed([lambda target=target: page.drag(target) for target in targets])
        return {
            "sliders": spread(slid),
            "drag": spread(dragged),
            "drags out of reach": bool(session.answer.note),
            "first shape and compiling [s]": first,
            "compiling the drag [s]": compiled,
        }


def across(page: vsr.View) -> np.ndarray:
    """Direction in which the first input moves the tip."""
    before = page.session.answer.shape
    slider = page.session.sliders[0]
    value = page.session.value(slider)
    page.move({slider.name: 1.01 * value}).wait()
    after = page.session.answer.shape
    page.move({slider.name: value}).wait()
    assert before is not None
    assert after is not None
    return (after.tip - before.tip) / np.linalg.norm(after.tip - before.tip)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--moves", type=int, default=200)
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    results = {}
    for name, (scene, inputs) in {"bare": bare(), "loaded": loaded()}.items():
        results[name] = measure(scene, inputs, options.moves)
        print(f"{name}: {results[name]}", flush=True)
    if options.json:
        Path(options.json).write_text(
            json.dumps(
                {
                    "machine": machine(),
                    "jax": jax.__version__,
                    "moves": options.moves,
                    "arms": results,
                },
                indent=1,
            )
            + "\n"
        )


if __name__ == "__main__":
    main()
