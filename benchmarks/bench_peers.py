"""vsr_jax and other tools on the same scenes, in one process: an arm with a parallel thread, one
with a helical thread, and the latter with loads.

    pip install ".[bench]" && python benchmarks/bench_peers.py [--scenes A1 B1 loaded] [--slow]
        [--json FILE] [--plot FILE]

1,024 tensions drawn uniformly from [-15, 0] N (the sign of the paper: negative pulls), float64,
each shape solved independently from a cold start. Tip errors are distances to vsr_jax at 96 steps
of order 6, which is itself compared with an independent solution of the loaded scene. "gradient" is
the derivative of the tip's height, summed over the batch, with respect to the radius, angle and
phase of the thread. All functions are compiled first and then timed in rounds, one after another,
so that other load on the machine affects both tools alike.

SoRoMoX has no static solver; `peer_soromox` describes how it is used. `--slow` adds single solves
at -5 N by SciPy's `solve_bvp` (`peer_scipy`) and by PyElastica's dynamics (`peer_elastica`, arms
without loads). `--formulations` times the formulations tried with SoRoMoX on the loaded scene.
"""

import argparse
import importlib.metadata
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from peer_scenes import CASES, Case, our_scene

import vsr_jax as vsr
from vsr_jax.studies.timing import Timed, machine, take_turns

BATCH = 1024
SINGLES = 5
TRUTH = (96, 6)
COLOURS = {"vsr_jax": "#0072B2", "SoRoMoX": "#D55E00", "SoRoMoX, Newton": "#E69F00"}


def our_tips(model: vsr.StrainDependent, scene: vsr.Scene, taus: jax.Array) -> jax.Array:
    """Tips [m] at all tensions by vsr_jax."""
    return jax.vmap(lambda tau: vsr.solve(scene, tau, model=model).tip[:3, 3])(taus)


def our_jobs(case: Case, steps: int, order: int, taus: jax.Array) -> tuple[str, dict[str, Timed]]:
    """Name and compiled functions of one resolution of vsr_jax."""
    scene, model = our_scene(case.numbers), vsr.StrainDependent(steps, order)
    tips = partial(our_tips, model)

    def single(scene: vsr.Scene, tau: jax.Array) -> jax.Array:
        return vsr.solve(scene, tau, model=model).tip[:3, 3]

    def height(actuators: Any, scene: vsr.Scene, taus: jax.Array) -> jax.Array:
        return jnp.sum(tips(eqx.tree_at(lambda s: s.actuators, scene, actuators), taus)[:, 2])

    return f"{steps} steps of order {order}", {
        "single": Timed(single, scene, taus[0], calls=SINGLES),
        "batch": Timed(tips, scene, taus),
        "gradient": Timed(jax.grad(height), scene.actuators, scene, taus),
    }


def their_jobs(
    peer: Any, case: Case, setting: tuple, taus: jax.Array
) -> tuple[str, dict[str, Timed]]:
    """Name and compiled functions of one setting of SoRoMoX."""
    chosen = peer.Setting(*setting)
    arm, path = peer.build(chosen, case.numbers)
    solve = peer.UNLOADED[chosen.way]

    def single(arm: Any, path: Any, tau: jax.Array) -> jax.Array:
        return peer.tip(arm, solve(arm, path, tau, chosen.tolerance))

    def tips(arm: Any, path: Any, taus: jax.Array) -> jax.Array:
        return jax.vmap(partial(single, arm, path))(taus)

    def gradient(arm: Any, path: Any, taus: jax.Array) -> Any:
        each = jax.vmap(lambda tau: peer.height_gradient(arm, path, tau, chosen.tolerance, solve))(
            taus
        )
        return jax.tree.map(lambda leaf: jnp.sum(leaf, 0), each)

    return str(chosen), {
        "single": Timed(single, arm, path, taus[0], calls=SINGLES),
        "batch": Timed(tips, arm, path, taus),
        "gradient": Timed(gradient, arm, path, taus),
    }


