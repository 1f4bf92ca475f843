r"""Equilibrium of an assembly by condensing its arms.

The unknowns are the poses of the bodies. The residual f is the moment about the origin of each, in
its own axes, and the force in those of the world: a turn about the origin leaves the force as it
is. Its derivative by turns about their own axes and motions along the world's comes from the
implicit derivatives of the arms, which are solved between their joints from their last shapes. Arms
of one structure are solved side by side by one program.

The inputs go from those of the start, or from rest, to the given ones, at once if they can; without
a start the joints go with them, from where the sections lie at rest. A step is $K^{-1} (f + \Delta
f)$ with the change of the wrench by the inputs, or downhill along the eigenvectors of K where it is
not positive definite, at most as long as a radius. It is taken if all arms are solved there and the
wrench along the step has not turned against it by more than `_OVERSHOOT` of what it was; else it is
halved. Without a potential this is still a descent along the forces.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..arm.scene import Scene
from ..mechanics.sizes import softest
from ..models.base import Model, Near, Outcome, Status
from ..models.strain_dependent import StrainDependent
from ..numerics.compiling import program
from ..numerics.loops import while_loop
from ..numerics.se3 import stacked_rotation
from ..solution.equilibrium import Equilibrium
from ..solution.solver import outcome_of, status_of_inputs
from ..typing import DTypeLike, VectorLike, cast
from ..validation import instance
from .assembly import Assembly
from .joint import Joint
from .solved import AssemblyEquilibrium

_OVERSHOOT = 0.9
"""Largest wrench against an accepted step, as a share of that along it before."""
_RADIUS = 0.3
"""Longest step: an angle [rad] and a motion as a share of the mean length."""
_MOST_STEPS = 60
_LEAST = 1e-6
"""Share of the longest step, and of the way of the inputs, below which the search is given up."""


class _Search(NamedTuple):
    """State of the search.

    **Fields:** `poses` of the bodies and the outcome of each group of arms, at a `share` of the way
    from the first inputs to the last; `wrench` on the bodies, their `stiffness`, and the derivative
    of the wrench `by_inputs`, by that share; how far the share may go `ahead` in the next step, and
    the `radius` of that step; the `size` of the last one, infinite on the way; the number of
    `steps`; whether the arms are `sound`, that is in equilibrium.
    """

    poses: Array
    outcomes: tuple[Outcome, ...]
    wrench: Array
    stiffness: Array
    by_inputs: Array
    share: Array
    ahead: Array
    radius: Array
    size: Array
    steps: Array
    sound: Array


def solve_assembly(
    assembly: Assembly,
    inputs: VectorLike,
    *,
    model: Model | None = None,
    start: AssemblyEquilibrium | None = None,
) -> AssemblyEquilibrium:
    r"""Equilibrium of an assembly: poses x of the bodies at which the wrenches on each of them add
    up to zero, while every arm is in equilibrium between its joints,

    $$f_b(x) = w_b + \sum_j W_j(x) = 0.$$

    The arms are condensed: with them in equilibrium the potential of the whole depends on x alone,
    its gradient is $-f$, and its second derivative the stiffness matrix $K = -\partial f / \partial
    x$. The whole is stable if K is positive definite and the arms are stable between their joints.
    Newton's method takes steps $K^{-1} f$, downhill where K is indefinite, from the poses that the
    bodies have or from those of `start`. On the way the inputs go from those at rest, or of the
    start, to the given ones; without a start, the joints go from where their sections lie at rest
    to their places on the bodies. Batch with `jax.vmap`; first derivatives by every number and
    input are implicit.

    **Arguments:**
    - `inputs`: those of the first arm, then those of the second, and so on. Their dtype is the
      precision.
    - `model`: of the arms, a `StrainDependent`.
    - `start`: an equilibrium near by, of this assembly by the same model.

    **Returns:** an `AssemblyEquilibrium`.

    **Raises:** `ValueError` for a wrong number of inputs and values out of their range, another
    model, a start of another assembly.
    """
    given = model or StrainDependent()
    if not (isinstance(given, Model) and given.on_nodes):
        raise ValueError(f"model: got {model!r}, need a StrainDependent")
    values = assembly.check_inputs(inputs)
    if start is not None:
        instance("start", start, AssemblyEquilibrium, "the result of another solve")
        if start.model != given or len(start.poses) != len(assembly.bodies):
            raise ValueError(
                f"start: got an equilibrium by {start.model} with {len(start.poses)} bodies, "
                f"need one of this assembly by {given}"
            )
    assembly, near = cast((assembly, start), values.dtype)
    return _solved_whole(assembly, values, given, near)


@program("solve")
def _solved_whole(
    assembly: Assembly, inputs: Array, model: Model, start: AssemblyEquilibrium | None
) -> AssemblyEquilibrium:
    """The equilibrium; all arguments have one precision."""
    own = zip(assembly.arms, assembly.split(inputs), strict=True)
    refused = jnp.max(jnp.stack([status_of_inputs(arm, u) for arm, u in own]))
    values = jnp.where(refused == Status.CONVERGED, inputs, assembly.rest_inputs)
    whole = _Whole(assembly, values, model)
    found = _search(lax.stop_gradient(whole), lax.stop_gradient(start))
    poses = moved(found.poses, _root(whole, found) * whole.scale.reshape(-1))
    status, least = _judged(lax.stop_gradient(whole), found)
    status = jnp.where(refused == Status.CONVERGED, status, refused).astype(jnp.int32)
    fine, unit = status == Status.CONVERGED, lax.stop_gradient(whole.scale.reshape(-1))
    arms = [_with_status(eq, fine, status) for eq in whole.again(poses, found)]
    if not found.wrench.size:
        least = jnp.min(jnp.stack([eq.stability for eq in arms]))
    return AssemblyEquilibrium(
        assembly,
        inputs,
        model,
        jnp.where(fine, poses, jnp.nan),
        tuple(arms),
        jnp.where(fine, found.stiffness / (unit[:, None] * unit), jnp.nan),
        jnp.where(fine, least, jnp.nan),
        status,
        found.steps,
        found.outcomes,
    )


def _with_status(eq: Equilibrium, fine: Array, status: Array) -> Equilibrium:
    """An arm of an assembly, with the status of the whole where that failed."""
    return eqx.tree_at(lambda arm: arm.status, eq, jnp.where(fine, eq.status, status))


def _stacked(places: tuple[int, ...], items: list) -> Any:
    """Items of the arms at some places, with a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(items[i] for i in places))


