"""`view`: the page in the browser."""

import contextlib
import io
import sys
import threading
import webbrowser
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np
from PIL import Image

from ..arm.scene import Scene
from ..models.base import Model
from ..solution.equilibrium import Equilibrium
from ..typing import VectorLike
from ..validation import choice, instance
from ..viz.style import Theme, settings
from .coloring import colorings_of
from .panel import Panel, status_html
from .playback import Playable, Track, tracks_of
from .player import Player
from .session import Answer, Session
from .sliders import Chosen
from .stage import Stage
from .worker import Worker

_PICTURE = 1200
"""Greatest height and width of a saved picture [pixels]."""
_PATIENCE = 20.0
"""Seconds to wait for a picture from the browser."""


def view(
    scene: Scene | Equilibrium,
    inputs: VectorLike | None = None,
    *,
    numbers: Chosen = (),
    bounds: Any = None,
    model: Model | None = None,
    play: Playable = None,
    title: str = "",
    theme: Theme = "light",
    host: str = "localhost",
    port: int = 8080,
    browser: bool = True,
    block: bool | None = None,
) -> "View":
    """A page in the browser in which an arm is turned by hand.

    The wall of the arm is coloured by strain or stress, or its threads by their tension or
    pressure. Sliders move the inputs and the chosen numbers of the scene; each answer starts from
    the last equilibrium. Where there is none, the page says why and the last shape stays, dimmed.
    The tip can be dragged: `reach` finds the inputs that follow with the least change. Sweeps,
    paths with friction and designs are played frame by frame; the scene as it stands is saved as
    TOML, the picture as PNG. Needs `pip install "vsr-jax[viewer]"`.

    **Arguments:**
    - `scene`: a scene, or an equilibrium, whose inputs and model are the defaults.
    - `inputs`: one number per actuator, zeros by default. Their dtype is the precision.
    - `numbers`: names of numbers of the scene that get a slider, as of `design`
      (`"rod.material.young"`, `"actuators[*].routing.radius"`, `"loads[0].force[2]"`), or a mapping
      from names to ranges, a pair or None. By default from half to twice the number, shortened to
      numbers that the scene may have.
    - `bounds`: least and greatest inputs, as for `reach`; by default from 0 to twice the greatest
      input of the same kind, or what bends the arm by about 2 rad.
    - `model`: as for `solve`.
    - `play`: what can be played besides sweeps of the sliders: rows of inputs, shape
      (samples, actuators); the equilibria that `follow` returns; or a `Design`, its steps.
    - `title`: of the page and of the saved scene.
    - `theme`: `"light"` or `"dark"`.
    - `host`, `port`: where the page is served; the next free port if this one is taken.
    - `browser`: whether to open the page.
    - `block`: whether to wait until Ctrl-C; by default not in an interactive session.

    **Returns:** a `View`.

    **Raises:** `ValueError` for invalid inputs, unknown names, ranges that do not contain the
    number, and tracks of a wrong shape; `ImportError` without viser.
    """
    viser = viewer_library()
    choice("theme", theme, ("light", "dark"))
    if isinstance(scene, Equilibrium):
        scene.refuse_batch()
        inputs = scene.inputs if inputs is None else inputs
        model = scene.model if model is None else model
        scene = scene.given_scene
    instance("scene", scene, Scene, "a Scene or an Equilibrium")
    session = Session(scene, inputs, numbers=numbers, bounds=bounds, model=model, title=title)
    tracks = tracks_of(session, play)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a table
        server = viser.ViserServer(host=host, port=port, label=title or "vsr_jax", verbose=False)
    shown = View(server, session, tracks, theme)
    print(f"vsr_jax view: {shown.url} (Ctrl-C to end)", file=sys.stderr)
    if browser:
        webbrowser.open(shown.url)
    if not _is_interactive() if block is None else block:
        shown.wait()
    return shown


def _is_interactive() -> bool:
    ipython = sys.modules.get("IPython")
    return hasattr(sys, "ps1") or (ipython is not None and ipython.get_ipython() is not None)


def viewer_library() -> Any:
    """viser.

    **Raises:** `ImportError` that names the extra to install.
    """
    try:
        return import_module("viser")
    except ImportError:
        raise ImportError(
            'view: viser is not installed, need pip install "vsr-jax[viewer]"'
        ) from None


