"""What a rendering gives: a picture, and what it took."""

import os
from typing import Any, NamedTuple

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


class Layers(NamedTuple):
    """What is known of the first surface on each ray, `(height, width, channels)`; 0 where there is none.

    - `position`: where it is, in the world; `normal`: unit length, to the smaller values; `value`: the scalar there; `gradient_length`:
      that of its gradient, per world length.
    - `diffuse`, `specular`: radiance towards the eye, in the colour of the surface and in that of the light; without light its colour
      alone.
    - `occlusion`: the fraction of ambient light that reaches it, 1 where nothing takes any; in what is diffuse already.
    """

    position: Float[Array, "height width 3"]
    normal: Float[Array, "height width 3"]
    value: Float[Array, "height width 1"]
    gradient_length: Float[Array, "height width 1"]
    diffuse: Float[Array, "height width 3"]
    specular: Float[Array, "height width 3"]
    occlusion: Float[Array, "height width channels"]


class Rendering(eqx.Module):
    """A picture, row 0 at the top.

    - `rgb`: `(height, width, 3)`, linear radiance; includes `T` times what is behind the medium, a background or geometry.
    - `alpha`: `(height, width)`, opacity of the medium, `1 - mean(T)`; 1 where opaque geometry is behind it.
    - `depth`: `(height, width)`, `sum T (1 - exp(-dtau)) t / alpha`, distance from the eye along the ray, geometry included; 0 where alpha
      is 0.
    - `stats`: `RenderStats`.
    - `layers`: `Layers` of a picture by `jvr.render_layers`, else `None`.
    """

    rgb: Image
    alpha: Float[Array, "height width"]
    depth: Float[Array, "height width"]
    stats: RenderStats
    layers: Layers | None = None

    def save(self, path: str | os.PathLike, *, transparent: bool = False) -> None:
        """Writes the picture: `.png` as sRGB, or `.exr` as linear radiance with the depth as channel Z and its layers by their names, such
        as `diffuse.R`, `normal.X` or `value.Y`.

        `transparent`: with alpha, for pictures of a scene without a background, whose `rgb` is light over black.
        **Raises** what `jvr.write_image` raises.
        """
        from jvr.pictures import write_image

        is_exr = str(path).lower().endswith(".exr")
        layers = {} if self.layers is None or not is_exr else self.layers._asdict()
        write_image(path, self.rgb, self.alpha if transparent else None, depth=self.depth if is_exr else None, layers=layers)

    def _repr_png_(self) -> bytes:
        """What notebooks show; pixels that are not finite in magenta."""
        from jvr.pictures import shown

        return shown(self.rgb)