def errors(tips: Any, truth: np.ndarray) -> dict[str, Any]:
    """Largest and median distance to the reference [m] over the finite results, and the number of
    the others."""
    distance = np.linalg.norm(np.asarray(tips) - truth, axis=1)
    found = distance[np.isfinite(distance)]
    worst, median = (
        (float(np.max(found)), float(np.median(found))) if len(found) else (np.inf, np.inf)
    )
    return {
        "tip_error_max": worst,
        "tip_error_median": median,
        "lost": int(len(distance) - len(found)),
    }


def measure(
    jobs: list[tuple[str, str, dict[str, Timed]]], truth: np.ndarray, rounds: int
) -> list[dict[str, Any]]:
    """Rows of the table: all jobs timed in turn, round after round."""
    take_turns((job for _, _, row in jobs for job in row.values()), rounds)
    rows = []
    for tool, name, row in jobs:
        entry: dict[str, Any] = {
            "tool": tool,
            "setting": name,
            **errors(row["batch"].output, truth),
        }
        entry |= {kind: job.summary() for kind, job in row.items()}
        entry["gradient_by_helix"] = [
            float(np.ravel(leaf)[0]) for leaf in jax.tree.leaves(row["gradient"].output)
        ]
        rows.append(entry)
    return rows


def rate(entry: dict[str, float]) -> str:
    """Shapes per second, with their spread, as text."""
    return "{:.0f} ({:.0f}-{:.0f})".format(
        *(1e6 * BATCH / entry[key] for key in ("median_us", "high_us", "low_us"))
    )


def print_rows(rows: list[dict[str, Any]]) -> None:
    """Table of all settings."""
    print(
        "| tool | setting | tip error max [m] | median | lost | single [us] | shapes/s, 1,024 | "
        "gradients/s | compile [s] |"
    )
    print("|" + "---|" * 9)
    for row in rows:
        single = "{median_us:.0f} ({low_us:.0f}-{high_us:.0f})".format(**row["single"])
        compiles = " / ".join(
            f"{row[kind]['compile_s']:.1f}" for kind in ("single", "batch", "gradient")
        )
        cells = [
            row["tool"],
            row["setting"],
            f"{row['tip_error_max']:.1e}",
            f"{row['tip_error_median']:.1e}",
            str(row["lost"]),
        ]
        print(
            f"| {' | '.join(cells)} | {single} | {rate(row['batch'])} | {rate(row['gradient'])} | "
            f"{compiles} |"
        )


