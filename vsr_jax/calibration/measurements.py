"""A set of recorded shapes: inputs, what was measured of each, and the series it belongs to."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..typing import ArrayLike
from ..validation import instance, numbers
from .observation import Observation


class Measurements(eqx.Module):
    """Shapes of an arm that were measured.

        data = vsr.Measurements(
            tensions, vsr.Markers(positions, X=[0.1, 0.2], sd=2e-4), series=["A", "A", "B"]
        )

    **Arguments:**
    - `inputs`: as recorded, shape (shapes, actuators). Their dtype is the precision of the fit.
    - `observations`: `Markers`, `Poses`, `Curvatures`, `Tensions`, or an `Observation` of your own;
      several with different names.
    - `series`: name of the series of recordings that each shape belongs to; between series the base
      may have moved. One series by default.

    **Raises:** `ValueError` if there are no shapes or no measurements, or if their numbers differ.
    """

    inputs: Float[Array, "shapes actuators"]
    observations: tuple[Observation, ...]
    series: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        inputs: ArrayLike,
        observations: Observation | Sequence[Observation],
        *,
        series: Sequence[str] | None = None,
    ):
        array = numbers("inputs", inputs, None)
        if array.ndim != 2 or not len(array):
            raise ValueError(
                f"inputs: got shape {array.shape}, need (shapes, actuators), at least one shape"
            )
        given = (observations,) if isinstance(observations, Observation) else tuple(observations)
        for i, one in enumerate(given):
            instance(f"observations[{i}]", one, Observation, "a Markers or other Observation")
            if len(one.value) != len(array):
                raise ValueError(
                    f"{one.name}: got {len(one.value)} shapes, need {len(array)}, as inputs"
                )
            _check_sd(one)
        names = [one.name for one in given]
        if len(set(names)) < len(names):
            raise ValueError(f"observations: got the names {', '.join(names)}, need different ones")
        if not any(one.present.any() for one in given):
            raise ValueError("observations: got no measured value, need at least one")
        self.series = ("",) * len(array) if series is None else tuple(map(str, series))
        if len(self.series) != len(array):
            raise ValueError(f"series: got {len(self.series)} names, need {len(array)}, as inputs")
        self.inputs, self.observations = array, given

    def __len__(self) -> int:
        return len(self.series)

    @property
    def groups(self) -> tuple[str, ...]:
        """The series, each once, in order of appearance."""
        return tuple(dict.fromkeys(self.series))

    @property
    def present(self) -> np.ndarray:
        """Whether each measured number is there, shape (shapes, numbers)."""
        parts = [one.present.reshape(len(self), -1) for one in self.observations]
        return np.concatenate(parts, axis=1)


def _check_sd(one: Observation) -> None:
    if one.sd is None:
        return
    shape = one.present.shape
    if not np.all(np.asarray(one.sd) > 0):
        raise ValueError(f"{one.name}.sd: got {np.asarray(one.sd)}, need numbers > 0")
    try:
        fits = np.broadcast_shapes(one.sd.shape, shape) == shape
    except ValueError:
        fits = False
    if not fits:
        raise ValueError(
            f"{one.name}.sd: got shape {one.sd.shape}, need one that broadcasts to {shape}"
        )
