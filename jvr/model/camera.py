"""Cameras: where the ray of each pixel starts and where it goes."""

import abc
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jvr.model.checks import affine, float_array, require
from jvr.model.exact import Exact, Remainder, in_double
from jvr.model.parameters import TRIPLE, arguments, assign, choice, parameter
from jvr.model.ranges import ANGLE_OF_VIEW, AT_LEAST_ONE, DIRECTION, NOT_NEGATIVE, POSITIVE, Interval
from jvr.numerics import dot, normalise
from jvr.types import Affine, ArrayLike, Scalar, Triple, Vector

BEYOND = Interval(0.0, ends="(]", takes_infinity=True)


def pixels() -> Any:
    """The declaration of the size of a picture."""
    return choice(AT_LEAST_ONE, doc="pixels", most=65_536)


def angle_of_view() -> Any:
    """The declaration of a vertical angle of view."""
    return parameter(ANGLE_OF_VIEW, doc="full vertical angle", unit="degrees")


def near_plane() -> Any:
    """The declaration of the plane in front of which nothing is seen."""
    return parameter(NOT_NEGATIVE, doc="distance along the view in front of which nothing is seen", unit="mm")


def far_plane() -> Any:
    """The declaration of the plane behind which nothing of the volume is seen."""
    return parameter(BEYOND, doc="distance along the view behind which nothing is seen", unit="mm")


def around() -> dict[str, Any]:
    """The declarations of the arguments of cameras that look inwards from all around."""
    center = parameter(doc="x, y, z", unit="mm", shapes=TRIPLE)
    radius = parameter(POSITIVE, doc="distance from the centre", unit="mm")
    count = choice(AT_LEAST_ONE, doc="cameras", most=10_000)
    return {"center": center, "radius": radius, "count": count, "fov_y": angle_of_view(), "width": pixels(), "height": pixels()}


# Distances along rays, or `None`.
Limits: TypeAlias = tuple[Float[Array, "..."] | None, Float[Array, "..."] | None]


class AbstractCamera(eqx.Module):
    """A camera looks along -z of its own frame, y up; pixel (row, column) = (0, 0) is at the top left.

    What lies in front of its near plane or behind its far one, which are across the view at distances `near` and `far` from the eye, is not
    seen, of the volume and of geometry; a background is. `None` is no plane; a class of somebody's own need not have these fields.

    `remainder` is what single precision leaves of a pose that was given in double precision (see `jvr.model.exact`): a camera far away
    from the volume then still aims at the same voxel, and one far from the world's origin stays where it is.
    """

    world_from_camera: eqx.AbstractVar[Affine]
    width: eqx.AbstractVar[int]
    height: eqx.AbstractVar[int]
    remainder: eqx.AbstractVar[Remainder]

    @abc.abstractmethod
    def rays_ahead(self, pixels: Int[Array, "rays"], ahead: Scalar) -> tuple[Triple, Triple, Float[Array, "rays"]]:
        """The rays through the centres of `pixels = row * width + column`: a point of each on the plane `ahead` in front of the eye, across
        the view; unit directions; the distances from the eye (for parallel rays the image plane) to these points. World; traceable.

        The nearer that plane is to what is looked at, the more digits its points have."""

    def rays(self, pixels: Int[Array, "rays"]) -> tuple[Triple, Triple]:
        """World origins and unit directions through the centres of `pixels = row * width + column`; traceable."""
        origin, direction, _ = self.rays_ahead(pixels, jnp.zeros_like(self.world_from_camera[0, 0]))
        return origin, direction

    def limits(self, direction: Triple, ahead: Scalar) -> Limits:
        """How far from where rays of these directions start (`rays_ahead`) they cross the near and the far plane, each `None` where there
        is none; differentiable."""
        back = tuple(self.world_from_camera[i, 2] for i in range(3))
        along = -dot(direction, back)
        distance = lambda plane: None if plane is None else (plane - ahead) / along
        return distance(getattr(self, "near", None)), distance(getattr(self, "far", None))

    def axis_at(self, ahead: Scalar) -> Triple:
        """The point of the axis of view at a distance from the eye, to the last digit."""
        matrix, low = self.world_from_camera, self.remainder.beside(self.world_from_camera)
        x = Exact(matrix[:3, 3], low[:3, 3]).plus_product(Exact(matrix[:3, 2], low[:3, 2]), -ahead).rounded()
        return x[0], x[1], x[2]

    def moved(self, origin: Exact) -> "AbstractCamera":
        """The same camera in a world whose origin is at `origin`."""
        matrix, low = self.world_from_camera, self.remainder.beside(self.world_from_camera)
        place = Exact(matrix[:3, 3], low[:3, 3]).minus(origin)
        matrix, low = matrix.at[:3, 3].set(place.high), low.at[:3, 3].set(place.low)
        return eqx.tree_at(lambda c: (c.world_from_camera, c.remainder), self, (matrix, Remainder(matrix, low)))


