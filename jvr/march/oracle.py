"""Oracles belong to the integrator that asks them: `jvr.Slices`."""

from jvr.names import moved

MOVED = {name: f"jvr.{name}" for name in ("BrickRange", "Finest", "LocalError", "OpacityChange")}
__getattr__ = moved(__name__, MOVED)