class View:
    """A page that is served.

    **Fields:** `url`; `session`: inputs, numbers and the last answer; `server`: the
    `viser.ViserServer`, which takes more than is drawn here. A `with` statement closes it.
    """

    def __init__(self, server: Any, session: Session, tracks: Sequence[Track], theme: Theme):
        self.session, self.server = session, server
        self._worker, self._ended = Worker(), threading.Event()
        self._stage = Stage(server, float(session.scene.rod.length))
        self._stage.theme(theme)
        values = [session.value(slider) for slider in session.sliders]
        self._panel = Panel(
            server.gui,
            session.sliders,
            values,
            colorings_of(session.scene),
            [track.name for track in tracks],
            theme,
        )
        self._tip = server.scene.add_transform_controls(
            "/tip",
            scale=0.13 * float(session.scene.rod.length),
            disable_rotations=True,
            depth_test=False,
            visible=False,
        )
        self._player = Player(self._panel, self._worker, session, tracks, self.show)
        self._pending: dict[str, float] = {}
        self._initial = session.answer.setting
        session.compiling = self._compiling
        self._connect()
        self._worker.post("first", self._first)

    @property
    def url(self) -> str:
        """Address of the page."""
        host = self.server.get_host()
        return f"http://{'localhost' if host == '0.0.0.0' else host}:{self.server.get_port()}"

    def wait(self) -> None:
        """Waits until Ctrl-C, or until the view is closed."""
        try:
            while not self._ended.wait(0.2):
                pass
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """Ends the page."""
        if not self._ended.is_set():
            self._ended.set()
            self._player.pause()
            self._worker.close()
            with contextlib.redirect_stdout(io.StringIO()):
                self.server.stop()

    def __enter__(self) -> "View":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def show(self, answer: Answer, *, slid: bool = False, dragged: bool = False) -> None:
        """Draws an answer; the sliders and the tip follow, unless they were moved by hand."""
        self._stage.draw(answer)
        self._panel.show(answer, self._stage.scale, self._stage.widening)
        if not slid:
            self._panel.sync({x.name: self.session.value(x) for x in self.session.sliders})
        if answer.shape is not None and not dragged:
            self._tip.position = answer.shape.tip
            self._tip.visible = self._panel.drag.value

    def move(self, values: dict[str, float]) -> threading.Event:
        """Moves sliders, given by their names in SI units, as a user does; the event is set when
        the answer is drawn."""
        self._player.pause()
        self._pending.update(values)
        return self._worker.post("move", lambda: self._answer_moves(slid=False))

    def drag(self, target: VectorLike) -> threading.Event:
        """Drags the tip to a position [m], as a user does; the event is set when the answer is
        drawn."""
        self._player.pause()
        return self._worker.post(
            "drag", lambda: self.show(self.session.drag(np.asarray(target)), dragged=True)
        )

    def _first(self) -> None:
        self.show(self.session.solve())
        self.session.prepare()

    def _compiling(self, program: str) -> None:
        self._panel.status.content = status_html(self.session.answer, program)
        self.server.flush()

    def _connect(self) -> None:
        panel = self._panel
        for name in panel.sliders:
            panel.on(panel.sliders[name][1], lambda event, name=name: self._slide(name))
        panel.on(panel.reset, lambda event: self._reset())
        panel.on(panel.color, lambda event: self._color())
        panel.on(panel.dark, lambda event: self._theme())
        panel.on(panel.drag, lambda event: self._redraw())
        panel.on(panel.save_scene, lambda event: self._save_scene(event.client))
        panel.on(panel.save_picture, lambda event: self._save_picture(event.client))
        self._tip.on_update(self._dragged)

    def _slide(self, name: str) -> None:
        self._player.pause()
        self._pending[name] = self._panel.value(name)
        self._worker.post("slide", lambda: self._answer_moves(slid=True))

    def _answer_moves(self, *, slid: bool) -> None:
        values: dict[str, float] = {}
        while self._pending:
            values.update([self._pending.popitem()])
        self.show(self.session.move(values), slid=slid)

    def _dragged(self, event: Any) -> None:
        if event.phase == "end":
            self._worker.post("drag ends", lambda: self.show(self.session.answer))
        else:
            self.drag(np.array(self._tip.position))

    def _reset(self) -> None:
        self._player.pause()
        self._worker.post("reset", lambda: self.show(self.session.solve(self._initial)))

    def _redraw(self) -> None:
        self._worker.post("redraw", lambda: self.show(self.session.answer))

    def _color(self) -> None:
        self._stage.color_by(self._panel.color.value)
        self._redraw()

    def _theme(self) -> None:
        self._stage.theme("dark" if self._panel.dark.value else "light")
        self._redraw()

    def _save_scene(self, client: Any) -> None:
        try:
            text = self.session.toml()
        except ValueError as error:
            client.add_notification("The scene cannot be saved", str(error), color="red")
            return
        client.send_file_download("scene.toml", text.encode(), save_immediately=True)

    def _save_picture(self, client: Any) -> None:
        camera = client.camera
        share = min(1.0, _PICTURE / max(camera.image_height, camera.image_width))
        size = [int(share * x) for x in (camera.image_height, camera.image_width)]
        picture = client.get_render(*size, transport_format="png", timeout=_PATIENCE)
        name: Theme = "dark" if self._panel.dark.value else "light"
        content = png(picture, settings(name)["axes.facecolor"])
        client.send_file_download("arm.png", content, save_immediately=True)


def png(picture: np.ndarray, paper: str) -> bytes:
    """A picture with transparency, shape (height, width, 4), as PNG on a background."""
    front = Image.fromarray(picture).convert("RGBA")
    back = Image.new("RGBA", front.size, paper)
    file = io.BytesIO()
    Image.alpha_composite(back, front).convert("RGB").save(file, "PNG")
    return file.getvalue()