class PerspectiveCamera(AbstractCamera):
    """A pinhole camera.

    **Arguments:** `world_from_camera`: 4x4 rigid transform; `fov_y`: full vertical angle of view in degrees, 0 ... 180;
    `width`, `height`: pixels (static); `near`, `far`: distances along the view between which the scene is seen, or `None`; `remainder`: of
    a pose that JAX holds already. All arrays are differentiable. **Raises** `ValueError` for sizes below 1, an angle out of range, or
    planes that are not in front of each other.
    """

    world_from_camera: Affine = parameter(doc="rigid transform")
    fov_y: Scalar = angle_of_view()
    width: int = pixels()
    height: int = pixels()
    near: Scalar | None = near_plane()
    far: Scalar | None = far_plane()
    remainder: Remainder = parameter(doc="what single precision leaves of the pose")

    def __init__(
        self,
        world_from_camera: ArrayLike,
        fov_y: ArrayLike,
        width: int,
        height: int,
        *,
        near: ArrayLike | None = None,
        far: ArrayLike | None = None,
        remainder: Remainder | None = None,
    ):
        _place(self, world_from_camera, remainder)
        assign(self, fov_y=fov_y, width=width, height=height)
        _place_planes(self, near, far)

    @classmethod
    def look_at(
        cls,
        eye: ArrayLike,
        target: ArrayLike,
        up: ArrayLike,
        fov_y: ArrayLike,
        width: int,
        height: int,
        *,
        near: ArrayLike | None = None,
        far: ArrayLike | None = None,
    ) -> "PerspectiveCamera":
        """The camera at `eye` that looks at `target`; `up` need not be orthogonal to the view. Traceable, differentiable."""
        pose, remainder = _looking(eye, target, up)
        return cls(pose, fov_y, width, height, near=near, far=far, remainder=remainder)

    def rays_ahead(self, pixels: Int[Array, "rays"], ahead: Scalar) -> tuple[Triple, Triple, Float[Array, "rays"]]:
        return _through(self, *_plane(self, pixels, 2 * jnp.tan(jnp.deg2rad(self.fov_y) / 2)), ahead)


class PinholeCamera(AbstractCamera):
    """A pinhole camera as a calibration describes it: each axis has a focal length of its own, and the axis of view meets the picture
    where it will.

    The point (X, Y, Z) of its own frame, with Z < 0, is seen at column `c_x - f_x X / Z` and row `c_y + f_y Y / Z`, both counted in
    pixels from the upper left corner of the picture, so that the centre of the first pixel is at (0.5, 0.5).

    **Arguments:** `world_from_camera`: 4x4 rigid transform; `focal_lengths`: `(f_x, f_y)` in pixels; `principal_point`: `(c_x, c_y)` in
    pixels, by default the middle of the picture; it may lie outside; the others as of `PerspectiveCamera`. All arrays are differentiable.
    **Raises** `ValueError` for sizes below 1, focal lengths that are not positive, or planes that are not in front of each other.
    """

    world_from_camera: Affine = parameter(doc="rigid transform")
    focal_lengths: Float[Array, "2"] = parameter(POSITIVE, doc="along columns and rows", unit="pixels")
    principal_point: Float[Array, "2"] = parameter(doc="column and row, from the upper left corner", unit="pixels")
    width: int = pixels()
    height: int = pixels()
    near: Scalar | None = near_plane()
    far: Scalar | None = far_plane()
    remainder: Remainder = parameter(doc="what single precision leaves of the pose")

    def __init__(
        self,
        world_from_camera: ArrayLike,
        focal_lengths: ArrayLike,
        width: int,
        height: int,
        *,
        principal_point: ArrayLike | None = None,
        near: ArrayLike | None = None,
        far: ArrayLike | None = None,
        remainder: Remainder | None = None,
    ):
        _place(self, world_from_camera, remainder)
        middle = (width / 2, height / 2) if principal_point is None else principal_point
        # A size of zero would be blamed on the focal length that somebody made of it.
        assign(self, width=width, height=height, focal_lengths=focal_lengths, principal_point=middle)
        _place_planes(self, near, far)

    def rays_ahead(self, pixels: Int[Array, "rays"], ahead: Scalar) -> tuple[Triple, Triple, Float[Array, "rays"]]:
        row, column = jnp.divmod(pixels, self.width)
        x = (column + 0.5 - self.principal_point[0]) / self.focal_lengths[0]
        y = (self.principal_point[1] - row - 0.5) / self.focal_lengths[1]
        return _through(self, x, y, ahead)


