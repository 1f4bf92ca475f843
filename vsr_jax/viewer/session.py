"""The state behind the page, without the page: inputs and numbers as they stand, the last shape,
what is said about it.

Every answer comes from the same few compiled programs, whatever the inputs and the numbers are:
they are arrays of the scene, not constants of the programs.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..analysis.inverse import Reach, reach
from ..arm.plausible import quietly
from ..arm.scene import Scene
from ..arm.scene_numbers import parameters
from ..files.scene_file import to_toml
from ..models.base import Model
from ..models.strain_dependent import StrainDependent
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..typing import VectorLike, cast
from ..validation import instance
from ..viz.body import at_rest
from .description import Shape, shape_of
from .sliders import INPUTS, Chosen, Slider, input_sliders, number_sliders


class Setting(NamedTuple):
    """Inputs and numbers as they stand.

    **Fields:** `inputs`, one per actuator; `numbers`, the arrays of the scene that differ from the
    given scene, by name.
    """

    inputs: np.ndarray
    numbers: dict[str, np.ndarray]


class Answer(NamedTuple):
    """What the page shows.

    **Fields:** the `setting`; the last `shape`, None before the first one; the `failure` of this
    setting, None if `shape` is its equilibrium; a `note` about a tip that is out of reach.
    """

    setting: Setting
    shape: Shape | None = None
    failure: str | None = None
    note: str = ""


class Session:
    """A scene that is turned by hand.

    **Arguments:**
    - `scene`: the scene.
    - `inputs`: as for `solve`, by default those at rest. Their dtype is the precision.
    - `numbers`: names of numbers with a slider, or a mapping to their ranges, see
      `sliders.number_sliders`.
    - `bounds`: least and greatest inputs, see `sliders.input_sliders`.
    - `model`: as for `solve`.
    - `title`: of the saved scene.
    - `compiling`: function that is called with what is going to be compiled, and with "" after it.

    **Fields:** `sliders`; the last `answer`.

    **Raises:** `ValueError` for invalid inputs, names and ranges.
    """

    def __init__(
        self,
        scene: Scene,
        inputs: VectorLike | None = None,
        *,
        numbers: Chosen = (),
        bounds: Any = None,
        model: Model | None = None,
        title: str = "",
        compiling: Callable[[str], None] = lambda what: None,
    ):
        instance("scene", scene, Scene, "a Scene")
        given = scene.check_inputs(scene.rest_inputs if inputs is None else inputs)
        self.scene = cast(scene, given.dtype)
        self.model = StrainDependent() if model is None else model
        instance("model", self.model, Model, "StrainDependent(), Prescribed(basis) or Continuum()")
        self.title, self.compiling = title, compiling
        self._dtype = given.dtype
        values = np.asarray(given, float)
        self.sliders = (*input_sliders(scene, values, bounds), *number_sliders(scene, numbers))
        self._given = {name: np.asarray(x.value, float) for name, x in parameters(scene).items()}
        self._start: Equilibrium | None = None
        self._compiled: set[str] = set()
        self.answer = Answer(Setting(values, {}))

    @property
    def current(self) -> Scene:
        """The scene with the numbers as they stand.

        **Raises:** `ValueError` for numbers that it may not have.
        """
        return self.scene_of(self.answer.setting)

    def scene_of(self, setting: Setting) -> Scene:
        """The scene of a setting. Errors as for `current`."""
        with quietly():
            return self.scene.replace(setting.numbers) if setting.numbers else self.scene

    @property
    def input_ranges(self) -> list[tuple[float, float]]:
        """Least and greatest value of each input."""
        return [(slider.low, slider.high) for slider in self.sliders if slider.of == INPUTS]

    def value(self, slider: Slider) -> float:
        """The number of a slider as it stands."""
        inputs, numbers = self.answer.setting
        array = (
            inputs if slider.of == INPUTS else numbers.get(slider.of, self._given.get(slider.of))
        )
        return float(np.asarray(array)[slider.place])

    def typed(self, values: np.ndarray) -> Array:
        """Numbers in the precision of the session."""
        return jnp.asarray(values, self._dtype)

    def moved(self, values: Mapping[str, float]) -> Setting:
        """The present setting with other numbers of the sliders of these names."""
        inputs, numbers = self.answer.setting
        inputs, numbers = inputs.copy(), dict(numbers)
        for slider in self.sliders:
            if slider.name not in values:
                continue
            if slider.of == INPUTS:
                inputs[slider.place] = values[slider.name]
            else:
                array = np.array(numbers.get(slider.of, self._given[slider.of]))
                array[slider.place] = values[slider.name]
                numbers[slider.of] = array
        return Setting(inputs, numbers)

    def solve(self, setting: Setting | None = None, *, note: str = "") -> Answer:
        """Solves a setting, by default the present one, from the last equilibrium. Where there is
        no equilibrium the last shape stays."""
        setting = self.answer.setting if setting is None else setting
        try:
            scene = self.scene_of(setting)
            eq = self._solved(scene, setting.inputs)
        except ValueError as error:
            return self._failed(setting, " ".join(str(error).split()))
        if not bool(eq.converged):
            return self._failed(setting, eq.message, eq)
        self._start = eq
        return self._show(Answer(setting, self._shape(eq), None, note))

    def move(self, values: Mapping[str, float]) -> Answer:
        """Moves sliders, given by their names."""
        return self.solve(self.moved(values))

    def drag(self, target: Float[np.ndarray, "3"]) -> Answer:
        """Moves the tip to a position [m], or as near as the ranges of the inputs allow, with the
        least change of the inputs."""
        start = self._start
        if start is None or not len(start.inputs):
            return self.answer
        low, high = (self.typed(np.array([ends[i] for ends in self.input_ranges])) for i in (0, 1))
        zero = jnp.zeros((), self._dtype)
        near = Reach(start.inputs, start, zero, jnp.array(True), zero, zero)
        with self.first("the drag of the tip"):
            found = reach(
                start.given_scene,
                self.typed(target),
                (low, high),
                model=self.model,
                start=near,
                progress=False,
            )
            miss = float(found.miss)
        if not np.isfinite(miss):
            return self._show(self.answer._replace(note="no equilibrium there"))
        note = "" if bool(found.reached) else f"out of reach, the tip is {1e3 * miss:.2g} mm away"
        inputs = np.clip(np.asarray(found.inputs, float), np.asarray(low), np.asarray(high))
        return self.solve(self.answer.setting._replace(inputs=inputs), note=note)

    def display(self, eq: Equilibrium) -> Answer:
        """Shows an equilibrium that is given, as one of a path with friction."""
        setting = self.answer.setting._replace(inputs=np.asarray(eq.inputs, float))
        if not bool(eq.converged):
            return self._failed(setting, eq.message)
        return self._show(Answer(setting, self._shape(eq)))

    def prepare(self) -> None:
        """Compiles what the next answer needs."""
        if self.answer.shape is not None and self.answer.failure is None:
            self.solve()

    def toml(self) -> str:
        """The scene and its inputs as they stand, as the text of a scene file.

        **Raises:** `ValueError` as `vsr_jax.files.to_toml`.
        """
        return to_toml(self.current, self.typed(self.answer.setting.inputs), self.title)

    @contextmanager
    def first(self, program: str) -> Iterator[None]:
        """Context of a computation that compiles when it runs for the first time."""
        new = program not in self._compiled
        if new:
            self.compiling(program)
        try:
            yield
            self._compiled.add(program)
        finally:
            if new:
                self.compiling("")

    def _solved(self, scene: Scene, inputs: np.ndarray) -> Equilibrium:
        warm = scene.coupled and self.model.begins_near
        start = self._start if warm else None
        with self.first("the solve" if start is None else "the solve from a shape near by"):
            eq = solve(scene, self.typed(inputs), model=self.model, start=start)
            eq.status.block_until_ready()
        return eq

    def _shape(self, eq: Equilibrium) -> Shape:
        with self.first("the shape"):
            return shape_of(eq)

    def _failed(self, setting: Setting, message: str, eq: Equilibrium | None = None) -> Answer:
        shape = self.answer.shape
        if shape is None and eq is not None:
            with self.first("the arm at rest"):
                shape = shape_of(at_rest(eq))
        return self._show(Answer(setting, shape, message))

    def _show(self, answer: Answer) -> Answer:
        self.answer = answer
        return answer
