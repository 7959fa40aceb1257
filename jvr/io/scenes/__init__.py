"""Scenes as files: text that a person can read and edit, and long arrays beside it."""

from jvr.io.scenes.files import load_scene as load_scene
from jvr.io.scenes.files import save_scene as save_scene
