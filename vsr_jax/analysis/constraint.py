r"""Constraints of a design or of inverse statics: dimensionless margins, $g_k \ge 0$ where
satisfied."""

import dataclasses
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..arm.obstacles import Obstacle
from ..arm.scene import Scene
from ..mechanics.sizes import softest
from ..solution.equilibrium import Equilibrium
from ..typing import Scalar, ScalarLike
from ..validation import instances, numbers, positive
from .arms import Arms

_STATIONS = 65
"""Stations along the arm at which margins are sampled, less than 2 % of the length apart."""


class Constraint(eqx.Module):
    """Margins that must not be negative."""

    @abstractmethod
    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        """Margins, shape (margins,)."""

    def __str__(self) -> str:
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        texts = (f"{name}={_text(x)}" for name, x in fields.items() if x is not None)
        return f"{type(self).__name__}({', '.join(texts)})"


def _text(value: Any) -> str:
    """A number, or the kinds of several obstacles."""
    if not isinstance(value, tuple):
        return str(value)
    return f"[{', '.join(type(one).__name__ for one in value)}]"


def _stations(scene: Scene) -> Float[Array, " stations"]:
    length = scene.rod.length
    return length * jnp.linspace(0, 1, _STATIONS, dtype=length.dtype)


class Inside(Constraint):
    """Threads inside the section, or inside the rod's guides: (distance to the wall - `wall`) /
    distance of the axis to the wall.

    **Arguments:** `wall` [m]: least distance between a thread and the wall.
    """

    wall: Scalar

    def __init__(self, wall: ScalarLike = 0.0):
        self.wall = numbers("Inside.wall", wall, least=0.0)

    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        return arms.each_scene(self._room).reshape(-1)

    def _room(self, scene: Scene) -> Float[Array, " margins"]:
        rod, X = scene.rod, _stations(scene)
        zero = jnp.zeros_like(self.wall)
        middle = jax.vmap(lambda x: rod.clearance(zero, zero, x))(X)
        rows = []
        for actuator in scene.actuators:
            inside = jax.vmap(lambda x, a=actuator: rod.clearance(*a.routing(x), x))(X)
            rows.append(_where_laid((inside - self.wall) / middle, jax.vmap(actuator.reach)(X)))
        return jnp.concatenate(rows) if rows else jnp.ones(1, X.dtype)


class MinSpacing(Constraint):
    r"""Least distance between threads: $|d_i - d_j|^2 / g^2 - 1$ at stations along the arm, for
    every pair.

    **Arguments:** `gap`: g [m], between the centre lines of two threads.
    """

    gap: float = eqx.field(static=True)

    def __init__(self, gap: float):
        self.gap = positive("MinSpacing.gap", gap)

    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        return arms.each_scene(self._apart).reshape(-1)

    def _apart(self, scene: Scene) -> Float[Array, " margins"]:
        X, threads = _stations(scene), scene.actuators
        paths = [jax.vmap(actuator.routing)(X) for actuator in threads]
        reach = [jax.vmap(actuator.reach)(X) for actuator in threads]
        rows = []
        for i in range(len(threads)):
            for j in range(i):
                square = (paths[i][0] - paths[j][0]) ** 2 + (paths[i][1] - paths[j][1]) ** 2
                rows.append(_where_laid(_where_laid(square / self.gap**2 - 1, reach[i]), reach[j]))
        return jnp.concatenate(rows) if rows else jnp.ones(1, X.dtype)


def _where_laid(margins: Array, reach: Array | None) -> Array:
    return margins if reach is None else jnp.where(reach > 0, margins, 1.0)


class MaxTension(Constraint):
    r"""Bounded thread forces: $1 - |\tau_i| / \tau_1$. For free inputs that are forces, bounds have
    the same effect.

    **Arguments:** `force`: $\tau_1$ [N].
    """

    force: float = eqx.field(static=True)

    def __init__(self, force: float):
        self.force = positive("MaxTension.force", force)

    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        return 1 - jnp.abs(arms.each(lambda eq: eq.forces)).reshape(-1) / self.force


class BendRadius(Constraint):
    r"""Least bending radius of the axis: $1 - R^2 (k_y^2 + k_z^2)$ at stations along the arm.

    **Arguments:** `least`: R [m].
    """

    least: float = eqx.field(static=True)

    def __init__(self, least: float):
        self.least = positive("BendRadius.least", least)

    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        strain = arms.each(lambda eq: eq.strain(_stations(eq.scene)))
        return (1 - self.least**2 * (strain[..., 1] ** 2 + strain[..., 2] ** 2)).reshape(-1)


