"""Cameras of a fit that are unknown: rays as the cameras have them now, computed within compiled programs.

Rays of pictures of one size and kind of camera are made together; a picture has a number, its view.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jvr.march.steps import Rays
from jvr.model.camera import AbstractCamera, Limits
from jvr.model.motion import moved_about, moved_in_double
from jvr.model.scene import Scene
from jvr.rendering.trace import ahead, enter, near_volume, promote_dtypes
from jvr.types import Scalar, Triple

# What is added to the values of all views alike, by the names of fields of their cameras, and `motions`.
Shift = Mapping[str, Array]


class Pixels(NamedTuple):
    """Rays by their view and their pixel in it, `row * width + column`."""

    view: Int[Array, "..."]
    pixel: Int[Array, "..."]


class Views(eqx.Module):
    """The cameras of a fit, and for each the motion of its pose about the centre of the volume (`jvr.model.motion`) since the start.

    All arrays are differentiable, but for the poses themselves, whose part the motions take.
    """

    cameras: tuple[AbstractCamera, ...]
    motions: tuple[Float[Array, "6"], ...]

    @classmethod
    def at_rest(cls, cameras: tuple[AbstractCamera, ...]) -> "Views":
        """Cameras that have not moved."""
        return cls(cameras, tuple(jnp.zeros(6, camera.world_from_camera.dtype) for camera in cameras))

    @property
    def shown(self) -> tuple[AbstractCamera, ...]:
        """Cameras whose pose is their motion, and whose arrays are those that may be unknown."""
        replaced = lambda c: (c.world_from_camera, c.remainder)
        pairs = zip(self.cameras, self.motions, strict=True)
        return tuple(eqx.tree_at(replaced, camera, (motion, None)) for camera, motion in pairs)

    def settled(self, scene: Scene) -> "Views":
        """The same cameras at rest where they have moved to, in double precision, of known numbers."""
        origin, (near,) = scene.volume.origin, near_volume(scene)
        center = np.sum([np.asarray(x, np.float64) for x in (*origin, near.volume.center)], axis=0)
        pairs = zip(self.cameras, self.motions, strict=True)
        return Views.at_rest(tuple(moved_in_double(camera, np.asarray(motion), center) for camera, motion in pairs))

    def rays(self, scene: Scene, pixels: Pixels, shift: Shift | None = None) -> Rays:
        """The rays of pixels inside of the volume; `shift`: added to the values of every view."""
        (near,) = near_volume(scene)
        found: Any = None
        for members in _alike(self.cameras):
            place = np.zeros(len(self.cameras), np.int32)
            place[members] = np.arange(len(members))
            own = self._rays(scene, near, members, jnp.asarray(place)[pixels.view], pixels.pixel, shift)
            if found is not None:
                mine = jnp.asarray(np.isin(np.arange(len(self.cameras)), members))[pixels.view]
                own = jax.tree.map(lambda new, old, mine=mine: jnp.where(mine, new, old), own, found)
            found = own
        (origin, direction, behind), limits = found
        return enter(near, origin, direction, behind, pixels.pixel, limits)[0]

    def _rays(
        self, scene: Scene, near: Scene, members: list[int], own: Array, pixel: Array, shift: Shift | None
    ) -> tuple[Any, Limits]:
        """`rays_ahead` and `limits` of cameras that are alike, near the volume."""
        cameras = promote_dtypes(scene, *(self.cameras[i] for i in members))[1:]
        stack = jax.tree.map(lambda *x: jnp.stack(x), *cameras)
        motions = jnp.stack([self.motions[i] for i in members]).astype(stack.world_from_camera.dtype)
        for name, step in (shift or {}).items():
            if name == "motions":
                motions += step
            elif getattr(stack, name, None) is not None:
                stack = eqx.tree_at(lambda c, name=name: getattr(c, name), stack, getattr(stack, name) + step)
        origin, center = jax.lax.stop_gradient((scene.volume.origin, near.volume.center))
        placed = jax.vmap(lambda camera, motion: moved_about(camera.moved(origin), motion, center))(stack, motions)
        depth, planes = jax.vmap(lambda camera: ahead(near, camera))(placed), with_planes(self.cameras)

        def one(i: Array, pixel: Array) -> Any:
            camera, ahead_of_it = jax.tree.map(lambda x: x[i], (placed, depth))
            rays = camera.rays_ahead(pixel[None], ahead_of_it)
            return jax.tree.map(lambda x: x[0], (rays, limits_of(camera, rays[1], ahead_of_it, planes)))

        return jax.vmap(one)(own, pixel)


def with_planes(cameras: Sequence[AbstractCamera]) -> tuple[bool, bool]:
    """Whether any of the cameras has a near plane, and a far one: rays of a fit have the same numbers whichever theirs is."""
    near, far = (any(getattr(camera, name, None) is not None for camera in cameras) for name in ("near", "far"))
    return near, far


def limits_of(camera: AbstractCamera, direction: Triple, ahead: Scalar, planes: tuple[bool, bool]) -> Limits:
    """`AbstractCamera.limits`, infinite for planes that this camera has not and others have (`with_planes`)."""
    filled = [
        jnp.full_like(direction[0], nowhere) if wanted and found is None else found
        for found, wanted, nowhere in zip(camera.limits(direction, ahead), planes, (-jnp.inf, jnp.inf), strict=True)
    ]
    return filled[0], filled[1]


def _alike(cameras: tuple[AbstractCamera, ...]) -> list[list[int]]:
    """Which cameras are of one kind and size."""
    groups: dict[Any, list[int]] = {}
    for i, camera in enumerate(cameras):
        groups.setdefault(jax.tree.structure(camera), []).append(i)
    return list(groups.values())
