"""One thread that computes, with the newest of the waiting jobs of each kind."""

import threading
import traceback
from collections.abc import Callable

_PATIENCE = 5.0
"""Seconds to wait for the job that runs when the worker is closed."""


class Worker:
    """Runs jobs one after another. A job that has to wait is replaced by a newer one of its kind:
    a slider that moves faster than answers come does not make them late."""

    def __init__(self) -> None:
        self._jobs: dict[str, tuple[Callable[[], None], threading.Event]] = {}
        self._changed = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._work, name="vsr_jax view", daemon=True)
        self._thread.start()

    def post(self, kind: str, job: Callable[[], None]) -> threading.Event:
        """Adds a job; the event is set when it, or a newer one of its kind, is done."""
        with self._changed:
            done = self._jobs[kind][1] if kind in self._jobs else threading.Event()
            self._jobs[kind] = (job, done)
            self._changed.notify()
        return done

    def close(self) -> None:
        """Ends after the job that runs, without waiting for one that compiles for long."""
        with self._changed:
            self._open = False
            self._changed.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join(_PATIENCE)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or not self._open)
                if not self._open:
                    for _, done in self._jobs.values():
                        done.set()
                    return
                job, done = self._jobs.pop(next(iter(self._jobs)))
            try:
                job()
            except Exception:  # the page goes on; the cause is an error of the package
                traceback.print_exc()
            done.set()
