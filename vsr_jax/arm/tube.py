"""A lumen inside which the arm runs: a vessel, a bore or a bent tube."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..numerics.component import norm, split
from ..numerics.loops import fori_loop, scan
from ..numerics.quadrature import ascending
from ..typing import MatrixLike, Pose, Scalar, ScalarLike, VectorLike, real
from ..validation import concrete, numbers, rigid
from .functions import Position
from .obstacles import Obstacle, coefficient, local_point
from .profile import Constant, Profile, ProfileLike, as_profile
from .spline import spline_slopes

_SAMPLES = 8
"""Samples of the centre line per point, from the best of which Newton's method starts."""
_STEPS = 8
"""Newton steps to the nearest point; the last one or two change nothing."""


class Tube(Obstacle):
    r"""A lumen inside which the arm runs, $d = \max_s (R(s) - |r - c(s)|)$: the union of the balls
    of radius R(s) about the points of a centre line c(s), positive inside.

    Outside the lumen this is the exact distance to it. Inside, it never exceeds the distance to the
    wall, and equals it where the line bends less sharply than the lumen is wide. The lumen is open:
    beyond the ends it continues straight. The arm must be inside it at X = 0 and may be outside
    elsewhere at rest.

    **Arguments:**
    - `radius`: $R$ [m], a number, or with a line a profile without jumps of the abscissa s along
      it.
    - `line`: points of the centre line [m], shape (points, 3), in the axes of the pose. Two points
      are a straight line, more a cubic not-a-knot spline over the abscissa, which is the sum of the
      distances between the points. By default the x axis, endless.
    - `pose`: of shape (4, 4), as from `vsr_jax.pose`; the identity by default.
    - `friction`: coefficient $\mu$ [-], none by default.

    **Raises:** `ValueError` for fewer than two points, for consecutive points that coincide, and
    for a profile without a line.
    """

    radius: Profile = eqx.field(metadata={"unit": "m"})
    line: Float[Array, "points 3"] | None = eqx.field(metadata={"unit": "m"})
    pose: Pose | None = eqx.field(metadata={"unit": "-", "pose": True})
    effect = "tube"
    encloses = lies_along = True

    def __init__(
        self,
        radius: ProfileLike,
        line: MatrixLike | None = None,
        *,
        pose: MatrixLike | None = None,
        friction: ScalarLike | None = None,
    ):
        self.friction = coefficient("Tube", friction)
        self.radius = as_profile("Tube.radius", radius, positive=True)
        self.line = None if line is None else _points("Tube.line", line)
        self.pose = None if pose is None else rigid("Tube.pose", pose)
        if self.line is None and not isinstance(self.radius, Constant):
            raise ValueError(
                f"Tube.radius: got {radius!r} and no line, need a number for a tube without a line"
            )

    def distance(self, point: VectorLike) -> Scalar:
        local = local_point(self.pose, point)
        if self.line is None:
            zero = jnp.zeros_like(local[0])
            return self.radius(zero, zero) - norm((local[1], local[2]))
        curve = curve_through(self.line, self.radius)
        s, stationary = _nearest(lax.stop_gradient(curve), lax.stop_gradient(local))
        # one step whose derivative is that of the nearest point: the distance, stationary in s,
        # then has exact derivatives up to the third
        rate, slope = _stationarity(curve, local, s)
        step = rate / lax.stop_gradient(jnp.where(stationary, slope, -1.0))
        return curve.depth(local, s - jnp.where(stationary, step, 0.0))

    def check(self, name: str, outline: float) -> None:
        narrowest = concrete(jnp.min(self.radii))
        if narrowest is not None and not narrowest > outline:
            raise ValueError(
                f"{name}.radius: got {narrowest:g} m at the narrowest place, need more than the "
                f"radius of the arm's outline, {outline:g} m"
            )

    @property
    def radii(self) -> Float[Array, " samples"]:
        """Radius [m] at samples along the line."""
        if self.line is None:
            zero = jnp.zeros(())
            return self.radius(zero, zero)[None]
        curve = curve_through(self.line, self.radius)
        return jax.vmap(curve.width)(curve.samples)

    @property
    def sizes(self) -> dict[str, Array]:
        return {"radius": jnp.min(self.radii)}

    @property
    def room(self) -> Scalar:
        return jnp.min(self.radii)

    def directions(
        self, point: VectorLike, heading: VectorLike, lengths: VectorLike
    ) -> Float[Array, "steps 3"] | None:
        heading, lengths = real(heading), real(lengths)
        turn = jnp.eye(3, dtype=lengths.dtype) if self.pose is None else self.pose[:3, :3]
        if self.line is None:
            along = jnp.sign(turn[:, 0] @ heading) * turn[:, 0]
            return jnp.broadcast_to(along, (lengths.size, 3))
        curve = curve_through(self.line, self.radius)
        start, _ = _nearest(curve, local_point(self.pose, point))
        forth = jnp.sign(turn @ curve.at(start)[1] @ heading)

        def rate(s: Scalar) -> Scalar:
            return forth / jnp.linalg.norm(curve.at(s)[1])

        def walk(s: Scalar, h: Scalar) -> tuple[Scalar, Position]:
            s = s + h * rate(s + 0.5 * h * rate(s))
            return s, turn @ curve.at(s)[1] * rate(s)

        return scan(walk, start, lengths)[1]


