"""What a rendering gives: a picture, and what it took."""

import os
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.names import moved
from jvr.types import Image

MOVED = {"render": "jvr.render"}
__getattr__ = moved(__name__, MOVED)


class RenderStats(eqx.Module):
    """What a rendering took: `steps`, segments sampled for each pixel, `(height, width)`; what `Settings(sampling=...)` left out, and what
    `Scene(shadows=...)` has to report (`jvr.DeepShadowMap`), each `None` where that is nothing."""

    steps: Int[Array, "height width"]
    sampling: Any = None
    shadows: Any = None

    @property
    def samples(self) -> Int[Array, ""]:
        """Samples taken for the whole picture, counted once where segments share them."""
        return jnp.sum(getattr(self.sampling, "samples", self.steps))


class Rendering(eqx.Module):
    """A picture, row 0 at the top.

    - `rgb`: `(height, width, 3)`, linear radiance; includes `T` times what is behind the medium, a background or geometry.
    - `alpha`: `(height, width)`, opacity of the medium, `1 - mean(T)`; 1 where opaque geometry is behind it.
    - `depth`: `(height, width)`, `sum T (1 - exp(-dtau)) t / alpha`, distance from the eye along the ray, geometry included; 0 where alpha
      is 0.
    - `stats`: `RenderStats`.
    """

    rgb: Image
    alpha: Float[Array, "height width"]
    depth: Float[Array, "height width"]
    stats: RenderStats

    def save(self, path: str | os.PathLike, *, transparent: bool = False) -> None:
        """Writes the picture: `.png` as sRGB, or `.exr` as linear radiance with the depth as channel Z.

        `transparent`: with alpha, for pictures of a scene without a background, whose `rgb` is light over black.
        **Raises** what `jvr.write_image` raises.
        """
        from jvr.pictures import write_image

        is_exr = str(path).lower().endswith(".exr")
        write_image(path, self.rgb, self.alpha if transparent else None, depth=self.depth if is_exr else None)

    def _repr_png_(self) -> bytes:
        """What notebooks show; pixels that are not finite in magenta."""
        from jvr.pictures import shown

        return shown(self.rgb)
