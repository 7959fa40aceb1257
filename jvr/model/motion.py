"""Rigid motions: the exponential map of SE(3), and cameras that are moved by it about a point.

A motion is six numbers in the world's axes: a rotation vector `w`, in degrees, about the point, and a translation `v` of it as a world
length. With `W = [w]x`, `t = |w|` in radians,

    x -> c + R (x - c) + V v,   R = I + a W + b W^2,   V = I + b W + c W^2,
    a = sin(t) / t,   b = (1 - cos(t)) / t^2,   c = (t - sin(t)) / t^3

(Murray, Li and Sastry 1994, A Mathematical Introduction to Robotic Manipulation, 2.4.2). At zero the six derivatives are those of a
rotation and a translation alone.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.model.camera import AbstractCamera
from jvr.model.exact import Exact, Remainder, in_double
from jvr.numerics import two_sum
from jvr.types import Vector

# Below this square of an angle the coefficients come by their series: quotients of differences that cancel have no digits left.
SMALL = 1.0
TERMS = 10


def exponential(motion: Float[Array, "6"]) -> tuple[Float[Array, "3 3"], Vector]:
    """`R - I` and `V v` of a motion; smooth everywhere, in value and derivative. The difference keeps the digits of small rotations."""
    w, v = jnp.deg2rad(motion[:3]), motion[3:]
    square = jnp.sum(w * w)
    a, b, c = _coefficients(square)
    cross = jnp.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    cross_twice = w[:, None] * w - square * jnp.eye(3, dtype=w.dtype)
    shift = v + jnp.sum((b * cross + c * cross_twice) * v, axis=1)
    return a * cross + b * cross_twice, shift


def _coefficients(square: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """`a`, `b` and `c` as functions of the square of the angle, of which they are entire functions: `sum_n (-t^2)^n / (2 n + k)!` for
    `k` = 1, 2, 3."""
    small = square < SMALL
    near, far = jnp.where(small, square, 0.0), jnp.where(small, SMALL, square)
    angle = jnp.sqrt(far)
    sine, versine = jnp.sin(angle), 2 * jnp.square(jnp.sin(angle / 2))
    closed = sine / angle, versine / far, (angle - sine) / (angle * far)

    def series(k: int) -> Float[Array, ""]:
        total = jnp.zeros_like(near)
        for n in reversed(range(TERMS)):
            total = (-1) ** n / math.factorial(2 * n + k) + near * total
        return total

    a, b, c = (jnp.where(small, series(k), other) for k, other in zip((1, 2, 3), closed, strict=True))
    return a, b, c


def moved_about(camera: AbstractCamera, motion: Float[Array, "6"], center: Vector) -> AbstractCamera:
    """A camera after a motion about `center`; traceable, differentiable. What the motion adds to the pose is rounded, not the pose: without
    a motion it is the same to the last digit of its remainder."""
    matrix, low = camera.world_from_camera, camera.remainder.beside(camera.world_from_camera)
    turn, shift = exponential(motion)
    place = Exact(matrix[:3, 3], low[:3, 3]).minus(Exact(center, jnp.zeros_like(center))).rounded()
    columns = jnp.concatenate([matrix[:3, :3], place[:, None]], axis=1)
    # Accelerators round the factors of a matrix product more coarsely.
    change = jnp.sum(turn[:, :, None] * columns, axis=1).at[:, 3].add(shift)
    high, low_rows = two_sum(matrix[:3], low[:3], change)
    matrix, low = matrix.at[:3].set(high), low.at[:3].set(low_rows)
    return eqx.tree_at(lambda c: (c.world_from_camera, c.remainder), camera, (matrix, Remainder(matrix, low)))


def moved_in_double(camera: AbstractCamera, motion: np.ndarray, center: np.ndarray) -> AbstractCamera:
    """The same of known numbers in double precision: as rigid as the camera's pose is."""
    pose, center = in_double(camera.world_from_camera, camera.remainder), np.asarray(center, np.float64)
    with jax.enable_x64(True):
        turn, shift = (np.asarray(x) for x in exponential(jnp.asarray(np.asarray(motion, np.float64))))
    pose = pose.copy()
    pose[:3, 3] += turn @ (pose[:3, 3] - center) + shift
    pose[:3, :3] += turn @ pose[:3, :3]
    rounded = jnp.asarray(pose, camera.world_from_camera.dtype)
    return eqx.tree_at(lambda c: (c.world_from_camera, c.remainder), camera, (rounded, Remainder.left(pose, rounded)))
