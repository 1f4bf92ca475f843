"""What the page plays: sweeps of a slider, paths with friction, rows of inputs, the steps of a
design.

A track is a list of frames, each a setting that is solved when it is shown, or an equilibrium that
is known.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from ..analysis.following import follow
from ..optimization.design_search import Design
from ..optimization.problem import INPUTS
from ..solution.equilibrium import Equilibrium
from ..validation import numbers
from .session import Answer, Session, Setting
from .sliders import Slider

FRAMES = 61
"""Frames of a sweep, and of each way of a path."""

Playable: TypeAlias = Any
"""Rows of inputs, shape (samples, actuators); an `Equilibrium` with a batch axis, as of `follow`;
or a `Design`."""

Frame: TypeAlias = Setting | Equilibrium


class Track(NamedTuple):
    """A name and frames, in order."""

    name: str
    frames: Sequence[Frame]

    def show(self, session: Session, index: int) -> Answer:
        """Shows a frame."""
        frame = self.frames[index]
        return session.display(frame) if isinstance(frame, Equilibrium) else session.solve(frame)


def sweep_of(session: Session, slider: Slider) -> Track:
    """A slider from its least to its greatest value, everything else as it stands."""
    values = np.linspace(slider.low, slider.high, FRAMES)
    return Track("sweep", [session.moved({slider.name: x}) for x in values])


def path_of(session: Session, slider: Slider) -> Track:
    """An input from its least to its greatest value and back by `follow`, where friction remembers
    where the arm comes from."""
    if slider.of != INPUTS:
        raise ValueError(f"slider: got {slider.name}, need an input for a path with friction")
    model = session.model
    if not model.remembers:
        raise ValueError(f"model: got {model}, need a StrainDependent for a path with friction")
    way = np.linspace(slider.low, slider.high, FRAMES)
    inputs = np.tile(session.answer.setting.inputs, (2 * FRAMES, 1))
    inputs[:, slider.place[0]] = np.concatenate([way, way[::-1]])
    with session.first("the path"):
        path = follow(session.current, session.typed(inputs), model=model)
        path = jax.block_until_ready(path)
    return Track("path", _frames_of(path))


SWEEPS: dict[str, Callable[[Session, Slider], Track]] = {
    "sweep": sweep_of,
    "there and back, with friction": path_of,
}
"""Tracks of a slider by name."""


def tracks_of(session: Session, play: Playable | Sequence[Playable] | None) -> list[Track]:
    """The tracks of `view(play=)`: one for each set of inputs of a design, one for all others.

    **Raises:** `ValueError` for anything else, and inputs of a wrong shape or out of range.
    """
    if play is None:
        return []
    if isinstance(play, Design):
        return _design_tracks(session, play)
    if isinstance(play, Equilibrium):
        if jnp.ndim(play.status) != 1:
            raise ValueError(
                f"play: got an equilibrium of batch shape {jnp.shape(play.status)}, need one batch "
                f"axis, as that of follow"
            )
        return [Track("path", _frames_of(play))]
    rows = np.asarray(numbers("play", play, None), float)
    size = len(session.scene.inputs)
    if rows.ndim != 2 or rows.shape[1] != size or not len(rows):
        raise ValueError(
            f"play: got shape {rows.shape}, need (samples, {size}), one row of inputs per frame"
        )
    for row in rows:
        session.scene.check_inputs(row)
    return [Track("inputs", [session.answer.setting._replace(inputs=row) for row in rows])]


def _frames_of(path: Equilibrium) -> list[Frame]:
    arrays, rest = jax.tree.flatten(path)
    known = [np.asarray(x) for x in arrays]
    return [
        jax.tree.unflatten(rest, [jnp.asarray(x[i]) for x in known]) for i in range(len(known[0]))
    ]


def _design_tracks(session: Session, design: Design) -> list[Track]:
    """The steps of the best start, then the design, for each set of inputs."""
    steps = {
        name: np.asarray(x, float)[:, design.best] for name, x in design.history.numbers.items()
    }
    final = {name: np.asarray(x, float) for name, x in design.numbers.items()}
    tracks = []
    for i, last in enumerate(np.asarray(design.inputs, float)):
        inputs = steps[INPUTS][:, i] if INPUTS in steps else [last] * len(design.history.objective)
        frames: list[Frame] = [
            Setting(np.asarray(row), {name: x[j] for name, x in steps.items() if name != INPUTS})
            for j, row in enumerate(inputs)
        ]
        name = "design" if len(design.inputs) == 1 else f"design, inputs {i}"
        tracks.append(Track(name, [*frames, Setting(last, final)]))
    return tracks