class StabilityMargin(Constraint):
    """Least stability margin: `eq.stability - least`.

    **Arguments:** `least`: between 0, the limit of stability, and 1, an arm without forces.
    """

    least: float = eqx.field(static=True)

    def __init__(self, least: float):
        self.least = positive("StabilityMargin.least", least)

    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        return arms.each(lambda eq: eq.stability) - self.least


class Clearance(Constraint):
    r"""Distance to obstacles: $(g - \lambda / k - d) / L$ with the gap g between an obstacle and
    the outline of the arm.

    Of the obstacles of the scene the gaps are those of `eq.contacts`. Where the arm touches them g
    is nearly zero however hard it presses; the contact force $\lambda$ then says how far it is from
    coming free, with the stiffness $k = 3 EI / L^3$ of the arm as a cantilever. With d = 0 the arm
    may touch, but not press.

    Other `obstacles`, which the scene does not have, do not push the arm: where the constraint is
    violated the arm may be inside them. Contact is then not solved: any model will do, and the time
    is a tenth or less. The gap is the least one near each of 65 stations along the arm.

    **Arguments:** `distance`: d [m]. `obstacles`: from which to keep clear; by default those of the
    scene.
    """

    distance: Scalar
    obstacles: tuple[Obstacle, ...] | None

    def __init__(
        self, distance: ScalarLike, obstacles: Sequence[Obstacle] | Obstacle | None = None
    ):
        self.distance = numbers("Clearance.distance", distance, least=0.0)
        self.obstacles = None
        if obstacles is not None:
            needed = "a Plane, Sphere, Tube or other obstacle"
            self.obstacles = instances("Clearance.obstacles", obstacles, Obstacle, needed)
            if not self.obstacles:
                raise ValueError(f"Clearance.obstacles: got none, need {needed}")

    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        if self.obstacles is None:
            _check_obstacles(arms, "Clearance", "in the scene or in Clearance(distance, obstacles)")
        return arms.each(self._far).reshape(-1)

    def _far(self, eq: Equilibrium) -> Float[Array, "obstacles places"]:
        gaps = _pressed(eq) if self.obstacles is None else _gaps(eq, self.obstacles)
        return (gaps - self.distance) / eq.scene.rod.length


def _pressed(eq: Equilibrium) -> Float[Array, "obstacles places"]:
    """Gaps to the obstacles of the scene [m], negative where the arm presses."""
    rod, contacts = eq.scene.rod, eq.contacts
    bending = softest(jax.vmap(rod.stiffness)(_stations(eq.scene)))
    return contacts.gap - contacts.force * rod.length**3 / (3 * jnp.mean(bending))


def _gaps(eq: Equilibrium, obstacles: tuple[Obstacle, ...]) -> Float[Array, "obstacles stations"]:
    """Least gap [m] to each obstacle near each station."""
    X = _stations(eq.scene)
    places, radius = eq.position(X), jax.vmap(eq.scene.rod.outline)(X)
    distances = [jax.vmap(one.distance)(places) for one in obstacles]
    return _least(jnp.stack(distances) - radius)


def _check_obstacles(arms: Arms, name: str, where: str) -> None:
    if not arms.scene.obstacles:
        raise ValueError(f"{name}: got a scene without obstacles, need obstacles {where}")


def _least(gaps: Float[Array, "*rest stations"]) -> Float[Array, "*rest stations"]:
    """Least gap within half a step from each station, by the parabola through its neighbours."""
    before, here, after = gaps[..., :-2], gaps[..., 1:-1], gaps[..., 2:]
    slope, bend = (after - before) / 2, before + after - 2 * here
    convex = bend > 0
    t = jnp.where(convex, jnp.clip(-slope / jnp.where(convex, bend, 1.0), -0.5, 0.5), 0.0)
    least = here + slope * t + 0.5 * bend * t**2
    return jnp.concatenate([gaps[..., :1], least, gaps[..., -1:]], axis=-1)


class MaxContactForce(Constraint):
    r"""Bounded contact with the obstacles of the scene: $1 - \sum \lambda / F$ for each obstacle,
    with the sum of its contact forces along the arm.

    **Arguments:** `force`: F [N].
    """

    force: float = eqx.field(static=True)

    def __init__(self, force: float):
        self.force = positive("MaxContactForce.force", force)

    def __call__(self, arms: Arms) -> Float[Array, " margins"]:
        _check_obstacles(arms, "MaxContactForce", "in the scene")
        forces = arms.each(lambda eq: eq.contacts.force)
        return 1 - jnp.sum(forces, axis=-1).reshape(-1) / self.force
