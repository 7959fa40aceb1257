"""Calls what `test_execution.py` has exported, on a scene that is made anew."""

import sys
from pathlib import Path

import numpy as np
from jax import export
from scenes import small

import jvr

folder = Path(sys.argv[1])
jvr.use_export()
read = lambda name: export.deserialize(bytearray((folder / name).read_bytes()))
picture = read("picture").call(small())
gradient = read("gradient").call(small())
assert isinstance(picture, jvr.Rendering)
assert isinstance(gradient, jvr.LutTransfer)
np.savez(folder / "called.npz", rgb=picture.rgb, depth=picture.depth, colours=gradient.rgb)