class _Whole(NamedTuple):
    """The assembly as functions of the poses of its bodies."""

    assembly: Assembly
    inputs: Array
    model: Model

    @property
    def own_inputs(self) -> list[Array]:
        return self.assembly.split(self.inputs)

    @property
    def groups(self) -> list[tuple[int, ...]]:
        """Places of the arms of one structure each."""
        found: dict[Any, list[int]] = {}
        scenes = self.assembly.placed(self.assembly.poses)
        for i, pair in enumerate(zip(scenes, self.own_inputs, strict=True)):
            shapes = tuple(jnp.shape(x) for x in jax.tree.leaves(pair))
            found.setdefault((jax.tree.structure(pair), shapes), []).append(i)
        return [tuple(places) for places in found.values()]

    @property
    def length(self) -> Array:
        """Mean length of the arms [m]."""
        return jnp.mean(jnp.stack([arm.rod.length for arm in self.assembly.arms]))

    @property
    def bending(self) -> Array:
        """Mean bending stiffness of the arms over their length [N m]."""
        rods = [arm.rod for arm in self.assembly.arms]
        each = [softest(rod.stiffness(rod.length / 2)) / rod.length for rod in rods]
        return jnp.mean(jnp.stack(each))

    @property
    def scale(self) -> Float[Array, "bodies 6"]:
        """Sizes of unit motions: 1 rad and the mean length."""
        one = jnp.ones((len(self.assembly.bodies), 3), self.inputs.dtype)
        return jnp.concatenate([one, self.length * one], axis=1)

    def solve(
        self, poses: Array, near: tuple[Outcome, ...], before: "_Whole", at: Array
    ) -> tuple[Outcome, ...]:
        """Outcomes of the groups with the bodies in some poses, from those `before`, with the
        bodies `at` others."""
        scenes, inputs = self.assembly.placed(poses), self.own_inputs
        last_scenes, last_inputs = before.assembly.placed(at), before.own_inputs

        def one(scene: Scene, u: Array, last: Scene, last_u: Array, outcome: Outcome) -> Outcome:
            start = Near(self.model, last.at(last_u), outcome.forces, outcome.state)
            return outcome_of(scene, u, self.model, start)._replace(nodes=None, restarted=None)

        every = scenes, inputs, last_scenes, last_inputs
        found = []
        for places, outcome in zip(self.groups, near, strict=True):
            given: Any = [*(_stacked(places, x) for x in every), outcome]
            found.append(jax.vmap(one)(*given))
        return tuple(found)

    def unguessed(self, poses: Array) -> tuple[Outcome, ...]:
        """Outcomes where nothing is known: straight arms without forces. A solve that does not get
        on from there begins as without a start."""
        scenes, found = self.assembly.placed(poses), []

        def one(scene: Scene, u: Array) -> Outcome:
            return outcome_of(scene, u, self.model)._replace(nodes=None, restarted=None)

        for places in self.groups:
            given = _stacked(places, scenes), _stacked(places, self.own_inputs)
            kind = eqx.filter_eval_shape(jax.vmap(one), *given)
            outcome = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), kind)
            found.append(outcome._replace(state=self.model.straight(outcome.state)))
        return tuple(found)

    def again(self, poses: Array, found: _Search) -> list[Equilibrium]:
        """The arms at a solution of the search, as functions of all numbers: not solved again."""
        scenes, inputs = self.assembly.placed(poses), self.own_inputs
        before = lax.stop_gradient(self.assembly.placed(found.poses))
        arms: dict[int, Equilibrium] = {}

        def one(scene: Scene, u: Array, last: Scene, outcome: Outcome) -> Equilibrium:
            near = Near(self.model, last.at(u), outcome.forces, outcome.state)
            there = self.model.solve_at(scene.at(u), u, near)
            status = jnp.where(_balanced(outcome.status), Status.CONVERGED, outcome.status)
            return Equilibrium(scene, u, self.model, there._replace(status=status))

        for places, outcome in zip(self.groups, found.outcomes, strict=True):
            given: Any = [*(_stacked(places, x) for x in (scenes, inputs, before)), outcome]
            eqs = jax.vmap(one)(*given)
            for k, i in enumerate(places):
                arms[i] = jax.tree.map(lambda x, k=k: x[k], eqs)
        return [arms[i] for i in range(len(scenes))]

    def wrench(self, poses: Array, arms: list[Equilibrium]) -> Float[Array, "bodies 6"]:
        """Moment [N m] about the origin of each body in its own axes, and force [N] in the
        world's."""
        assembly = self.assembly
        total = [body.wrench(poses[b], assembly.gravity) for b, body in enumerate(assembly.bodies)]
        for i, (arm, eq) in enumerate(zip(assembly.arms, arms, strict=True)):
            held = iter(eq.supports[len(arm.held) :])  # by each joint but that of the base
            for _, joint in assembly.jointed(i):
                if joint.at_base:
                    pull, place = _pull_on_base(eq)
                else:
                    pull, place = -next(held), _place(joint, poses, eq)
                if joint.body is not None:
                    total[joint.body] += _wrench_on(poses[joint.body], pull, place)
        return jnp.stack(total)


