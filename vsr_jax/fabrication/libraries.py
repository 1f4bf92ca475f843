"""Libraries that only exports need, imported when they are first used."""

from importlib import import_module
from typing import Any


def library(name: str) -> Any:
    """The library of a name.

    **Raises:** `ImportError` that names the extra to install.
    """
    try:
        return import_module(name)
    except ImportError:
        raise ImportError(
            f'export: {name} is not installed, need pip install "vsr-jax[fabrication]"'
        ) from None
