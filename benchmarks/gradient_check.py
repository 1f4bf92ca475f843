r"""Derivatives of the solve of random scenes, compared: forward mode, reverse mode and fourth-order
central differences, for the searches of wrong gradients (`gradient_search.py`,
`gradient_search_around.py`).

A function f of what is observed of an equilibrium is differentiated with respect to all numbers of
scene and inputs, along a random direction v. The three must agree to 1e-7 of the derivative. NaN is
counted separately; so are scenes without an equilibrium, whose derivatives must be zero or NaN in
both modes. The error of a difference is estimated from those of other step sizes. Only points where
the solve is smooth are used; a scene with too few of them is counted as at a switch.
"""

import argparse
import json
import os
import time
import warnings
from collections.abc import Callable, Iterable
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import vsr_jax as vsr

SAME = 1e-7
"""Largest difference between two derivatives that count as the same, as a share of the
derivative."""
WIDEST, HALVINGS = 0.02, 10
"""Largest step of the differences as a share of each number, and the number of halvings."""


def covering(
    effects: tuple[str, ...],
    size: int,
    candidate: Callable[[], frozenset[str]],
    number: int,
    first: Iterable[frozenset[str]] = (),
) -> list[frozenset[str]]:
    """Subsets of effects: the first ones, then repeatedly the one of a hundred candidates that adds
    the most on-off combinations of so many effects."""

    def covered(chosen: frozenset[str]) -> set:
        return {
            (names, tuple(name in chosen for name in names))
            for names in combinations(effects, size)
        }

    found = list(first)
    seen = set[Any]().union(*map(covered, found))
    while len(found) < number:
        every = (candidate() for _ in range(100))
        found.append(max(every, key=lambda chosen: len(covered(chosen) - seen)))
        seen |= covered(found[-1])
    return found[:number]


class Drawn(NamedTuple):
    """A scene, its inputs, and the size of its forces [N]."""

    scene: vsr.Scene
    inputs: jax.Array
    force: float


class Observed(NamedTuple):
    """Numbers that f mixes, and what is the same wherever the solve is smooth."""

    numbers: jax.Array
    switches: tuple[jax.Array, ...]


def observed(eq: vsr.Equilibrium, force: jax.Array, steps: int) -> Observed:
    """The tip's pose, the thread forces and the slack; which cables are slack, and how so many
    steps are distributed over the pieces of the arm."""
    grid = vsr.StrainDependent(steps).grid(eq.scene)
    pieces = jnp.searchsorted(eq.scene.edges(), grid.start + 0.5 * grid.h)
    parts = [eq.tip[:3, 3] / 0.3, eq.tip[:3, :3].ravel(), eq.forces / force, eq.slack / 0.01]
    return Observed(jnp.concatenate(parts), (eq.forces == 0, pieces))


def exact(scene: vsr.Scene) -> vsr.Scene:
    """The scene with poses that remain rigid transforms wherever their numbers go."""

    def rigid(pose: jax.Array) -> jax.Array:
        return vsr.se3.nearest_pose(vsr.se3.nearest_pose(pose))

    def is_pose(x: Any) -> bool:
        return jnp.shape(x) == (4, 4)

    return jax.tree.map(lambda x: rigid(x) if is_pose(x) else x, scene)


class Program:
    """Compiled functions for the scenes of a structure: f, and its derivatives."""

    def __init__(
        self,
        like: Drawn,
        model: Any,
        random: np.random.Generator,
        observe: Callable[[vsr.Equilibrium, jax.Array], Observed],
    ):
        _, rebuild = ravel_pytree(like[:2])
        shape = jax.eval_shape(
            lambda: observe(vsr.solve(like.scene, like.inputs, model=model), jnp.ones(()))
        )
        mix = jnp.asarray(random.normal(size=shape.numbers.size))

        def value(x: jax.Array, force: jax.Array) -> tuple[jax.Array, tuple]:
            scene, inputs = rebuild(x)
            eq = vsr.solve(exact(scene), inputs, model=model)
            numbers, switches = observe(eq, force)
            return mix @ numbers, (eq.status, *switches)

        def derivatives(x: jax.Array, force: jax.Array, v: jax.Array) -> tuple[jax.Array, ...]:
            _, push = jax.linearize(lambda x: value(x, force)[0], x)
            (gradient,) = jax.linear_transpose(push, x)(jnp.ones(()))
            return push(v), gradient @ v

        self.value, self.derivatives = jax.jit(jax.vmap(value)), jax.jit(jax.vmap(derivatives))


class Found(NamedTuple):
    """Results of one scene: its status, the three derivatives, and the estimated error of the
    difference (NaN at a switch)."""

    status: int
    forward: float
    reverse: float
    difference: float
    error: float