def _pull_on_base(eq: Equilibrium) -> tuple[Array, Array]:
    """Moment and force in the world by which an arm pulls its base, and where: its base may be
    driven beyond the joint."""
    base, inner = eq.scene.rod.frame, eq.reaction(jnp.zeros(()))
    assert base is not None  # a joint has placed it
    R = base[:3, :3]
    return jnp.concatenate([R @ inner[:3], R @ inner[3:]]), base[:3, 3]


def _place(joint: Joint, poses: Array, eq: Equilibrium) -> Array:
    """Where the section of a joint is [m]: in the joint, unless it slides."""
    if joint.kind != "slider":
        return joint.in_world(poses)[:3, 3]
    return eq.tip[:3, 3] if joint.X is None else eq.position(joint.X)


def _wrench_on(pose: Array, pull: Array, at: Array) -> Float[Array, "6"]:
    """A wrench (moment, force) of the world at a point as one on a body: moment about its origin in
    its axes, force in the world's."""
    moment = pull[:3] + jnp.cross(at - pose[:3, 3], pull[3:])
    return jnp.concatenate([pose[:3, :3].T @ moment, pull[3:]])


def moved(poses: Float[Array, "bodies 4 4"], motion: Array) -> Float[Array, "bodies 4 4"]:
    """Bodies after turns about their own axes and motions along the world's, six numbers each."""
    by = motion.reshape(-1, 6)

    def one(pose: Array, by: Array) -> Array:
        turned = pose.at[:3, :3].set(pose[:3, :3] @ stacked_rotation(by[:3]))
        return turned.at[:3, 3].add(by[3:])

    return jax.vmap(one)(poses, by)