class OrthographicCamera(AbstractCamera):
    """A camera of parallel rays, which start in its image plane.

    **Arguments:** as `PerspectiveCamera`, with `height_world`, the vertical extent of the picture as a world length.
    """

    world_from_camera: Affine = parameter(doc="rigid transform")
    height_world: Scalar = parameter(POSITIVE, doc="vertical extent of the picture", unit="mm")
    width: int = pixels()
    height: int = pixels()
    near: Scalar | None = near_plane()
    far: Scalar | None = far_plane()
    remainder: Remainder = parameter(doc="what single precision leaves of the pose")

    def __init__(
        self,
        world_from_camera: ArrayLike,
        height_world: ArrayLike,
        width: int,
        height: int,
        *,
        near: ArrayLike | None = None,
        far: ArrayLike | None = None,
        remainder: Remainder | None = None,
    ):
        _place(self, world_from_camera, remainder)
        assign(self, height_world=height_world, width=width, height=height)
        _place_planes(self, near, far)

    @classmethod
    def look_at(
        cls,
        eye: ArrayLike,
        target: ArrayLike,
        up: ArrayLike,
        height_world: ArrayLike,
        width: int,
        height: int,
        *,
        near: ArrayLike | None = None,
        far: ArrayLike | None = None,
    ) -> "OrthographicCamera":
        """The camera whose image plane is centred on `eye` and that looks at `target`; traceable, differentiable."""
        pose, remainder = _looking(eye, target, up)
        return cls(pose, height_world, width, height, near=near, far=far, remainder=remainder)

    def rays_ahead(self, pixels: Int[Array, "rays"], ahead: Scalar) -> tuple[Triple, Triple, Float[Array, "rays"]]:
        x, y = _plane(self, pixels, self.height_world)
        aside = _rotate(self.world_from_camera, (x, y, jnp.zeros_like(x)))
        forward = _rotate(self.world_from_camera, (jnp.zeros_like(x), jnp.zeros_like(x), -jnp.ones_like(x)))
        origin = tuple(a + c for a, c in zip(aside, self.axis_at(ahead), strict=True))
        return origin, forward, jnp.broadcast_to(ahead, x.shape)


def _place(camera: Any, world_from_camera: ArrayLike, remainder: Remainder | None) -> None:
    """Gives a camera its pose, in its constructor."""
    camera.world_from_camera = affine(world_from_camera, "world_from_camera")
    camera.remainder = Remainder.left(world_from_camera, camera.world_from_camera, remainder)


def _place_planes(camera: Any, near: ArrayLike | None, far: ArrayLike | None) -> None:
    """Gives a camera its planes, in its constructor."""
    assign(camera, near=near, far=far)
    if camera.near is not None and camera.far is not None:
        require(camera.far - camera.near, lambda d: d > 0, "the far plane of a camera must be behind its near plane")


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike) -> Affine:
    """The `world_from_camera` of a camera at `eye` that looks at `target`: -z forward, y as near to `up` as can be.

    **Raises** `ValueError` where `eye` is `target`, or `up` is parallel to the view. Differentiable in all three.
    """
    return _looking(eye, target, up)[0]


def _looking(eye: ArrayLike, target: ArrayLike, up: ArrayLike) -> tuple[Affine, Remainder]:
    """`look_at`, with the digits of eye and view that its result has no room for."""
    places = []
    for value, name in ((eye, "eye"), (target, "target")):
        array = float_array(value, name, (3,))
        places.append(Exact(array, Remainder.left(value, array).low))
    back, side, pose, low = _axes(*places, float_array(up, "up", (3,)))
    require(back, lambda b: np.any(b != 0), "look_at needs an eye apart from its target")
    require(
        side, lambda r: np.linalg.norm(r) > 1e-6, "look_at needs an up vector that is not parallel to the view: choose another up"
    )
    return pose, Remainder(pose, low)


