"""The controls of the page: status, sliders, colours, playback, files."""

import html
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .coloring import Scale
from .description import Shape
from .playback import SWEEPS
from .session import Answer
from .sliders import INPUTS, Slider
from .stage import load_color

_STEPS = 500
"""Least number of steps of a slider."""
_GOOD, _BAD, _BUSY = "#009E73", "#D55E00", "#E69F00"
"""Colours of the status."""


class Panel:
    """The controls, and what to call when one is used.

    **Arguments:**
    - `gui`: that of a viser server.
    - `sliders`: with their `values`.
    - `colorings`: names of the choices of colours.
    - `tracks`: names of what can be played besides the sweeps.

    **Fields:** the handles of the controls. Callbacks are attached by `on`, which leaves out
    changes that the program makes itself.
    """

    def __init__(
        self,
        gui: Any,
        sliders: Sequence[Slider],
        values: Sequence[float],
        colorings: Sequence[str],
        tracks: Sequence[str],
        theme: str,
    ):
        self.status = gui.add_html(status_html(None, ""))
        self.sliders: dict[str, tuple[Slider, Any]] = {}
        for title, inputs in (("Inputs", True), ("Numbers", False)):
            shown = [
                (x, v) for x, v in zip(sliders, values, strict=True) if (x.of == INPUTS) == inputs
            ]
            if shown:
                with gui.add_folder(title):
                    for slider, value in shown:
                        self.sliders[slider.name] = slider, _add(gui, slider, value)
        self.reset = gui.add_button("Reset")
        with gui.add_folder("Show"):
            self.color = gui.add_dropdown("colour", colorings, initial_value="strain")
            self.bar = gui.add_html("")
            self.loads = gui.add_html("")
            self.drag = gui.add_checkbox("drag the tip", bool(sliders) and sliders[0].of == INPUTS)
            self.dark = gui.add_checkbox("dark", theme == "dark")
        with gui.add_folder("Play"):
            choices = (*tracks, *(SWEEPS if sliders else ()))
            self.track = gui.add_dropdown("what", choices or ("nothing",))
            names = tuple(slider.name for slider in sliders)
            self.of = gui.add_dropdown("slider", names or ("none",))
            self.frame = gui.add_slider("frame", 0, 1, 1, 0)
            self.play = gui.add_button("Play")
        with gui.add_folder("Save"):
            self.save_scene = gui.add_button("Scene (TOML)")
            self.save_picture = gui.add_button("Picture (PNG)")

    def on(self, control: Any, act: Callable[[Any], None]) -> None:
        """Calls a function with the event when a user changes a control."""
        attach = control.on_click if hasattr(control, "on_click") else control.on_update
        attach(lambda event: None if event.client is None else act(event))

    def value(self, name: str) -> float:
        """The number of a slider as it stands in the page, in SI units."""
        slider, handle = self.sliders[name]
        return slider.in_si(float(handle.value))

    def sync(self, values: dict[str, float]) -> None:
        """Moves the sliders to numbers in SI units; numbers beyond a range show its end."""
        for name, (slider, handle) in self.sliders.items():
            value = float(np.clip(values[name], slider.low, slider.high))
            handle.value = value / slider.shown_unit[0]

    def show(self, answer: Answer, scale: Scale, widening: float) -> None:
        """Says what an answer shows."""
        self.status.content = status_html(answer, "")
        self.bar.content = scale.html()
        shape = answer.shape if answer.failure is None else None
        self.loads.content = loads_html(shape, widening)

    def frames(self, count: int, at: int) -> None:
        """Sets the number of frames and the frame."""
        self.frame.max = max(count - 1, 1)
        self.frame.value = at


def _add(gui: Any, slider: Slider, value: float) -> Any:
    factor, unit = slider.shown_unit
    low, high = slider.low / factor, slider.high / factor
    step = 10.0 ** np.floor(np.log10((high - low) / _STEPS))
    label = f"{slider.name} [{unit}]" if unit not in ("", "-") else slider.name
    return gui.add_slider(label, low, high, float(step), value / factor)


def status_html(answer: Answer | None, compiling: str) -> str:
    """The status for the page: whether this is an equilibrium, its margin, its tip."""
    color, lines = _BUSY, []
    if compiling:
        lines = [f"compiling {compiling} &hellip;"]
    elif answer is None or (answer.shape is None and answer.failure is None):
        lines = ["starting &hellip;"]
    elif answer.shape is None:
        color, lines = _BAD, ["no equilibrium", html.escape(answer.failure or "")]
    elif answer.failure is not None:
        color = _BAD
        lines = ["no equilibrium", html.escape(answer.failure), "dimmed: the last shape"]
    else:
        color, shape = _GOOD, answer.shape
        tip = ", ".join(f"{1e3 * x:.1f}" for x in shape.tip)
        lines = ["converged", f"stability margin {shape.margin:.3g}", f"tip ({tip}) mm"]
    if answer is not None and answer.note and not compiling:
        lines.append(html.escape(answer.note))
    body = "".join(f"<div>{line}</div>" for line in lines[1:])
    return (
        '<div style="padding:0.4em 0.9em;font-size:0.85em">'
        f'<div><b style="color:{color}">&#9679; {lines[0]}</b></div>{body}</div>'
    )


def loads_html(shape: Shape | None, widening: float) -> str:
    """The legend of arrows, and the factor by which the section is drawn wider."""
    lines = []
    for row in shape.loads if shape is not None else []:
        arrow = f'<span style="color:{load_color(row)}">&rarr;</span>'
        lines.append(f"<div>{arrow} {html.escape(row.caption)}</div>")
    if shape is not None and shape.body.slack is not None and bool(np.any(shape.body.slack)):
        lines.append("<div>dashed: slack tendon</div>")
    if widening > 1:
        lines.append(f"<div>section drawn {widening:g} times as wide</div>")
    return f'<div style="padding:0.2em 0.9em;font-size:0.8em">{"".join(lines)}</div>'