class Curve(NamedTuple):
    """A centre line: the abscissas [m] of its points; the start of each piece [m] and its
    coefficients in ascending order, the straight ends included; and the radius along it."""

    knots: Float[Array, " points"]
    starts: Float[Array, " pieces"]
    coefficients: Float[Array, "pieces 4 3"]
    radius: Profile

    @property
    def samples(self) -> Float[Array, " samples"]:
        """Abscissas [m] of samples, evenly between the points, and where the radius has kinks."""
        share = jnp.linspace(0.0, 1.0, _SAMPLES, endpoint=False, dtype=self.knots.dtype)
        inner = self.knots[:-1, None] + share * jnp.diff(self.knots)[:, None]
        samples = jnp.append(inner.reshape(-1), self.knots[-1])
        kinks = [jnp.clip(x, 0, self.knots[-1])[None] for x in self.radius.breakpoints]
        return ascending(jnp.concatenate([samples, *kinks])) if kinks else samples

    def at(self, s: Scalar) -> tuple[Position, Array, Array]:
        """Point at an abscissa [m], and its first two derivatives."""
        i = jnp.sum(s >= self.knots)
        t, (a, b, c, d) = s - self.starts[i], self.coefficients[i]
        return a + t * (b + t * (c + t * d)), b + t * (2 * c + 3 * t * d), 2 * c + 6 * t * d

    def width(self, s: Scalar) -> Scalar:
        """Radius [m] at an abscissa [m]; that of the nearest end beyond the ends."""
        return self.radius(jnp.clip(s, self.knots[0], self.knots[-1]), self.knots[-1])

    def depth(self, point: Position, s: Scalar) -> Scalar:
        """Depth [m] of a point in the ball at an abscissa [m]."""
        return self.width(s) - norm(split(point - self.at(s)[0]))


def curve_through(points: Float[Array, "points 3"], radius: Profile) -> Curve:
    """The centre line through points: two give a straight line."""
    h = jnp.linalg.norm(jnp.diff(points, axis=0), axis=1)
    knots = jnp.concatenate([jnp.zeros(1, points.dtype), jnp.cumsum(h)])
    slopes = jax.vmap(spline_slopes, (None, 1), 1)(knots, points)
    h, left, right = h[:, None], slopes[:-1], slopes[1:]
    secant = jnp.diff(points, axis=0) / h
    bend, change = (3 * secant - 2 * left - right) / h, (left + right - 2 * secant) / h**2
    inner = jnp.stack([points[:-1], left, bend, change], axis=1)
    zero = jnp.zeros_like(points[0])
    ends = [jnp.stack([points[i], slopes[i], zero, zero])[None] for i in (0, -1)]
    starts = jnp.concatenate([knots[:1], knots])
    return Curve(knots, starts, jnp.concatenate([ends[0], inner, ends[1]]), radius)


