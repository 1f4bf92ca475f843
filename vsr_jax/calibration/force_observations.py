"""Forces that are measured of a shape: tensions of threads, support reactions, contact forces."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.held import Held
from ..arm.scene import Scene
from ..numerics.se3 import stacked_rotation
from ..solution.equilibrium import Equilibrium
from ..typing import ArrayLike, ScalarLike
from ..validation import numbers
from .observation import Observation, deviation, values


class Tensions(Observation):
    """Tensions of threads at their start, as from load cells: minus `eq.forces`.

    **Arguments:**
    - `tension`: measured tensions [N], shape (shapes, threads), or (shapes,) for one.
    - `actuators`: index of the actuator of each, from 0.
    - `sd` [N], `name`: as for `Markers`.

    **Raises:** `ValueError` for wrong shapes and an `sd` that is not positive.
    """

    value: Float[Array, "shapes threads 1"]
    sd: Float[Array, "..."] | None
    actuators: tuple[int, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(
        self,
        tension: ArrayLike,
        actuators: Sequence[int] | int,
        *,
        sd: ArrayLike | None = None,
        name: str = "tensions",
    ):
        self.value = values(f"{name}.tension", tension, ())[..., None]
        self.actuators = (actuators,) if isinstance(actuators, int) else tuple(actuators)
        if len(self.actuators) != self.value.shape[1]:
            raise ValueError(
                f"{name}.actuators: got {len(self.actuators)}, need {self.value.shape[1]}, one for "
                f"each column of tensions"
            )
        sizes = deviation(f"{name}.sd", sd)
        self.sd = sizes if sizes is None or sizes.ndim == 0 else sizes[..., None]
        self.name = name

    def predicted(self, eq: Equilibrium) -> Float[Array, "threads 1"]:
        return -eq.forces[jnp.array(self.actuators)][:, None]

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"{self.name}[{i}]" for i in self.actuators)

    @property
    def units(self) -> tuple[str, ...]:
        return ("N",) * len(self.actuators)


class Reactions(Observation):
    r"""Support reactions, as from a force and torque sensor behind a gripper. With the moment M and
    the force F by which a section is held, `eq.supports`, and the pose $(R_g, r_g)$ of the hold (of
    the world's axes at the section where its orientation is free), a sensor in the pose
    $(R_g \exp \tilde\varphi, r_g + R_g d)$ shows

    $$f = R_s^T F + f_0, \quad m = R_s^T (M - R_g d \times F) + m_0.$$

    A sensor that shows the push of the arm on the gripper has the other sign.

    **Arguments:**
    - `force`: measured forces f [N], shape (shapes, supports, 3), or (shapes, 3) for one.
    - `moment`: measured moments m [N m], of the same shape; none by default.
    - `held`: index of the held section of each, from 0.
    - `sd` [N], `sd_moment` [N m]: standard deviations; None estimates them from the residuals, with
      a moment the two up to a factor, for 1 N and 0.1 N m.
    - `name`: as for `Markers`.

    Unknowns of a fit are the `offset` [N] ($f_0$), `moment_offset` [N m] ($m_0$), `turn` [rad]
    ($\varphi$) and `place` [m] (d) of each sensor, zero at the start.

    **Raises:** `ValueError` for wrong shapes, an `sd` that is not positive, and one standard
    deviation without the other where moments are measured.
    """

    value: Float[Array, "shapes rows 3"]
    sd: Float[Array, "..."] | None
    offset: Float[Array, "supports 3"] = eqx.field(metadata={"unit": "N"})
    moment_offset: Float[Array, "supports 3"] | None = eqx.field(metadata={"unit": "N m"})
    turn: Float[Array, "supports 3"] = eqx.field(metadata={"unit": "rad"})
    place: Float[Array, "supports 3"] | None = eqx.field(metadata={"unit": "m"})
    held: tuple[int, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(
        self,
        force: ArrayLike,
        moment: ArrayLike | None = None,
        *,
        held: Sequence[int] | int = 0,
        sd: ScalarLike | None = None,
        sd_moment: ScalarLike | None = None,
        name: str = "reactions",
    ):
        forces = values(f"{name}.force", force, (3,))
        self.held = (held,) if isinstance(held, int) else tuple(held)
        count = len(self.held)
        _check_rows(f"{name}.force", forces, count, "held section")
        none = jnp.zeros((count, 3), forces.dtype)
        self.offset, self.turn = none, none
        self.value, self.moment_offset, self.place = forces, None, None
        if moment is not None:
            moments = values(f"{name}.moment", moment, (3,))
            if moments.shape != forces.shape:
                raise ValueError(
                    f"{name}.moment: got shape {moments.shape}, need {forces.shape}, as the forces"
                )
            self.value = jnp.concatenate([forces, moments], axis=1)
            self.moment_offset, self.place = none, none
        ends = [sd] if moment is None else [sd, sd_moment]
        known = [numbers(f"{name}.sd", x, positive=True) for x in ends if x is not None]
        if len(known) not in (0, len(ends)) or (moment is None and sd_moment is not None):
            raise ValueError(
                f"{name}.sd: got sd={sd!r} and sd_moment={sd_moment!r}, need one for each of what "
                f"is measured"
            )
        self.sd = jnp.repeat(jnp.stack(known), count)[:, None] if known else None
        self.name = name

    def predicted(self, eq: Equilibrium) -> Float[Array, "rows 3"]:
        wrenches = eq.supports[jnp.array(self.held)]
        axes = jnp.stack([self._axes(eq, i) for i in self.held])
        sensor = axes @ jax.vmap(stacked_rotation)(self.turn)
        found = [_in_axes(sensor, wrenches[:, 3:]) + self.offset]
        if self.moment_offset is not None and self.place is not None:
            lever = jnp.einsum("nij,nj->ni", axes, self.place)
            moment = wrenches[:, :3] - jnp.cross(lever, wrenches[:, 3:])
            found.append(_in_axes(sensor, moment) + self.moment_offset)
        return jnp.concatenate(found)

    def check(self, scene: Scene) -> None:
        _check_indices(f"{self.name}.held", self.held, len(scene.held), "held section")

    @staticmethod
    def _axes(eq: Equilibrium, i: int) -> Float[Array, "3 3"]:
        """Axes of what holds a section."""
        held = eq.scene.held[i]
        if isinstance(held, Held) and held.orientation is not None:
            return held.orientation
        return jnp.eye(3, dtype=eq.inputs.dtype)

    @property
    def ratio(self) -> np.ndarray:
        if self.moment_offset is None:
            return np.ones(())
        return np.repeat([1.0, 0.1], len(self.held))[:, None]

    @property
    def labels(self) -> tuple[str, ...]:
        forces = tuple(f"{self.name}[{i}]" for i in self.held)
        if self.moment_offset is None:
            return forces
        return (*forces, *(f"{label} moment" for label in forces))

    @property
    def units(self) -> tuple[str, ...]:
        count = len(self.held)
        return ("N",) * count + ("N m",) * (count * (self.moment_offset is not None))


class ContactForces(Observation):
    r"""Forces of obstacles on the arm, as from a force plate under each: in the world's axes
    $F = \sum \lambda n + f$ over its contacts, of which a sensor turned by $\exp \tilde\varphi$
    shows $\exp(\tilde\varphi)^T F + f_0$.

    **Arguments:**
    - `force`: measured forces [N], shape (shapes, obstacles, 3), or (shapes, 3) for one.
    - `obstacles`: index of the obstacle of each, from 0.
    - `sd` [N], `name`: as for `Markers`.

    Unknowns of a fit are the `offset` [N] ($f_0$) and the `turn` [rad] ($\varphi$) of each sensor,
    zero at the start.

    **Raises:** `ValueError` for wrong shapes and an `sd` that is not positive.
    """

    value: Float[Array, "shapes obstacles 3"]
    sd: Float[Array, "..."] | None
    offset: Float[Array, "obstacles 3"] = eqx.field(metadata={"unit": "N"})
    turn: Float[Array, "obstacles 3"] = eqx.field(metadata={"unit": "rad"})
    obstacles: tuple[int, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(
        self,
        force: ArrayLike,
        obstacles: Sequence[int] | int = 0,
        *,
        sd: ArrayLike | None = None,
        name: str = "contacts",
    ):
        self.value = values(f"{name}.force", force, (3,))
        self.obstacles = (obstacles,) if isinstance(obstacles, int) else tuple(obstacles)
        _check_rows(f"{name}.force", self.value, len(self.obstacles), "obstacle")
        none = jnp.zeros((len(self.obstacles), 3), self.value.dtype)
        self.offset, self.turn = none, none
        self.sd, self.name = deviation(f"{name}.sd", sd), name

    def predicted(self, eq: Equilibrium) -> Float[Array, "obstacles 3"]:
        found = eq.contacts
        each = found.force[..., None] * found.normal + found.friction
        total = jnp.sum(each, axis=1)[jnp.array(self.obstacles)]
        return _in_axes(jax.vmap(stacked_rotation)(self.turn), total) + self.offset

    def check(self, scene: Scene) -> None:
        _check_indices(f"{self.name}.obstacles", self.obstacles, len(scene.obstacles), "obstacle")

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"{self.name}[{i}]" for i in self.obstacles)

    @property
    def units(self) -> tuple[str, ...]:
        return ("N",) * len(self.obstacles)


def _check_rows(name: str, value: Array, count: int, what: str) -> None:
    if value.shape[1] != count:
        raise ValueError(f"{name}: got {value.shape[1]} rows, need {count}, one for each {what}")


def _check_indices(name: str, indices: Sequence[int], count: int, what: str) -> None:
    for i in indices:
        if not 0 <= i < count:
            raise ValueError(f"{name}: got {i}, need the index of one of {count} {what}s, from 0")


def _in_axes(axes: Float[Array, "n 3 3"], vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Components of vectors along the columns of rotations."""
    return jnp.einsum("nji,nj->ni", axes, vectors)
