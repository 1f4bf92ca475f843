"""Scenes on disk, as TOML.

Knows scenes. Must not know models.
"""

from .scene_file import SceneFile, load, parse_scene, save, to_toml

__all__ = ["SceneFile", "load", "parse_scene", "save", "to_toml"]
