r"""Rigid, fixed obstacles around an arm, each defined by its signed distance.

The distance $d(r)$ [m] from the surface of an obstacle to a point of the world is positive where
the arm may be and negative inside the obstacle. Its gradient is the unit normal of the surface, and
its second derivatives are the curvatures; both come from automatic differentiation and are finite
everywhere, also at centres, on axes and on edges, where the normal is not unique. The arm touches
an obstacle where the distance of its axis is the radius of its outline, `Rod.outline`.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import reduce
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.component import dot, join, norm, split
from ..typing import MatrixLike, Pose, Scalar, ScalarLike, VectorLike, real
from ..validation import concrete, numbers, rigid
from .description import Part
from .functions import Position, function_of_position


class Obstacle(Part):
    r"""A rigid obstacle fixed in the world. The arm must start outside it, and is pushed out of it
    where it crosses it at rest, to the side that is nearer (`solve(start=)` chooses another). One
    that `encloses` the arm is a lumen, in which the arm must start. One that an arm `lies_along`,
    as its contacts are seldom in separate places, may be touched by the ends of its steps too, if
    it has no friction.

    `friction` is the coefficient $\mu$ [-] of Coulomb friction between arm and obstacle, None
    without. It acts along a path of inputs: see `vsr_jax.follow`.
    """

    friction: Scalar | None = eqx.field(default=None, kw_only=True, metadata={"unit": "-"})
    effect: eqx.AbstractClassVar[str]
    encloses: ClassVar[bool] = False
    lies_along: ClassVar[bool] = False

    @abstractmethod
    def distance(self, point: VectorLike) -> Scalar:
        """Signed distance [m] from the surface to a point of the world: positive outside, where the
        arm may be. One point at a time; for several use `jax.vmap`."""

    @property
    def sizes(self) -> dict[str, Array]:
        """The numbers that must be positive, by name."""
        return {}

    @property
    def room(self) -> Scalar | None:
        """Radius [m] of the largest ball that passes everywhere along it, if it encloses the arm,
        else None."""
        return None

    def directions(
        self, point: VectorLike, heading: VectorLike, lengths: VectorLike
    ) -> Float[Array, "steps 3"] | None:
        """Unit vectors along the middle of one that encloses the arm, after steps of some lengths
        [m] from the place nearest to a point, in the direction that is nearer to a heading; None
        for the heading everywhere."""
        return None

    def check(self, name: str, outline: float) -> None:
        """Raises `ValueError` if an arm has no room, for known numbers. A scene calls this.

        **Arguments:** `name`: the obstacle's name in messages; `outline`: radius of the arm's
        outline [m] where it is greatest.
        """


def local_point(pose: Pose | None, point: VectorLike) -> Position:
    """A point of the world in the axes of a pose, $R^T (p - r)$; None is the identity."""
    point = real(point)
    if pose is None:
        return point
    apart = split(point - pose[:3, 3])
    return join(tuple(dot(split(pose[:3, j]), apart) for j in range(3)))


def coefficient(name: str, friction: ScalarLike | None) -> Scalar | None:
    """A coefficient of friction; None without."""
    return None if friction is None else numbers(f"{name}.friction", friction, least=0.0)


def _pose(name: str, pose: MatrixLike | None) -> Pose | None:
    return None if pose is None else rigid(name, pose)


def _distance_beyond(over: Float[Array, " sides"]) -> Scalar:
    """Distance to a box, or to what it is a section of, from the components by which a point is
    beyond each pair of its sides."""
    outside = jnp.where(over > 0, over, 0.0)
    # the derivative of jnp.max divides by the number of equal components, which is zero if XLA
    # recomputes them with other rounding
    inside = reduce(jnp.maximum, split(over))
    return jnp.where(inside <= 0, inside, norm(split(outside)))


class Plane(Obstacle):
    r"""The half space behind a plane, $d = n \cdot (r - p)$ with the unit normal $n$.

    **Arguments:**
    - `normal`: a vector of any length that points to the side where the arm may be.
    - `point`: $p$ [m], a point of the plane, the origin by default.
    - `friction`: coefficient $\mu$ [-], none by default.
    """

    normal: Float[Array, "3"] = eqx.field(metadata={"unit": "-"})
    point: Position = eqx.field(metadata={"unit": "m"})
    effect = "plane"
    lies_along = True

    def __init__(
        self,
        normal: VectorLike,
        point: VectorLike = (0.0, 0.0, 0.0),
        *,
        friction: ScalarLike | None = None,
    ):
        self.friction = coefficient("Plane", friction)
        self.normal = numbers("Plane.normal", normal, (3,))
        self.point = numbers("Plane.point", point, (3,))
        known = concrete(self.normal)
        if known is not None and not known.any():
            raise ValueError(f"Plane.normal: got {normal!r}, need a direction, not zeros")

    def distance(self, point: VectorLike) -> Scalar:
        normal = split(self.normal)
        return dot(normal, split(real(point) - self.point)) / norm(normal)

    @property
    def sizes(self) -> dict[str, Array]:
        return {"normal": norm(split(self.normal))}


class Sphere(Obstacle):
    r"""A ball, $d = |r - c| - R$.

    **Arguments:** `centre`: $c$ [m], shape (3,); `radius`: $R$ [m]; `friction`: coefficient $\mu$
    [-], none by default.
    """

    centre: Position = eqx.field(metadata={"unit": "m"})
    radius: Scalar = eqx.field(metadata={"unit": "m"})
    effect = "sphere"

    def __init__(
        self, centre: VectorLike, radius: ScalarLike, *, friction: ScalarLike | None = None
    ):
        self.friction = coefficient("Sphere", friction)
        self.centre = numbers("Sphere.centre", centre, (3,))
        self.radius = numbers("Sphere.radius", radius, positive=True)

    def distance(self, point: VectorLike) -> Scalar:
        return norm(split(real(point) - self.centre)) - self.radius

    @property
    def sizes(self) -> dict[str, Array]:
        return {"radius": self.radius}


class Cylinder(Obstacle):
    r"""A solid cylinder about the x axis of its pose.

    **Arguments:**
    - `radius`: [m].
    - `length`: [m], half of it on each side of the pose's origin; endless by default.
    - `pose`: of shape (4, 4), as from `vsr_jax.pose`; the identity by default.
    - `friction`: coefficient $\mu$ [-], none by default.
    """

    radius: Scalar = eqx.field(metadata={"unit": "m"})
    length: Scalar | None = eqx.field(metadata={"unit": "m"})
    pose: Pose | None = eqx.field(metadata={"unit": "-", "pose": True})
    effect = "cylinder"

    def __init__(
        self,
        radius: ScalarLike,
        *,
        length: ScalarLike | None = None,
        pose: MatrixLike | None = None,
        friction: ScalarLike | None = None,
    ):
        self.friction = coefficient("Cylinder", friction)
        self.radius = numbers("Cylinder.radius", radius, positive=True)
        self.length = None if length is None else numbers("Cylinder.length", length, positive=True)
        self.pose = _pose("Cylinder.pose", pose)

    def distance(self, point: VectorLike) -> Scalar:
        x, y, z = split(local_point(self.pose, point))
        around = norm((y, z)) - self.radius
        if self.length is None:
            return around
        return _distance_beyond(jnp.stack([around, jnp.abs(x) - 0.5 * self.length]))

    @property
    def sizes(self) -> dict[str, Array]:
        return {"radius": self.radius} | ({} if self.length is None else {"length": self.length})


class Box(Obstacle):
    r"""A cuboid whose centre and axes are those of its pose.

    **Arguments:**
    - `size`: its three sides [m], along x, y and z of the pose.
    - `pose`: of shape (4, 4), as from `vsr_jax.pose`; the identity by default.
    - `rounding`: radius of its edges and corners [m], within `size`; sharp by default.
    - `friction`: coefficient $\mu$ [-], none by default.
    """

    size: Float[Array, "3"] = eqx.field(metadata={"unit": "m"})
    pose: Pose | None = eqx.field(metadata={"unit": "-", "pose": True})
    rounding: Scalar = eqx.field(metadata={"unit": "m"})
    effect = "box"

    def __init__(
        self,
        size: VectorLike,
        *,
        pose: MatrixLike | None = None,
        rounding: ScalarLike = 0.0,
        friction: ScalarLike | None = None,
    ):
        self.friction = coefficient("Box", friction)
        self.size = numbers("Box.size", size, (3,), positive=True)
        self.pose = _pose("Box.pose", pose)
        known = concrete(self.size)
        most = jnp.inf if known is None else float(known.min()) / 2
        self.rounding = numbers("Box.rounding", rounding, least=0.0, most=most)

    def distance(self, point: VectorLike) -> Scalar:
        inner = 0.5 * self.size - self.rounding
        return _distance_beyond(jnp.abs(local_point(self.pose, point)) - inner) - self.rounding

    @property
    def sizes(self) -> dict[str, Array]:
        return {"size": jnp.min(self.size)}


class Field(Obstacle):
    r"""An obstacle of any shape, given by a signed distance.

    **Arguments:**
    - `function`: of a position [m], shape (3,), that returns the distance [m], written with
      `jax.numpy` and twice differentiable near the surface. The numbers of an equinox module are
      differentiable. A function that is not a distance, such as the value of a level set, must be
      divided by the length of its gradient.
    - `friction`: coefficient $\mu$ [-], none by default.

    **Raises:** `ValueError` for a function that does not return one number.
    """

    function: Callable
    effect = "distance field"

    def __init__(
        self, function: Callable[[Position], ScalarLike], *, friction: ScalarLike | None = None
    ):
        self.friction = coefficient("Field", friction)
        if not callable(function):
            raise ValueError(f"Field.function: got {function!r}, need a function of the position")
        self.function = function_of_position(function)
        shapes = [x.shape for x in jax.tree.leaves(jax.eval_shape(function, jnp.zeros(3)))]
        if shapes != [()]:
            found = shapes[0] if len(shapes) == 1 else f"{len(shapes)} arrays"
            raise ValueError(
                f"Field.function: got a function that returns "
                f"{f'shape {found}' if len(shapes) == 1 else found}, need a scalar"
            )

    def distance(self, point: VectorLike) -> Scalar:
        point = real(point)
        return jnp.asarray(self.function(point), point.dtype)