def _stationarity(curve: Curve, point: Position, s: Scalar) -> tuple[Scalar, Scalar]:
    """Derivative of the depth in s, times the distance to the line, and its derivative in s."""

    def widening(s: Scalar) -> Scalar:
        return jax.jvp(curve.width, (s,), (jnp.ones_like(s),))[1]

    centre, tangent, bend = curve.at(s)
    first, second = jax.jvp(widening, (s,), (jnp.ones_like(s),))
    apart = point - centre
    away, along = norm(split(apart)), jnp.sum(apart * tangent)
    approach = along / jnp.where(away > 0, away, 1.0)
    rate = along + first * away
    slope = jnp.sum(apart * bend) - jnp.sum(tangent**2) + second * away - first * approach
    return rate, slope


def _nearest(curve: Curve, point: Position) -> tuple[Scalar, Bool[Array, ""]]:
    """Abscissa of the deepest ball [m]: the best of the samples and of the two straight ends,
    improved by Newton steps that stay between its neighbours; and whether the depth is stationary
    there, which it is not where the radius has a kink."""
    samples, length = curve.samples, curve.knots[-1]
    first, last = (
        jnp.sum((point - end) * tangent) / jnp.sum(tangent**2)
        for end, tangent in (curve.coefficients[i, :2] for i in (0, -1))
    )
    first, last = jnp.minimum(first, 0.0)[None], length + jnp.maximum(last, 0.0)[None]
    tried = jnp.concatenate([first, samples, last])
    best = jnp.argmax(jax.vmap(curve.depth, (None, 0))(point, tried))
    ends = jnp.concatenate([first - length, tried, last + length])

    def improve(_: Array, bracket: tuple[Scalar, Scalar, Scalar]) -> tuple[Scalar, Scalar, Scalar]:
        low, s, high = bracket
        rate, slope = _stationarity(curve, point, s)
        low, high = jnp.where(rate > 0, s, low), jnp.where(rate > 0, high, s)
        newton = s - rate / jnp.where(slope < 0, slope, -1.0)
        sound = (slope < 0) & (newton >= low) & (newton <= high)
        return low, jnp.where(sound, newton, 0.5 * (low + high)), high

    # two neighbours away: the nearest one may be the same place
    start = ends[jnp.maximum(best - 1, 0)], tried[best], ends[jnp.minimum(best + 3, ends.size - 1)]
    found = fori_loop(0, _STEPS, improve, start)[1]
    s = jnp.where(curve.depth(point, found) > curve.depth(point, start[1]), found, start[1])
    rate, slope = _stationarity(curve, point, s)
    depth = curve.depth(point, s)
    rounding = 8 * jnp.finfo(s.dtype).eps * (length + jnp.abs(depth))
    further = curve.depth(point, s - rate / jnp.where(slope < 0, slope, -1.0))
    return s, (slope < 0) & (further >= depth - rounding)


def _points(name: str, line: MatrixLike) -> Float[Array, "points 3"]:
    points = numbers(name, line, None)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
        raise ValueError(f"{name}: got shape {points.shape}, need (points, 3), two points or more")
    known = concrete(points)
    if known is not None and not np.all(np.any(np.diff(known, axis=0) != 0, axis=1)):
        i = int(np.argmin(np.any(np.diff(known, axis=0) != 0, axis=1)))
        raise ValueError(
            f"{name}: got the point {known[i].tolist()} twice in a row, need points apart"
        )
    return points
