"""A small fit that several test files share: three views of a smooth volume, whose transfer function is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jvr

SETTINGS = jvr.Settings(step=0.7, termination=0.0)
ENTRIES = 8


def _volume() -> jvr.Volume:
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n) for n in (12, 13, 11)], indexing="ij")
    values = 0.5 + 0.25 * np.sin(3 * x + y) + 0.25 * np.cos(2 * y - 3 * z)
    return jvr.Volume(values, np.diag([1.0, 1.2, 0.9, 1.0]))


def _truth() -> jvr.LutTransfer:
    x = np.linspace(0, 1, ENTRIES)
    rgb = np.stack([0.2 + 0.6 * x, 0.8 - 0.5 * x, 0.5 + 0.3 * np.sin(5 * x)], axis=1)
    return jvr.LutTransfer(rgb, 0.05 + 0.2 * np.square(np.sin(3 * x)), (0.0, 1.0))


VOLUME = _volume()
TRUTH = jvr.Scene(VOLUME, _truth(), background=(0.1, 0.2, 0.3))
CAMERAS = jvr.fibonacci_sphere(VOLUME.center, 30.0, 3, 30.0, 16, 15)
IMAGES = [np.asarray(jax.jit(jvr.render)(TRUTH, camera, SETTINGS).rgb) for camera in CAMERAS]
START = eqx.tree_at(lambda s: s.transfer, TRUTH, jvr.flat_transfer(VOLUME, ENTRIES))
START = eqx.tree_at(lambda s: s.transfer.domain, START, jnp.array([0.0, 1.0]))


def both(scene: jvr.Scene):
    return scene.transfer.rgb, scene.transfer.sigma_t


def fit(start=START, images=IMAGES, unknowns=both, **keywords) -> jvr.FitResult:
    keywords = {"settings": SETTINGS, "progress": False, **keywords}
    return jvr.fit(start, CAMERAS, images, unknowns=unknowns, **keywords)
