"""A message while a program compiles, which takes seconds to minutes."""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

SILENT = 3.0
"""Seconds after which a message appears."""

_waiting: ContextVar[threading.Timer | None] = ContextVar("waiting", default=None)


@contextmanager
def message_when_slow(text: str, *, start: bool = True, shown: bool = True) -> Iterator[None]:
    """Context that prints `text` to stderr if it is still open after `SILENT` seconds.

    **Arguments:** `start`: whether the time runs from the beginning, or from the first call of
    `compiling` within; `shown`: whether to print at all.
    """
    timer = threading.Timer(SILENT, print, [text], {"file": sys.stderr, "flush": True})
    timer.daemon = True
    token = _waiting.set(timer if shown else None)
    try:
        if start:
            compiling()
        yield
    finally:
        _waiting.reset(token)
        timer.cancel()


def compiling() -> None:
    """Starts the time of the innermost `message_when_slow`; a program calls it where it is traced,
    hence only if it is going to be compiled."""
    timer = _waiting.get()
    if timer is not None and not timer.is_alive() and not timer.finished.is_set():
        timer.start()