def compare(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each setting of the peer, the fastest setting of vsr_jax that loses no shape and whose
    largest and median errors are no larger."""
    pairs = []
    for theirs in (row for row in rows if row["tool"] != "vsr_jax"):
        able = [row for row in rows if row["tool"] == "vsr_jax" and not row["lost"]]
        able = [
            row
            for row in able
            if all(row[key] <= theirs[key] for key in ("tip_error_max", "tip_error_median"))
        ]
        pair: dict[str, Any] = {"theirs": theirs["setting"], "ours": None}
        if able:
            ours = min(able, key=lambda row: row["batch"]["median_us"])
            ratios = {
                kind: theirs[kind]["median_us"] / ours[kind]["median_us"]
                for kind in ("single", "batch", "gradient")
            }
            pair |= {
                "ours": ours["setting"],
                **ratios,
                "batch_cpu": theirs["batch"]["cpu_us"] / ours["batch"]["cpu_us"],
            }
        pairs.append(pair)
    return pairs


def print_pairs(pairs: list[dict[str, Any]]) -> None:
    """Table of the comparison at equal or smaller error."""
    print(
        "\nSpeed of vsr_jax relative to SoRoMoX at equal or smaller tip errors, largest and "
        "median:\n"
    )
    print("| SoRoMoX | vsr_jax | single | 1,024 in a batch | the same, CPU time | their gradient |")
    print("|" + "---|" * 6)
    for pair in pairs:
        cells = [
            f"{pair[kind]:.1f}" if pair["ours"] else "-"
            for kind in ("single", "batch", "batch_cpu", "gradient")
        ]
        print(f"| {pair['theirs']} | {pair['ours'] or 'none as accurate'} | {' | '.join(cells)} |")


def formulations(
    peer: Any, taus: jax.Array, truth: np.ndarray, rounds: int, batch_size: int = 64
) -> list[dict[str, Any]]:
    """Rows for the formulations of the statics in SoRoMoX, at one setting, in a small batch."""
    chosen = peer.Setting(*CASES["loaded"].theirs[1])
    arm, path = peer.build(chosen, CASES["loaded"].numbers)
    rows = []
    print(f"\nSoRoMoX's formulations, {chosen}, {batch_size} in a batch:\n")
    print("| formulation | tip error max [m] | median | us per shape | compile [s] |")
    print("|" + "---|" * 5)
    for name, solve in peer.FORMULATIONS.items():

        def tips(arm: Any, path: Any, taus: jax.Array, solve: Callable = solve) -> jax.Array:
            return jax.vmap(lambda tau: peer.tip(arm, solve(arm, path, tau, chosen.tolerance)))(
                taus
            )

        job = Timed(tips, arm, path, taus[:batch_size])
        take_turns([job], rounds)
        row = {
            "formulation": name,
            "batch_size": batch_size,
            **errors(job.output, truth[:batch_size]),
            "batch": job.summary(),
        }
        low, median, high = (
            row["batch"][key] / batch_size for key in ("low_us", "median_us", "high_us")
        )
        spread = f"{median:.0f} ({low:.0f}-{high:.0f})"
        print(
            f"| {name} | {row['tip_error_max']:.1e} | {row['tip_error_median']:.1e} | {spread} | "
            f"{job.compile_s:.1f} |",
            flush=True,
        )
        rows.append(row)
    return rows


def truths(case: Case, taus: jax.Array) -> tuple[np.ndarray, float | None]:
    """Tips [m] at all tensions by vsr_jax at high resolution, and the distance [m] of its tip from
    the independent one."""
    tips = jax.jit(partial(our_tips, vsr.StrainDependent(*TRUTH)))
    found = np.asarray(
        tips(our_scene(case.numbers), jnp.append(taus, jnp.array([[case.tension]]), axis=0))
    )
    return found, None if case.tip is None else float(
        np.linalg.norm(found[-1] - np.array(case.tip))
    )


def slow_peers(name: str, case: Case, truth: np.ndarray) -> list[dict[str, Any]]:
    """Single solves by SciPy, and by PyElastica for an arm without loads: seconds, and distance of
    the tip [m]."""
    from peer_scipy import Arm

    arm = Arm(case.numbers)
    ways: dict[tuple[str, str], Callable] = {
        ("SciPy solve_bvp", f"tol {tol:g}"): partial(arm.tip, case.tension, tol)
        for tol in (1e-4, 1e-6)
    }
    if case.numbers["gravity"] is None:
        import peer_elastica

        for elements in (20, 40):
            key = "PyElastica dynamics", f"{elements} elements, 15 s"
            ways[key] = partial(peer_elastica.tip, case.numbers, case.tension, elements, 15.0)
    rows = []
    for (tool, setting), way in ways.items():
        start = time.perf_counter()
        error = float(np.linalg.norm(way() - truth))
        rows.append(
            {
                "scene": name,
                "tool": tool,
                "setting": setting,
                "seconds": time.perf_counter() - start,
                "tip_error": error,
            }
        )
        print(
            f"{tool}, {setting}: {rows[-1]['seconds']:.2f} s for one shape, tip error {error:.1e} "
            f"m",
            flush=True,
        )
    return rows


def load_peer() -> Any:
    """The module of SoRoMoX's side; one line and status 2 if SoRoMoX is not installed."""
    try:
        import peer_soromox
    except ModuleNotFoundError as error:
        print(
            f"bench_peers needs {error.name}, which is not installed: pip install '.[bench]'",
            file=sys.stderr,
        )
        sys.exit(2)
    return peer_soromox


def run(name: str, peer: Any, taus: jax.Array, rounds: int, slow: bool) -> dict[str, Any]:
    """Tables of one scene."""
    case = CASES[name]
    truth, miss = truths(case, taus)
    print(f"\n## {name}: {case.about}\n")
    if miss is not None:
        print(
            f"vsr_jax at {TRUTH[0]} steps of order {TRUTH[1]} is {miss:.1e} m from the "
            f"independent tip at {case.tension} N\n",
            flush=True,
        )
    jobs = [("SoRoMoX", *their_jobs(peer, case, setting, taus)) for setting in case.theirs]
    jobs += [("vsr_jax", *our_jobs(case, *resolution, taus)) for resolution in case.ours]
    rows = measure(jobs, truth[:-1], rounds)
    print_rows(rows)
    pairs = compare(rows)
    print_pairs(pairs)
    report = {"about": case.about, "truth_error": miss, "rows": rows, "pairs": pairs}
    return report | ({"slow": slow_peers(name, case, truth[-1])} if slow else {})


def draw(report: dict[str, Any], path: str) -> None:
    """Shapes per second over tip error, one panel per scene."""
    scenes = report["scenes"]
    figure = Figure(figsize=(4 * len(scenes), 3.8), layout="constrained")
    for ax, (name, found) in zip(
        np.atleast_1d(figure.subplots(1, len(scenes))), scenes.items(), strict=True
    ):
        for tool, colour in COLOURS.items():
            newton = tool.endswith("Newton")
            rows = [
                row
                for row in found["rows"]
                if tool.startswith(row["tool"]) and ("Newton" in row["setting"]) == newton
            ]
            rows.sort(key=lambda row: row["tip_error_max"])
            if rows:
                x = [max(row["tip_error_max"], 1e-16) for row in rows]
                ax.plot(
                    x,
                    [1e6 * BATCH / row["batch"]["median_us"] for row in rows],
                    "o-",
                    color=colour,
                    label=tool,
                )
        ax.set(
            xscale="log",
            yscale="log",
            xlabel="largest tip error [m]",
            ylabel="shapes per second",
            title=name,
        )
        ax.grid(alpha=0.3)
        ax.legend()
    figure.savefig(path, dpi=150)


def main() -> None:
    """Run the benchmark and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scenes",
        nargs="+",
        choices=tuple(CASES),
        default=tuple(CASES),
        help="scenes to run (default: all)",
    )
    parser.add_argument(
        "--slow", action="store_true", help="add single solves by SciPy and PyElastica"
    )
    parser.add_argument(
        "--formulations",
        action="store_true",
        help="also time the formulations of the loaded statics in SoRoMoX",
    )
    parser.add_argument("--rounds", type=int, default=5, help="timings per function (5)")
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    parser.add_argument("--plot", metavar="FILE", help="plot the results")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    peer = load_peer()
    versions = {name: importlib.metadata.version(name) for name in ("jax", "soromox")} | {
        "vsr_jax": vsr.__version__
    }
    print(f"{machine()}, {', '.join(f'{name} {number}' for name, number in versions.items())}")
    taus = jnp.asarray(np.random.default_rng(0).uniform(-15, 0, (BATCH, 1)))
    report: dict[str, Any] = {"machine": machine(), "versions": versions, "scenes": {}}
    for name in options.scenes:
        report["scenes"][name] = run(name, peer, taus, options.rounds, options.slow)
        jax.clear_caches()
    if options.formulations:
        report["formulations"] = formulations(
            peer, taus, truths(CASES["loaded"], taus)[0][:-1], options.rounds
        )
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(report, indent=1) + "\n")
    if options.plot:
        draw(report, options.plot)


if __name__ == "__main__":
    main()
