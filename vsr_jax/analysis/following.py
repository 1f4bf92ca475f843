r"""`follow`: equilibria along a path of inputs and scenes, each from the one before it.

The path is quasi-static: the arm is in equilibrium at every sample. Each solve starts from the
equilibrium before, so that of several stable equilibria the arm stays in its own until that one
disappears. Tendons with friction remember their tension at every section,

$$T_j(X) = \min(\max(T_{j-1}(X), T_j e^{-\mu \varphi(X)}), T_j e^{\mu \varphi(X)}),$$

with $T_j$ the tension at the start and $\varphi$ the turning angle of the path: where the old
tension lies between both envelopes the cable sticks, elsewhere it slips.

Contacts with obstacles that have friction remember the shape of the arm. The point of its surface
that is in contact either has not moved along the obstacle since the sample before, with a friction
force of at most $\mu \lambda$, or it slips, and $\mu \lambda$ opposes its motion.

**Source:** for a cable in a sheath of fixed shape, M. Kaneko, T. Yamashita and K. Tanie, Basic
considerations on transmission characteristics for tendon drive robots, ICAR 1991.
"""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..arm.scene import Scene
from ..models.base import Model, Near, Outcome, Status
from ..models.strain_dependent import StrainDependent
from ..numerics.compiling import program
from ..numerics.loops import scan
from ..solution.equilibrium import Equilibrium
from ..solution.solver import checked_outcome, near_of
from ..typing import ArrayLike, cast
from ..validation import instance, is_traced, numbers

_SMALLER = 2, 4, 8
"""Numbers of smaller steps in which a sample is approached that is not solved in one."""


def follow(
    scene: Scene,
    inputs: ArrayLike,
    *,
    model: Model | None = None,
    start: Equilibrium | None = None,
) -> Equilibrium:
    r"""Equilibria along a path of inputs and scenes, in order, with the history of friction, of
    tendons and of contact with obstacles.

    Where a tendon has friction its tension follows $T_j(X) = \min(\max(T_{j-1}(X), T_j e^{-\mu
    \varphi(X)}), T_j e^{\mu \varphi(X)})$ from one sample to the next: after a reversal it slips
    from its start on, and sticks beyond with the tension that it had. The `motion` of the tendons
    is not used; pulling from rest follows the law of `"pull"`, releasing far enough that of
    `"release"`. A part that sticks keeps its tension also where loads deform the arm there.

    Where the arm touches an obstacle with friction $\mu$, the friction force f along the surface
    and the motion $\Delta$ of the touching point since the last sample obey Coulomb's law:
    $\Delta = 0$ and $|f| \le \mu \lambda$ (it sticks), or $f = -\mu \lambda \Delta / |\Delta|$
    (it slips). Samples should be close where the direction of slip changes. The forces are in
    `Equilibrium.contacts`.

    Without friction the equilibria are those of `solve(start=)`: of several stable ones the arm
    stays in the one that it is in.

    A path may also move the base, held sections, loads or any other number of the scene: `scene` is
    then that of every sample, as `jax.vmap(scene_of)(t)` makes it from a function of one parameter
    and its values in order. Numbers that are `driven` are part of the inputs.

    **Arguments:**
    - `scene`: one scene for the whole path, or one with a leading axis of samples in all its
      numbers. Obstacles with friction must not move: slip is that over the world.
    - `inputs`: shape (samples, inputs), in order. Their dtype is the precision.
    - `model`: a `StrainDependent`, the default.
    - `start`: where the path begins: an equilibrium of the same scene and model, for example the
      last one of another path, which the two then continue; by default the arm at rest, with all
      cables free of tension.

    **Returns:** an `Equilibrium` with a batch axis of that size, for use with `jax.vmap`, as in
    `jax.vmap(lambda eq: eq.tip)(path)`; `jax.tree.map(lambda x: x[-1], path)` is the last one. A
    sample that is not solved from the one before is approached in 2, 4 or 8 smaller steps of the
    inputs, with a warning, where all numbers are known and the scene is one for the whole path. A
    sample without an equilibrium has a status as of `solve`; the next one continues from the last
    that has one. Differentiable with respect to the inputs, the scene and `start`.

    **Raises:** `ValueError` for inputs of a wrong shape, another number of scenes, another model,
    and a start of another model, with other actuators or, for several scenes, other parts.
    """
    instance("scene", scene, Scene, "a Scene")
    model = StrainDependent() if model is None else model
    if not (isinstance(model, Model) and model.remembers):
        raise ValueError(
            f"model: got {model}, need a StrainDependent, the only model with a memory"
        )
    first = jax.tree.map(lambda x: x[0], scene) if _several(scene) else scene
    values = _path(scene, first, inputs)
    scene, first = cast((scene, first), values.dtype)
    if scene.driven:
        known = jnp.isfinite(values[0])
        first = first.at(jnp.where(known, values[0], first.rest_inputs))
    before = model.at_rest(first, values.dtype) if start is None else _start(start, first, model)
    if _moving(scene) and jax.tree.structure(before.scene) != jax.tree.structure(first):
        raise ValueError(
            "start: got an equilibrium of a scene with other parts, need those of the path's scenes"
        )
    before = cast(before, values.dtype)
    outcomes = _follow(scene, before, values)
    known = not any(map(is_traced, jax.tree.leaves((scene, before, outcomes.status))))
    if known and not _several(scene):
        outcomes = _completed(scene, before, values, outcomes)
    each = (0 if _several(scene) else None, 0, 0)
    made = jax.vmap(lambda scene, u, outcome: Equilibrium(scene, u, model, outcome), each)
    return made(scene, values, outcomes)


