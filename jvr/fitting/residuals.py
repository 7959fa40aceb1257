"""`jvr.residuals`: rendered minus target, for anyone's own solver."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.fitting.targets import check_images
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.rendering.render import render
from jvr.rendering.settings import Settings


def residuals(
    scene: Scene, cameras: Sequence[AbstractCamera], images: Any, settings: Settings = Settings()
) -> Float[Array, "cameras height width 3"] | list[Float[Array, "height width 3"]]:
    """Rendered minus target, `(cameras, height, width, 3)`, or a list of images where sizes differ.

    Differentiable as `jvr.render`; `settings.adjoint` says what is fast: `Replay()` gradients, `Rows()` Jacobians.
    **Raises** `ValueError` where the images do not fit the cameras.
    """
    targets = check_images(cameras, images)
    parts = [render(scene, camera, settings).rgb - target for camera, target in zip(cameras, targets, strict=True)]
    same = all(part.shape == parts[0].shape for part in parts)
    return jnp.stack(parts) if same else parts
