"""What is measured of a shape: positions of markers, poses, curvatures.

Another kind of measurement is a class with the fields `value`, `sd` and `name` and one method:

    class TipHeight(vsr.Observation):
        value: jax.Array  # (shapes, 1, 1)
        sd: jax.Array | None = None
        name: str = eqx.field(static=True, default="height")

        def predicted(self, eq):
            return eq.tip[2, 3].reshape(1, 1)

Its other floating-point fields can be unknowns of a fit, under the names `height.<field>`.
"""

from abc import abstractmethod
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.scene import Scene
from ..numerics.se3 import rotation_vector
from ..solution.equilibrium import Equilibrium
from ..typing import ArrayLike, MatrixLike, ScalarLike, real
from ..validation import instance, numbers, on_arm, rigid


class Observation(eqx.Module):
    """One kind of measurement, of every shape.

    **Fields:**
    - `value`: what was measured, the shapes along its first axis; NaN where nothing was.
    - `sd`: standard deviation of the noise, positive, of a shape that broadcasts against that of
      the residuals, (shapes, rows, components); None to estimate one number from the residuals.
    - `name`: first part of the names of its numbers.
    """

    value: eqx.AbstractVar[Array]
    sd: eqx.AbstractVar[Array | None]
    name: eqx.AbstractVar[str]

    @abstractmethod
    def predicted(self, eq: Equilibrium) -> Array:
        """What the model predicts for one shape, by default of shape (rows, components)."""

    def residual(self, eq: Equilibrium, value: ArrayLike) -> Float[Array, "rows components"]:
        """Predicted minus measured value of one shape; NaN where nothing was measured."""
        return self.predicted(eq) - real(value)

    @property
    def present(self) -> np.ndarray:
        """Whether each component was measured, shape (shapes, rows, components)."""
        return np.isfinite(np.asarray(self.value))

    @property
    def labels(self) -> tuple[str, ...]:
        """Name of each row."""
        return tuple(f"{self.name}[{i}]" for i in range(self.present.shape[1]))

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each row."""
        return ("",) * self.present.shape[1]

    @property
    def blank(self) -> Array:
        """A value of one shape for which the residual of a prediction has derivatives."""
        return jnp.zeros(self.value.shape[1:], self.value.dtype)

    @property
    def ratio(self) -> np.ndarray:
        """Standard deviations up to a common factor where `sd` is None, to be broadcast."""
        return np.ones(())

    def check(self, scene: Scene) -> None:
        """Validates the observation for a scene.

        **Raises:** `ValueError` for abscissas beyond the arm.
        """


def values(name: str, value: ArrayLike, *ends: tuple[int, ...]) -> Array:
    """`value` of shape (shapes, rows, *end) for one of the `ends`; a missing axis of rows is
    added."""
    array = numbers(name, value, None, finite=False)
    for end in ends:
        for rows in (1, 0):
            if array.ndim == 1 + rows + len(end) and array.shape[1 + rows :] == end:
                return array if rows else array[:, None]
    needed = " or ".join(
        f"(shapes, {text}) or (shapes, rows, {text})" if text else "(shapes,) or (shapes, rows)"
        for text in (", ".join(map(str, end)) for end in ends)
    )
    raise ValueError(f"{name}: got shape {array.shape}, need {needed}")


def _stations(name: str, X: ArrayLike | None, rows: int) -> Array | None:
    if X is None:
        if rows != 1:
            raise ValueError(f"{name}: got None for {rows} points, need an abscissa [m] for each")
        return None
    array = jnp.atleast_1d(numbers(name, X, None))
    if array.shape != (rows,):
        raise ValueError(f"{name}: got shape {array.shape}, need ({rows},), one for each point")
    return array


def deviation(name: str, sd: ArrayLike | None) -> Array | None:
    """`sd` as an array of positive numbers; None is none given."""
    return None if sd is None else numbers(name, sd, None, positive=True)


def _row_labels(name: str, labels: Sequence[str] | None, rows: int) -> tuple[str, ...]:
    if labels is None:
        return (name,) if rows == 1 else tuple(f"{name}[{i}]" for i in range(rows))
    if isinstance(labels, str) or len(labels) != rows:
        raise ValueError(f"{name}.labels: got {labels!r}, need {rows}, one for each row")
    return tuple(labels)


class Markers(Observation):
    r"""Positions of points that are fixed to sections: $r(X_j) + R(X_j) d_j$.

    **Arguments:**
    - `position`: measured positions [m], shape (shapes, points, 3), or (shapes, 3) for one point;
      NaN where a marker was not seen.
    - `X`: abscissas [m] of their sections, shape (points,); None is the tip, for one point.
    - `offset`: $d_j$ [m] in the frame of the section (x along the arm), shape (points, 3) or (3,);
      zero, the axis, by default.
    - `sd`: standard deviation of each coordinate [m]; None estimates it from the residuals.
    - `frame`: pose in the world of the frame in which the positions are given, a rigid transform of
      shape (4, 4); the world's frame by default.
    - `labels`: name of each point.
    - `name`: first part of the names of its numbers, as in `"markers.offset"`.
    - `labelled`: whether the positions of each shape are in the order of `X`. If not, a fit assigns
      them to the points, those of a shape all together: alternately each position to a point by the
      present unknowns, and the unknowns by least squares. Which is which depends on the start, so
      it should be nearer than half the distance of two markers, or there should be several.
      Positions that are missing go anywhere in the list. Needs SciPy.

    **Raises:** `ValueError` for wrong shapes, an `sd` that is not positive, a `frame` that is not a
    rigid transform, and unlabelled positions of which a coordinate is missing.
    """

    value: Float[Array, "..."]
    sd: Float[Array, "..."] | None
    X: Float[Array, " points"] | None = eqx.field(metadata={"unit": "m"})
    offset: Float[Array, "points 3"] = eqx.field(metadata={"unit": "m"})
    name: str = eqx.field(static=True)
    labelled: bool = eqx.field(static=True)
    _labels: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        position: ArrayLike,
        X: ArrayLike | None = None,
        *,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        sd: ArrayLike | None = None,
        frame: MatrixLike | None = None,
        labels: Sequence[str] | None = None,
        name: str = "markers",
        labelled: bool = True,
    ):
        value = values(f"{name}.position", position, (3,))
        rows = value.shape[1]
        self.X = _stations(f"{name}.X", X, rows)
        shift = numbers(f"{name}.offset", offset, None)
        if shift.shape not in ((3,), (rows, 3)):
            raise ValueError(f"{name}.offset: got shape {shift.shape}, need (3,) or ({rows}, 3)")
        self.offset = jnp.broadcast_to(shift, (rows, 3))
        if frame is not None:
            pose = rigid(f"{name}.frame", frame)
            value = value @ pose[:3, :3].T + pose[:3, 3]
        self.value, self.sd = value, deviation(f"{name}.sd", sd)
        self.name, self._labels = name, _row_labels(name, labels, rows)
        self.labelled = instance(f"{name}.labelled", labelled, bool, "True or False")
        seen = self.present
        if not labelled and np.any(seen.any(axis=2) != seen.all(axis=2)):
            raise ValueError(
                f"{name}.position: got positions without all three coordinates, need none or all "
                f"of them where labelled=False"
            )

    def predicted(self, eq: Equilibrium) -> Float[Array, "points 3"]:
        g = eq.tip[None] if self.X is None else eq.pose(self.X)
        return g[:, :3, 3] + jnp.einsum("nij,nj->ni", g[:, :3, :3], self.offset)

    @property
    def labels(self) -> tuple[str, ...]:
        return self._labels

    @property
    def units(self) -> tuple[str, ...]:
        return ("m",) * len(self._labels)

    def check(self, scene: Scene) -> None:
        if self.X is not None:
            on_arm(f"{self.name}.X", self.X, scene.greatest_length)


class Poses(Observation):
    r"""Poses of sections, as from an electromagnetic tracker. The residual of each is that of the
    position [m] and the rotation vector of $R_j^T R(X_j)$ [rad].

    **Arguments:**
    - `pose`: measured poses $(R_j, r_j)$ in the world, shape (shapes, points, 4, 4), or (shapes, 4,
      4) for one; a pose with a NaN is missing.
    - `X`: abscissas [m], shape (points,); None is the tip, for one point.
    - `sd`, `sd_angle`: standard deviations of each coordinate [m] and of each component of the
      rotation vector [rad]; None for both estimates one factor for 1 mm and 1 degree.
    - `labels`, `name`: as for `Markers`.

    **Raises:** `ValueError` for wrong shapes, and for one standard deviation without the other.
    """

    value: Float[Array, "..."]
    sd: Float[Array, "..."] | None
    X: Float[Array, " points"] | None = eqx.field(metadata={"unit": "m"})
    name: str = eqx.field(static=True)
    _labels: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        pose: ArrayLike,
        X: ArrayLike | None = None,
        *,
        sd: ScalarLike | None = None,
        sd_angle: ScalarLike | None = None,
        labels: Sequence[str] | None = None,
        name: str = "poses",
    ):
        self.value = values(f"{name}.pose", pose, (4, 4))
        rows = self.value.shape[1]
        self.X = _stations(f"{name}.X", X, rows)
        if (sd is None) != (sd_angle is None):
            raise ValueError(f"{name}.sd: got sd={sd!r} and sd_angle={sd_angle!r}, need both")
        self.sd = None
        if sd is not None and sd_angle is not None:
            ends = (
                numbers(f"{name}.sd", sd, positive=True),
                numbers(f"{name}.sd_angle", sd_angle, positive=True),
            )
            self.sd = jnp.repeat(jnp.stack(ends), rows)[:, None]
        self.name, self._labels = name, _row_labels(name, labels, rows)

    def predicted(self, eq: Equilibrium) -> Float[Array, "points 4 4"]:
        return eq.tip[None] if self.X is None else eq.pose(self.X)

    def residual(self, eq: Equilibrium, value: ArrayLike) -> Float[Array, "rows 3"]:
        g, value = self.predicted(eq), real(value)
        seen = jnp.all(jnp.isfinite(value), axis=(1, 2), keepdims=True)
        measured = jnp.where(seen, value, jnp.eye(4, dtype=g.dtype))
        turn = jnp.swapaxes(measured[:, :3, :3], 1, 2) @ g[:, :3, :3]
        found = jnp.stack([g[:, :3, 3] - measured[:, :3, 3], jax.vmap(rotation_vector)(turn)])
        return jnp.where(seen[None, :, 0], found, jnp.nan).reshape(-1, 3)

    @property
    def present(self) -> np.ndarray:
        seen = np.isfinite(np.asarray(self.value)).all(axis=(2, 3))
        return np.repeat(np.concatenate([seen, seen], axis=1)[..., None], 3, axis=2)

    @property
    def blank(self) -> Array:
        return jnp.broadcast_to(jnp.eye(4, dtype=self.value.dtype), self.value.shape[1:])

    @property
    def ratio(self) -> np.ndarray:
        return np.repeat([1e-3, np.pi / 180], len(self._labels))[:, None]

    @property
    def labels(self) -> tuple[str, ...]:
        return (*self._labels, *(f"{label} rotation" for label in self._labels))

    @property
    def units(self) -> tuple[str, ...]:
        return ("m",) * len(self._labels) + ("rad",) * len(self._labels)

    def check(self, scene: Scene) -> None:
        if self.X is not None:
            on_arm(f"{self.name}.X", self.X, scene.greatest_length)


class Curvatures(Observation):
    """Bending $(k_y, k_z)$ of sections, as from fibre Bragg gratings.

    **Arguments:**
    - `curvature`: measured $(k_y, k_z)$ [1/m], shape (shapes, points, 2), or (shapes, 2) for one
      point.
    - `X`: abscissas [m], shape (points,).
    - `sd` [1/m], `labels`, `name`: as for `Markers`.

    **Raises:** `ValueError` for wrong shapes and an `sd` that is not positive.
    """

    value: Float[Array, "shapes points 2"]
    sd: Float[Array, "..."] | None
    X: Float[Array, " points"] = eqx.field(metadata={"unit": "m"})
    name: str = eqx.field(static=True)
    _labels: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        curvature: ArrayLike,
        X: ArrayLike,
        *,
        sd: ArrayLike | None = None,
        labels: Sequence[str] | None = None,
        name: str = "curvatures",
    ):
        self.value = values(f"{name}.curvature", curvature, (2,))
        stations = _stations(f"{name}.X", X, self.value.shape[1])
        assert stations is not None
        self.X, self.sd = stations, deviation(f"{name}.sd", sd)
        self.name, self._labels = name, _row_labels(name, labels, self.value.shape[1])

    def predicted(self, eq: Equilibrium) -> Float[Array, "points 2"]:
        return eq.strain(self.X)[:, 1:3]

    @property
    def labels(self) -> tuple[str, ...]:
        return self._labels

    @property
    def units(self) -> tuple[str, ...]:
        return ("1/m",) * len(self._labels)

    def check(self, scene: Scene) -> None:
        on_arm(f"{self.name}.X", self.X, scene.greatest_length)