def _completed(scene: Scene, before: Near, inputs: Array, found: Outcome) -> Outcome:
    """The outcomes of a path, with those samples approached in smaller steps that were not solved;
    all by the same program, on a path of the same length."""
    number, steps = len(inputs), {}
    for i in range(number):
        solved = np.asarray(found.status) == Status.CONVERGED
        if solved[i]:
            continue
        last = np.flatnonzero(solved[:i])
        # at rest the actuators exert nothing, and what is driven is where the path begins
        near, first = before, inputs[0].at[: len(scene.actuators)].set(0.0)
        if last.size:
            place = int(last[-1])
            near, first = _at(before, found, place, scene.at(inputs[place])), inputs[place]
        for parts in (parts for parts in _SMALLER if parts <= number):
            share = jnp.arange(1, parts + 1, dtype=inputs.dtype)[:, None] / parts
            way = _follow(scene, near, _padded(first + share * (inputs[i] - first), number))
            if way.status[parts - 1] != Status.CONVERGED:
                continue
            there = [found, way]
            if i + 1 < number:
                after = _at(before, way, parts - 1, scene.at(inputs[i]))
                there.append(_follow(scene, after, _padded(inputs[i + 1 :], number)))
            found = jax.tree.map(partial(_joined, i, parts), *there)
            steps[i] = parts
            break
    if steps:
        named = ", ".join(f"{i} in {parts}" for i, parts in steps.items())
        warnings.warn(
            f"follow: samples were approached in smaller steps of the inputs: {named}",
            stacklevel=3,
        )
    return found


def _at(before: Near, found: Outcome, i: int, scene: Scene) -> Near:
    """Where a path goes on from a sample, with the scene there."""
    forces, state = jax.tree.map(lambda x: x[i], (found.forces, found.state))
    return before._replace(scene=scene, forces=forces, state=state)


def _padded(inputs: Array, number: int) -> Array:
    """Inputs, the last ones again up to a number of samples."""
    return jnp.concatenate([inputs, jnp.repeat(inputs[-1:], number - len(inputs), axis=0)])


def _joined(i: int, parts: int, found: Array, way: Array, *later: Array) -> Array:
    """The samples before i, the end of the way to it, and those after it."""
    rest = [x[: len(found) - i - 1] for x in later]
    return jnp.concatenate([found[:i], way[parts - 1 : parts], *rest])


def _several(scene: Scene) -> bool:
    """Whether there is a scene for each sample."""
    return jnp.ndim(scene.rod.length) > 0


def _moving(scene: Scene) -> bool:
    """Whether the numbers of the scene change along the path."""
    return _several(scene) or bool(scene.driven)


def _path(scene: Scene, first: Scene, inputs: ArrayLike) -> Array:
    values, size = numbers("inputs", inputs, None, finite=False), len(first.inputs)
    if values.ndim != 2 or values.shape[1] != size or not len(values):
        raise ValueError(
            f"inputs: got shape {values.shape}, need (samples, {size}), one row per sample"
        )
    if _several(scene) and scene.rod.length.shape != values.shape[:1]:
        raise ValueError(
            f"scene: got one for each of {scene.rod.length.shape} samples, need one scene or "
            f"{len(values)}, as many as inputs"
        )
    return values


def _start(start: Equilibrium, scene: Scene, model: Model) -> Near:
    near = near_of(scene, start)
    if near.model != model:
        raise ValueError(f"start: got an equilibrium by {near.model}, need one by {model}")
    return near


@program("follow")
def _follow(scene: Scene, before: Near, inputs: Array) -> Outcome:
    model = before.model

    def proceed(carry: tuple, sample: tuple) -> tuple[tuple, Outcome]:
        last, *solution = carry
        values, own = sample
        here = scene if own is None else own
        near = Near(model, here if last is None else last, *solution)
        outcome = checked_outcome(
            here, values, model, lambda there, u: model.solve_after(there, u, near)
        )
        found = outcome.status == Status.CONVERGED
        there = here.at(values) if moving else None
        after = (there, outcome.forces, outcome.state)
        return jax.tree.map(lambda a, b: jnp.where(found, a, b), after, carry), outcome

    moving = _moving(scene)
    start = (before.scene if moving else None, before.forces, model.remembered(before).state)
    return scan(proceed, start, (inputs, scene if _several(scene) else None))[1]