def compared(scenes: list[Drawn], program: Program, random: np.random.Generator) -> list[Found]:
    """Derivatives of scenes of one structure by its program."""
    draws = len(scenes)
    x, force = (
        jnp.stack([ravel_pytree(one[:2])[0] for one in scenes]),
        jnp.asarray([one.force for one in scenes]),
    )
    v = random.normal(size=x.shape) * np.where(x == 0, 1e-3, np.abs(x))
    forward, reverse = (np.asarray(part) for part in program.derivatives(x, force, v))
    steps = WIDEST * 0.5 ** np.arange(HALVINGS + 1)
    places = np.concatenate([[0.0], steps, -steps])
    points = (x[:, None] + places[:, None] * v[:, None]).reshape(-1, x.shape[1])
    values, (status, *switches) = program.value(points, jnp.repeat(force, len(places)))
    values, status = np.asarray(values).reshape(draws, -1), np.asarray(status).reshape(draws, -1)
    for switch in switches:
        told = np.asarray(switch).reshape(*values.shape, -1)
        values = np.where(np.all(told == told[:, :1], axis=2), values, np.nan)
    odd = values[:, 1 : len(steps) + 1] - values[:, len(steps) + 1 :]
    found = [difference(*pair) for pair in zip(odd, np.broadcast_to(steps, odd.shape), strict=True)]
    return [
        Found(int(s[0]), float(f), float(r), *d)
        for s, f, r, d in zip(status, forward, reverse, found, strict=True)
    ]


def difference(odd: np.ndarray, steps: np.ndarray) -> tuple[float, float]:
    r"""Fourth-order central difference $(8 (f_h - f_{-h}) - (f_{2h} - f_{-2h})) / 12 h$ and its
    error, from $f_h - f_{-h}$ at successively halved steps.

    The chosen step is the one whose difference is closest to those of twice and of half the step;
    the error is four times that distance.
    """
    slopes = (8 * odd[1:] - odd[:-1]) / (12 * steps[1:])
    changes = np.abs(np.diff(slopes))
    errors = np.maximum(changes[1:], changes[:-1])
    if np.all(np.isnan(errors)):
        return float("nan"), float("nan")
    best = int(np.nanargmin(errors))
    return float(slopes[best + 1]), 4 * float(errors[best])


def verdict(found: Found) -> str:
    """Verdict on a draw; it starts with `wrong` if a derivative is wrong."""
    nan = np.isnan(found.forward), np.isnan(found.reverse)
    if found.status != vsr.Status.CONVERGED:
        none = all(nan) or found.forward == found.reverse == 0
        return "not converged" if none else "wrong: not converged, with a derivative"
    if any(nan):
        return "NaN in both" if all(nan) else "NaN in one mode"
    if abs(found.forward - found.reverse) > SAME * abs(found.forward):
        return "wrong: the modes differ"
    if np.isnan(found.error):
        return "at a switch"
    if abs(found.forward - found.difference) > SAME * abs(found.forward) + found.error:
        return "wrong: not the difference"
    return "agrees" if found.error <= SAME * abs(found.forward) else "difference too rough"


def summary(found: list[Found]) -> dict[str, Any]:
    """The row of a structure: counts, and the largest relative differences."""
    said = [verdict(one) for one in found]
    counts = {words: said.count(words) for words in sorted(set(said))}
    solved = [
        one
        for one in found
        if one.status == vsr.Status.CONVERGED and not np.isnan(one.forward + one.reverse)
    ]
    modes = [abs(one.forward - one.reverse) / abs(one.forward) for one in solved]
    apart = [
        abs(one.forward - one.difference) / abs(one.forward)
        for one in solved
        if one.error <= SAME * abs(one.forward)
    ]
    return {
        "draws": len(found),
        "converged": sum(one.status == vsr.Status.CONVERGED for one in found),
        "verdicts": counts,
        "forward - reverse": max(modes, default=None),
        "forward - differences": max(apart, default=None),
    }


def line(name: str, row: dict[str, Any]) -> str:
    """A line of the table."""
    said = row["verdicts"]
    worst = (
        "-" if row[key] is None else f"{row[key]:.0e}"
        for key in ("forward - reverse", "forward - differences")
    )
    wrong = sum(number for words, number in said.items() if words.startswith("wrong"))
    counts = (
        said.get(words, 0)
        for words in ("NaN in both", "NaN in one mode", "at a switch", "difference too rough")
    )
    cells = (name, row["draws"], row["converged"], *counts, wrong, *worst)
    return f"| {' | '.join(str(cell) for cell in cells)} |"


HEADER = (
    "| effects | draws | converged | NaN in both | NaN in one mode | at a switch | difference too "
    "rough | wrong "
    "| forward - reverse | forward - differences |\n|" + "---|" * 10
)


class Job(NamedTuple):
    """A structure to be searched: its name, what the record says of it, and the search."""

    name: str
    record: dict[str, Any]
    search: Callable[[], list[Found]]


def parser(description: str | None, draws: int) -> argparse.ArgumentParser:
    """The options of a search, by default with so many draws."""
    made = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("--structures", type=int, default=12)
    made.add_argument(
        "--draws", type=int, default=draws, help="draws per structure (default: %(default)s)"
    )
    made.add_argument("--json", metavar="FILE")
    return made


def run(jobs: Iterable[Job], record: dict[str, Any], path: str | None) -> None:
    """Search structure by structure, with a line of the table and the record after each."""
    # nothing is timed
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore", vsr.UnitWarning)  # densities follow from weights that are drawn
    print(HEADER)
    rows: list[dict[str, Any]] = []
    for job in jobs:
        began = time.perf_counter()
        # the programs of a structure are used once and take hundreds of megabytes
        jax.clear_caches()
        found = job.search()
        row = {**job.record, **summary(found)}
        print(line(job.name, row), f"{time.perf_counter() - began:.0f} s", flush=True)
        rows.append({**row, "found": [[verdict(one), *one] for one in found]})
        if path:
            whole = {**record, "jax": jax.__version__, "structures": rows}
            Path(path).write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")
