"""Opaque geometry in a scene: where rays end at it, and what they see there."""

import abc
import os
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jvr.model.camera import AbstractCamera
from jvr.model.checks import known
from jvr.model.clipping import Line
from jvr.model.exact import Exact
from jvr.model.parameters import assign, parameter
from jvr.model.parts import AbstractPart, PlanEntry
from jvr.model.ranges import RADIANCE, Interval
from jvr.types import ArrayLike, Triple

DISTANCE = Interval(low=0.0, takes_infinity=True)


class Face(NamedTuple):
    """Where rays meet geometry that light falls on: the position in the world, above it on the side of the eye by so much that a ray from
    there to a light does not meet it by rounding; the unit normal on that side; and the unit direction to the eye."""

    x: Triple
    normal: Triple
    w_o: Triple


class Met(NamedTuple):
    """Where rays meet geometry: how far from their origins, infinite for those that meet nothing; the radiance that they see there, or
    where there is a `face`, which light falls on, its colour."""

    distance: Float[Array, "rays"]
    rgb: Triple
    face: Face | None = None


class AbstractGeometry(AbstractPart):
    """Opaque geometry: rays end where they meet it. What of the medium is behind it is not sampled."""

    # Whether it is known in the pixels of one view alone, and not between them nor from elsewhere.
    of_one_view: ClassVar[bool] = False

    @property
    def ends_rays(self) -> bool:
        return True

    def without(self, scene: Any) -> Any:
        return scene.replaced(geometry=None)

    @abc.abstractmethod
    def hit(
        self,
        rays: Line,
        behind: Float[Array, "rays"] | float,
        nearest: Float[Array, "rays"] | float,
        pixels: Int[Array, "rays"] | None,
    ) -> Met:
        """Where rays of unit direction end.

        `rays`: in the world; `behind`: how far behind their origins the eye is; `nearest`: the distance from their origins from which on
        anything is met; `pixels`: `row * width + column` of each, `None` for rays that are of no pixel.
        """

    @abc.abstractmethod
    def moved(self, origin: Exact) -> "AbstractGeometry":
        """The same in a world whose origin is at `origin`."""

    def check_view(self, camera: AbstractCamera) -> None:
        """**Raises** `ValueError` for a camera whose rays it does not know."""

    def check_light(self, shading: Any, material: Any) -> None:
        """**Raises** `ValueError` for a scene's shading and material, or what there is of them, that it cannot be shaded by."""


class DepthImage(AbstractGeometry):
    """Opaque geometry as one camera sees it, pixel by pixel: what another renderer, or `jvr.render`, made of it.

    **Arguments:** `depth`: `(height, width)`, the distance from the eye along each ray as `jvr.Rendering.depth` has it (not along the axis
    of view, as depth buffers have it), 0 or infinite where there is nothing; `rgb`: `(height, width, 3)`, the linear radiance of the
    geometry, in the light that it was drawn in: it has no normals, and lights and shadows of the scene do not change it. Both are
    differentiable: as depth moves, so does how much medium is in front; at the edges of things, where pixels change what they show, there
    is no derivative.

    It is that of one view: a camera of another size is refused, and so is what looks between pixels or from elsewhere (`jvr.Refinement`,
    `jvr.Slices`, fits of several views). **Raises** `ValueError` for distances that are negative or NaN, and for shapes that do not fit.
    """

    of_one_view: ClassVar[bool] = True

    depth: Float[Array, "height width"] = parameter(DISTANCE, doc="distance from the eye, 0 or infinite for none")
    rgb: Float[Array, "height width 3"] = parameter(RADIANCE, doc="radiance of the geometry, red, green, blue")

    def __init__(self, depth: ArrayLike, rgb: ArrayLike):
        assign(self, depth=depth, rgb=rgb)

    @classmethod
    def from_image(cls, path: str | os.PathLike) -> "DepthImage":
        """The geometry of an OpenEXR file with channels R, G, B and Z, as `jvr render` writes them. **Raises** `ImageError` (a
        `ValueError`) for files that have none, and what reading a file raises."""
        from jvr.io.geometry import read_depth_image

        return cls(*read_depth_image(path))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.depth.shape[0], self.depth.shape[1]

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry(name, True, f"rays end at that of a depth image, {self.shape[0]} x {self.shape[1]} pixels"),)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        depth = known(self.depth)
        if depth is not None and not np.any((depth > 0) & np.isfinite(depth)):
            yield f"{name} is nowhere: no pixel of its depth image has a distance"

    def moved(self, origin: Exact) -> "DepthImage":
        return self

    def check_view(self, camera: AbstractCamera) -> None:
        if (camera.height, camera.width) != self.shape:
            height, width = self.shape
            raise ValueError(
                f"the depth image has {height} rows and {width} columns, the camera {camera.height} and {camera.width}: render the "
                "geometry with this camera, and leave Settings(pixel_samples=...) at 1"
            )

    def hit(
        self,
        rays: Line,
        behind: Float[Array, "rays"] | float,
        nearest: Float[Array, "rays"] | float,
        pixels: Int[Array, "rays"] | None,
    ) -> Met:
        if pixels is None:
            raise ValueError(
                "a jvr.DepthImage is known in the pixels of its camera alone: leave Settings(sampling=...) at jvr.Uniform(), or give a "
                "jvr.Mesh"
            )
        depth, rgb = jnp.ravel(self.depth)[pixels], self.rgb.reshape(-1, 3)[pixels]
        there = (depth > 0) & (depth < jnp.inf)
        t = jnp.where(there, jnp.where(there, depth, 0.0) - behind, jnp.inf)
        return Met(jnp.where(t < nearest, jnp.inf, t), (rgb[:, 0], rgb[:, 1], rgb[:, 2]))
