"""The image plane: rays through points of it that are no pixel centres, inside of the picture and around it."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.model.camera import AbstractCamera, Limits, OrthographicCamera, PerspectiveCamera
from jvr.types import Scalar, Triple


class ImagePlane(NamedTuple):
    """The rays of a camera, `origin + z * direction` with `z` along the view, as linear functions of column and row: each component is
    its value at pixel (0, 0), and what it gains with a column and with a row. The plane is `ahead` in front of the eye."""

    origin: tuple[tuple[Scalar, Scalar, Scalar], ...]
    direction: tuple[tuple[Scalar, Scalar, Scalar], ...]
    ahead: Scalar
    camera: AbstractCamera

    def rays(self, column: Float[Array, "points"], row: Float[Array, "points"]) -> tuple[Triple, Triple, Float[Array, "points"]]:
        """Points on the plane, unit directions, and distances from the eye; integers are pixel centres, as in
        `AbstractCamera.rays_ahead` up to rounding."""
        at = lambda v: tuple(start + column * across + row * down for start, across, down in v)
        origin, direction = at(self.origin), at(self.direction)
        norm = jnp.sqrt(sum(d * d for d in direction))
        return origin, tuple(d / norm for d in direction), self.ahead * norm

    def limits(self, direction: Triple) -> Limits:
        """How far from their points on the plane rays cross the near and the far plane of the camera."""
        return self.camera.limits(direction, self.ahead)

    @property
    def size(self) -> tuple[Scalar, Scalar]:
        """How far apart the rays of neighbouring pixels are on the plane, and how much farther apart, at most, for each world length
        behind it."""
        length = lambda v, i: jnp.sqrt(sum(component[i] ** 2 for component in v))
        apart = lambda v: jnp.maximum(length(v, 1), length(v, 2))
        return apart(self.origin), apart(self.direction)


def image_plane(camera: AbstractCamera, ahead: Scalar) -> ImagePlane:
    """The image plane of a camera, `ahead` in front of its eye, differentiable in everything else. **Raises** `ValueError` for a camera of
    another kind than jvr's own."""
    if not isinstance(camera, PerspectiveCamera | OrthographicCamera):
        raise ValueError(
            f"adaptive sampling needs a PerspectiveCamera or an OrthographicCamera, not a {type(camera).__name__}: "
            "leave Settings(sampling=...) at jvr.Uniform()"
        )
    # With a column more on either side every corner is a pixel: those far apart give the slopes the most digits.
    wide = dataclasses.replace(camera, width=camera.width + 2)
    corners = jnp.array([1, camera.width + 1, camera.height * wide.width + 1], jnp.int32)
    origin, direction, _ = wide.rays_ahead(corners, ahead)
    forward = [-camera.world_from_camera[i, 2] for i in range(3)]
    along = sum(d * f for d, f in zip(direction, forward, strict=True))
    linear = lambda v: tuple((x[0], (x[1] - x[0]) / camera.width, (x[2] - x[0]) / camera.height) for x in v)
    return ImagePlane(linear(origin), linear(tuple(d / along for d in direction)), ahead, camera)