def _search(whole: _Whole, start: AssemblyEquilibrium | None) -> _Search:
    size, dtype = whole.scale.size, whole.inputs.dtype
    poses = whole.assembly.poses if start is None else start.poses
    first_inputs = whole.assembly.rest_inputs if start is None else start.inputs
    one = jnp.ones((), dtype)
    first = _Search(
        poses,
        whole.unguessed(poses) if start is None else start.search,
        jnp.zeros(size, dtype),
        jnp.eye(size, dtype=dtype),
        jnp.zeros(size, dtype),
        0 * one,
        one,
        _RADIUS * one,
        jnp.inf * one,
        jnp.zeros((), jnp.int32),
        jnp.ones((), bool),
    )

    def at(share: Array) -> _Whole:
        inputs = first_inputs + share * (whole.inputs - first_inputs)
        assembly = whole.assembly.assembled(share) if start is None else whole.assembly
        return whole._replace(inputs=inputs, assembly=assembly)

    def proceed(here: _Search) -> Array:
        lost = jnp.minimum(here.radius / _RADIUS, here.ahead) < _LEAST
        return here.sound & (here.size > small(dtype)) & (here.steps < _MOST_STEPS) & ~lost

    def attempt(here: _Search) -> _Search:
        begins = here.steps == 0  # the arms are solved for the first time, where the bodies are
        ahead = jnp.where(begins, 0.0, jnp.minimum(here.ahead, 1 - here.share))
        aim = here.wrench + here.by_inputs * ahead
        step, length, limit = _step(here.stiffness, aim, here.radius)
        ahead = ahead * limit
        there = here._replace(
            poses=moved(here.poses, step * whole.scale.reshape(-1)), share=here.share + ahead
        )
        outcomes = at(there.share).solve(there.poses, here.outcomes, at(here.share), here.poses)
        there = there._replace(outcomes=outcomes, sound=_solved(outcomes))
        f, K, by_inputs = _linearised(at, there) if size else (aim, here.stiffness, aim)
        new = there._replace(
            wrench=f,
            stiffness=K,
            by_inputs=by_inputs,
            ahead=jnp.where(begins, 1.0, jnp.minimum(2 * ahead + _LEAST, 1.0)),
            radius=jnp.where(begins, _RADIUS, jnp.minimum(2 * length + _RADIUS / 4, _RADIUS)),
            size=jnp.where((ahead > 0) | (there.share < 1) | (limit < 1), jnp.inf, length),
        )
        # a last step is below rounding, and so may be the wrench
        last = (length <= small(dtype)) & (limit == 1)
        against = (f @ step < -_OVERSHOOT * (aim @ step)) & ~last
        taken = begins | (there.sound & ~against & jnp.all(jnp.isfinite(K)))
        cut = here._replace(
            radius=length / 2, ahead=jnp.where(ahead > 0, here.ahead / 2, here.ahead)
        )
        chosen = jax.tree.map(lambda a, b: jnp.where(taken, a, b), new, cut)
        return chosen._replace(steps=here.steps + 1)

    return lax.stop_gradient(while_loop(proceed, attempt, lax.stop_gradient(first)))