@jax.jit
def _axes(eye: Exact, target: Exact, up: Vector) -> tuple[Vector, Vector, Affine, Affine]:
    """Back and side, the latter of any length; the pose and what it has no room for. One program: its operations one by one take a
    quarter of a second to compile."""
    view = eye.minus(target)
    back = normalise(view.rounded())
    side = jnp.cross(normalise(up), back)
    right = normalise(side)
    columns = jnp.stack([right, jnp.cross(back, right), back, eye.high], axis=1)
    length = jax.lax.stop_gradient(jnp.dot(back, view.rounded()))
    missed = view.plus_product(Exact(back, jnp.zeros_like(back)), -length).rounded()
    low = jnp.stack([jnp.zeros_like(back), jnp.zeros_like(back), missed / jnp.where(length > 0, length, 1.0), eye.low], axis=1)
    pose, low = (jnp.concatenate([x, jnp.array([[0, 0, 0, last]], x.dtype)]) for x, last in ((columns, 1), (low, 0)))
    return back, side, pose, low


@arguments(**around(), axis=parameter(DIRECTION, doc="x, y, z; what is up in every picture", shapes=TRIPLE))
def orbit(
    center: ArrayLike, radius: ArrayLike, count: int, fov_y: ArrayLike, width: int, height: int, *, axis: ArrayLike = (0, 0, 1)
) -> tuple[PerspectiveCamera, ...]:
    """`count` cameras on a circle of `radius` around `center`, evenly spaced, `axis` pointing up in every picture."""
    axis = normalise(float_array(axis, "axis", (3,)))
    least = jax.nn.one_hot(jnp.argmin(jnp.abs(axis)), 3, dtype=axis.dtype)
    first = normalise(jnp.cross(axis, least))
    second = jnp.cross(axis, first)
    angles = [2 * np.pi * i / count for i in range(count)]
    offsets = [np.cos(angle) * first + np.sin(angle) * second for angle in angles]
    return _around(center, radius, offsets, axis, fov_y, width, height)


@arguments(**around())
def fibonacci_sphere(
    center: ArrayLike, radius: ArrayLike, count: int, fov_y: ArrayLike, width: int, height: int
) -> tuple[PerspectiveCamera, ...]:
    """`count` cameras spread evenly over a sphere of `radius` around `center` (golden-angle spiral), all looking inwards."""
    offsets = []
    for i in range(count):
        z = 1 - (2 * i + 1) / count
        angle = np.pi * (3 - np.sqrt(5)) * i
        offsets.append(np.array([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z]))
    return _around(center, radius, offsets, jnp.array([0.0, 0.0, 1.0]), fov_y, width, height)


def _around(center: ArrayLike, radius: ArrayLike, offsets: list[Any], up: Array, fov_y: ArrayLike, width: int, height: int):
    center, radius, cameras = in_double(center), in_double(radius), []
    for offset in offsets:
        # At the poles of the sphere z cannot point up in the picture; y then does.
        upward = jnp.where(jnp.abs(jnp.dot(jnp.asarray(offset), up)) > 0.999, jnp.roll(up, -1), up)
        cameras.append(PerspectiveCamera.look_at(center + radius * in_double(offset), center, upward, fov_y, width, height))
    return tuple(cameras)


def _through(
    camera: AbstractCamera, x: Float[Array, "rays"], y: Float[Array, "rays"], ahead: Scalar
) -> tuple[Triple, Triple, Float[Array, "rays"]]:
    """`rays_ahead` of rays from the eye through (x, y) of the plane at distance 1."""
    norm = jnp.sqrt(x * x + y * y + 1)
    direction = _rotate(camera.world_from_camera, (x / norm, y / norm, -1 / norm))
    aside = _rotate(camera.world_from_camera, (ahead * x, ahead * y, jnp.zeros_like(x)))
    return tuple(a + c for a, c in zip(aside, camera.axis_at(ahead), strict=True)), direction, ahead * norm


def _plane(
    camera: AbstractCamera, pixels: Int[Array, "rays"], extent: Scalar
) -> tuple[Float[Array, "rays"], Float[Array, "rays"]]:
    """Position of pixel centres in an image plane whose full height is `extent`; y up, so row 0 is on top."""
    row, column = jnp.divmod(pixels, camera.width)
    scale = extent / camera.height
    return (column + 0.5 - camera.width / 2) * scale, (camera.height / 2 - row - 0.5) * scale


def _rotate(matrix: Affine, v: Triple) -> Triple:
    return tuple(matrix[i, 0] * v[0] + matrix[i, 1] * v[1] + matrix[i, 2] * v[2] for i in range(3))
