"""The slider over frames and the play button."""

import threading
import time
from collections.abc import Callable, Sequence

from .panel import Panel
from .playback import SWEEPS, Track
from .session import Answer, Session
from .worker import Worker

_PERIOD = 1 / 20
"""Least time between two frames [s]."""


class Player:
    """Plays the tracks of a page.

    **Arguments:** the `panel`, the `worker` and the `session` of the page; the given `tracks`, to
    which the sweeps are added; `show`: function that draws an answer.
    """

    def __init__(
        self,
        panel: Panel,
        worker: Worker,
        session: Session,
        tracks: Sequence[Track],
        show: Callable[[Answer], None],
    ):
        self._panel, self._worker, self._session, self._show = panel, worker, session, show
        self._given = {track.name: track for track in tracks}
        self._track: Track | None = None
        self._run_now: object | None = None  # what the thread that plays was started with
        panel.on(panel.track, lambda event: self._forget())
        panel.on(panel.of, lambda event: self._forget())
        panel.on(panel.frame, lambda event: self._seek())
        panel.on(panel.play, lambda event: self._toggle())

    def pause(self) -> None:
        """Stops playing. The track remains."""
        self._run_now = None
        self._panel.play.label = "Play"

    def _forget(self) -> None:
        self.pause()
        self._track = None
        self._panel.frames(2, 0)

    def _seek(self) -> None:
        self.pause()
        self._worker.post("frame", self._show_frame)

    def _toggle(self) -> None:
        if self._run_now is not None:
            self.pause()
            return
        self._run_now = run = object()
        self._panel.play.label = "Pause"
        threading.Thread(target=self._run, args=(run,), name="vsr_jax play", daemon=True).start()

    def _run(self, run: object) -> None:
        self._worker.post("track", self._load).wait()
        if self._track is None:
            self.pause()
            return
        last = len(self._track.frames) - 1
        at = int(self._panel.frame.value)
        frames = range(at if at < last else 0, last + 1)
        for i in frames:
            if self._run_now is not run:
                return
            begun = time.perf_counter()
            self._panel.frame.value = i
            self._worker.post("frame", self._show_frame).wait()
            time.sleep(max(0.0, _PERIOD - (time.perf_counter() - begun)))
        self.pause()

    def _load(self) -> None:
        """Makes the chosen track, unless it is loaded."""
        if self._track is not None:
            return
        name, session = self._panel.track.value, self._session
        chosen = [x for x in session.sliders if x.name == self._panel.of.value]
        try:
            track = self._given[name] if name in self._given else SWEEPS[name](session, chosen[0])
        except ValueError as error:
            self._show(session.answer._replace(note=str(error)))
            return
        self._panel.frames(len(track.frames), 0)
        self._track = track

    def _show_frame(self) -> None:
        self._load()
        if self._track is not None:
            index = min(int(self._panel.frame.value), len(self._track.frames) - 1)
            self._show(self._track.show(self._session, index))