def _linearised(at: Callable[[Array], _Whole], found: _Search) -> tuple[Array, Array, Array]:
    r"""Scaled wrenches on the bodies, their stiffness $-\partial f / \partial x$, and their
    derivative by the share of the inputs."""

    def of(changes: Array) -> tuple[Array, Array]:
        whole = at(found.share + changes[-1])
        poses = moved(found.poses, changes[:-1] * whole.scale.reshape(-1))
        f = (whole.wrench(poses, whole.again(poses, found)) * whole.scale).reshape(-1)
        return f, f

    none = jnp.zeros(found.wrench.size + 1, found.wrench.dtype)
    slope, f = jax.jacfwd(of, has_aux=True)(none)
    return f, -slope[:, :-1], slope[:, -1]


def small(dtype: DTypeLike) -> float:
    """Size of a step whose square is below rounding."""
    return float(jnp.finfo(dtype).eps ** 0.6)


def _step(K: Array, f: Array, radius: Array) -> tuple[Array, Array, Array]:
    """A step at most as long as a radius, its length, and the share of the whole step that it is:
    $K^{-1} f$ where K is positive definite, else downhill along its eigenvectors."""
    if not f.size:
        return f, jnp.zeros_like(radius), jnp.ones_like(radius)
    values, vectors = jnp.linalg.eigh((K + K.T) / 2)
    greatest, along = jnp.max(jnp.abs(values)), vectors.T @ f
    least = small(K.dtype) * greatest
    # a motion that nothing resists is left alone, but for a wrench beyond rounding
    driven = (jnp.abs(values) > least) | (jnp.abs(along) > least)
    downhill = vectors @ jnp.where(driven, along / jnp.maximum(jnp.abs(values), least), 0.0)
    step = jnp.where(values[0] > least, jnp.linalg.solve(K, f), downhill)
    length = jnp.max(jnp.linalg.norm(step.reshape(-1, 6), axis=1))
    share = jnp.minimum(1.0, radius / jnp.where(length > 0, length, 1.0))
    return step * share, length * share, share


def _solved(outcomes: tuple[Outcome, ...]) -> Array:
    return jnp.all(jnp.stack([jnp.all(_balanced(one.status)) for one in outcomes]))


def _balanced(status: Array) -> Array:
    """Whether an arm is in equilibrium: on the way it may bend too fast for its steps."""
    return (status == Status.CONVERGED) | (status == Status.UNDER_RESOLVED)


def _root(whole: _Whole, found: _Search) -> Array:
    """Motions from the poses found, zero, with the first derivatives of the equilibrium: those of a
    Newton step."""
    if not found.wrench.size:
        return jnp.zeros_like(found.wrench)
    f = (whole.wrench(found.poses, whole.again(found.poses, found)) * whole.scale).reshape(-1)
    sound = jnp.all(jnp.isfinite(found.stiffness)) & found.sound
    K = jnp.where(sound, found.stiffness, jnp.eye(f.size, dtype=f.dtype))
    change = jnp.linalg.solve(K, f - lax.stop_gradient(f))
    return jnp.where(sound, change, 0.0)


def _judged(whole: _Whole, found: _Search) -> tuple[Array, Array]:
    """`Status` of a search, and the least eigenvalue of the stiffness in units of bending."""
    dtype, least = whole.inputs.dtype, jnp.full((), jnp.nan, whole.inputs.dtype)
    ended = found.size <= small(dtype)
    status = jnp.where(ended, Status.CONVERGED, Status.NOT_CONVERGED)
    if found.wrench.size:
        K = (found.stiffness + found.stiffness.T) / 2
        least = jnp.linalg.eigvalsh(K)[0] / whole.bending
        stable = least > jnp.finfo(dtype).eps ** 0.5
        status = jnp.where(ended & ~stable, Status.UNSTABLE, status)
    worst = jnp.max(jnp.concatenate([one.status for one in found.outcomes]))
    return jnp.where(found.sound & (status != Status.CONVERGED), status, worst), least
