"""Gradients of a volume, from which surfaces get their normals (course notes on GPU-based volume ray-casting, Eurographics 2009,
section 3.3; Hossain, Alim and Moeller, "Toward high-quality gradient estimation on regular lattices", 2011, compare more of them).

Gradients are estimated along the grid's axes; `Volume.axes_inverse` takes them to the world, so that anisotropic spacing and oblique
axes are honoured. Towards the border of the domain differences become one-sided; along an axis of one voxel there is none.
"""

import abc
import itertools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.model.interpolation import Nearest, Trilinear
from jvr.model.parameters import choice
from jvr.model.parts import AbstractPart, Knob, PlanEntry, asks_gradient, parts_of, spelling
from jvr.model.transfer import AbstractTransfer
from jvr.model.volume import Volume, gradients_at_voxels, smoothed
from jvr.names import Renamed
from jvr.numerics import add_runs, divide_or_zero, read_run
from jvr.types import Channels, Scalar, Triple

# The scalar, its derivatives along the grid's axes, and what else a gradient is made of, such as scalars around the point: empty where
# they are not needed.
Resampled = tuple[Float[Array, "..."], Triple, Channels]


class AbstractNormals(AbstractPart):
    """A gradient estimator. With `of_opacity` it is that of the extinction, after the transfer function (mean of its channels),
    else that of the scalar."""

    # Voxels beyond those of a point's cell, or beyond those that its value is made of, within which differences of neighbours bound the
    # estimate along each axis; `None` where nothing is known of it.
    reach: ClassVar[int | None] = None

    of_opacity: bool = choice(doc="whether of the extinction, not of the scalar", default=False)

    prepared = Renamed("with_gradients")

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        asking = " and ".join(other for other, part in parts_of(scene) if asks_gradient(part))
        reason = f"{spelling(self)}, asked for by {asking}" if asking else "nothing asks for a gradient"
        return (PlanEntry("gradient", bool(asking), reason),)

    def knobs(self, scene: Any) -> tuple[Knob, ...]:
        cheaper = {SobelDifferences: (AnalyticGradient, CentralDifferences), AnalyticGradient: ()}.get(
            type(self), (AnalyticGradient,)
        )
        # What a surface looks like is the choice of the scene: the estimator that it names is the finest.
        values = (*(kind(self.of_opacity) for kind in cheaper), self)
        return (Knob("estimator", values, self),) if scene.needs_gradient and cheaper else ()

    def turned(self, knob: str, value: Any) -> "AbstractNormals":
        return value

    def coarser(self, scene: Any) -> tuple[AbstractPart, ...]:
        cheaper = AnalyticGradient(self.of_opacity)
        return () if type(self) is AnalyticGradient else (cheaper,)

    @abc.abstractmethod
    def resample(self, volume: Volume, p: Triple) -> Resampled:
        """What `gradient` needs, at one grid position."""

    @abc.abstractmethod
    def deposit(self, volume: Volume, total: tuple[Volume, Any], p: Triple, cotangent: Resampled) -> tuple[Volume, Any]:
        """Adds the derivative of `sum(cotangent * resample)` over a batch of positions to the gradients of volume and `self`."""

    @abc.abstractmethod
    def gradient(self, transfer: AbstractTransfer, shape: tuple[int, int, int], p: Triple, resampled: Resampled) -> Triple:
        """Derivatives along the grid's axes at one position."""

    def with_gradients(self, volume: Volume, transfer: AbstractTransfer) -> "AbstractNormals":
        """The same with what can be computed before rays are marched; differentiable."""
        return self

    def follows_transfer(self, volume: Volume) -> bool:
        """Whether gradients change with the transfer function."""
        return self.of_opacity

    def scale(self, transfer: AbstractTransfer, s: Scalar, size: Scalar) -> Scalar:
        """What relative roundings of a scalar `s` come to in what is differentiated, where the scalar is a sum of terms of this size."""
        if not self.of_opacity:
            return size
        sigma_t, slope = jax.value_and_grad(lambda s: extinction(transfer, s))(s)
        return jnp.abs(sigma_t) + jnp.abs(slope) * size


class AnalyticGradient(AbstractNormals):
    """The gradient of the interpolant itself: exact, nothing else is read, but not continuous from one cell of a trilinear interpolant to
    the next (the field between cells has kinks). The default.

    The nearest voxel's value has none: for labels it is that of `PrecomputedGradient(of_opacity=True)`, unless the transfer function asks
    for the gradient of the scalar.
    """

    reach: ClassVar[int | None] = 0

    def with_gradients(self, volume: Volume, transfer: AbstractTransfer) -> AbstractNormals:
        if isinstance(volume.interpolation, Nearest) and not transfer.takes_gradient:
            return PrecomputedGradient(of_opacity=True).with_gradients(volume, transfer)
        return self

    def follows_transfer(self, volume: Volume) -> bool:
        return self.of_opacity or isinstance(volume.interpolation, Nearest)

    def resample(self, volume: Volume, p: Triple) -> Resampled:
        s, gradient = jax.value_and_grad(lambda p: volume.sample(p, in_runs=True))(p)
        return s, gradient, ()

    def deposit(self, volume: Volume, total: tuple[Volume, Any], p: Triple, cotangent: Resampled) -> tuple[Volume, Any]:
        of_value, of_gradient, _ = cotangent
        return volume.deposit(total[0], p, of_value, of_gradient), total[1]

    def gradient(self, transfer: AbstractTransfer, shape: tuple[int, int, int], p: Triple, resampled: Resampled) -> Triple:
        s, gradient, _ = resampled
        if not self.of_opacity:
            return gradient
        slope = jax.grad(lambda s: extinction(transfer, s))(s)
        return tuple(slope * g for g in gradient)


class AbstractDifferences(AbstractNormals):
    """A gradient from scalars one voxel away."""

    offsets: ClassVar[tuple[tuple[int, int, int], ...]]

    @abc.abstractmethod
    def difference(self, shape: tuple[int, int, int], p: Triple, center: Float[Array, "..."], around: Channels) -> Triple:
        """The gradient from values at `p` and at the neighbours."""

    def neighbour(self, shape: tuple[int, int, int], p: Triple, offset: tuple[int, int, int]) -> Triple:
        """Where the scalar is read for an offset: inside of the domain."""
        return tuple(jnp.clip(x + o, 0, max(n - 1, 0)) if n > 1 else x for x, o, n in zip(p, offset, shape, strict=True))

    def resample(self, volume: Volume, p: Triple) -> Resampled:
        s = volume.sample(p)
        # Interpolation rounds a constant otherwise at each point. What differs by no more is the same, else rounding decides the normals.
        noise = 8 * jnp.finfo(s.dtype).eps * (jnp.abs(s) + jnp.abs(volume.intercept))
        known = jax.lax.stop_gradient
        steady = lambda x: jnp.where(jnp.abs(x - s) <= noise, known(s) + (x - known(x)), x)
        around = tuple(steady(volume.sample(self.neighbour(volume.shape, p, o))) for o in self.offsets)
        return (s, (), around) if self.of_opacity else (s, self.difference(volume.shape, p, s, around), ())

    def deposit(self, volume: Volume, total: tuple[Volume, Any], p: Triple, cotangent: Resampled) -> tuple[Volume, Any]:
        of_value, of_gradient, of_around = cotangent
        if not self.of_opacity:
            zeros = (jnp.zeros_like(of_value), (jnp.zeros_like(of_value),) * len(self.offsets))
            _, pull = jax.vjp(lambda s, around: self.difference(volume.shape, p, s, around), *zeros)
            of_center, of_around = pull(of_gradient)
            of_value += of_center
        sum_ = volume.deposit(total[0], p, of_value)
        for offset, of_one in zip(self.offsets, of_around, strict=True):
            sum_ = volume.deposit(sum_, self.neighbour(volume.shape, p, offset), of_one)
        return sum_, total[1]

    def gradient(self, transfer: AbstractTransfer, shape: tuple[int, int, int], p: Triple, resampled: Resampled) -> Triple:
        s, gradient, around = resampled
        if not self.of_opacity:
            return gradient
        return self.difference(shape, p, extinction(transfer, s), tuple(extinction(transfer, x) for x in around))


def _span(shape: tuple[int, int, int], p: Triple, axis: int, before: int, after: int) -> Float[Array, "..."]:
    """Distance between the neighbours `before` and `after` on an axis, as far as they are inside of the domain."""
    last = shape[axis] - 1
    return jnp.clip(p[axis] + after, 0, last) - jnp.clip(p[axis] + before, 0, last)


class ForwardDifferences(AbstractDifferences):
    """`s(p + e) - s(p)` along each axis, backwards where the neighbour would be outside: three more scalars, first order."""

    reach: ClassVar[int | None] = 1
    offsets: ClassVar = ((1, 0, 0), (0, 1, 0), (0, 0, 1))

    def neighbour(self, shape: tuple[int, int, int], p: Triple, offset: tuple[int, int, int]) -> Triple:
        inwards = [jnp.where(x + o > n - 1, -o, o) if n > 1 else 0 for x, o, n in zip(p, offset, shape, strict=True)]
        return tuple(x + o for x, o in zip(p, inwards, strict=True))

    def difference(self, shape: tuple[int, int, int], p: Triple, center: Float[Array, "..."], around: Channels) -> Triple:
        signs = [jnp.where(x + 1 > n - 1, -1.0, 1.0) if n > 1 else 0.0 for x, n in zip(p, shape, strict=True)]
        return tuple(sign * (value - center) for sign, value in zip(signs, around, strict=True))


class CentralDifferences(AbstractDifferences):
    """`(s(p + e) - s(p - e)) / 2` along each axis: six more scalars, second order."""

    reach: ClassVar[int | None] = 1
    offsets: ClassVar = ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1))

    def difference(self, shape: tuple[int, int, int], p: Triple, center: Float[Array, "..."], around: Channels) -> Triple:
        return tuple(divide_or_zero(around[2 * a + 1] - around[2 * a], _span(shape, p, a, -1, 1)) for a in range(3))


class SobelDifferences(AbstractDifferences):
    """Central differences smoothed with weights 1, 2, 1 along both other axes (Zucker and Hummel 1981): 26 more scalars, least noise."""

    reach: ClassVar[int | None] = 1
    offsets: ClassVar = tuple((i, j, k) for i, j, k in itertools.product((-1, 0, 1), repeat=3) if (i, j, k) != (0, 0, 0))

    def difference(self, shape: tuple[int, int, int], p: Triple, center: Float[Array, "..."], around: Channels) -> Triple:
        def along(axis: int) -> Float[Array, "..."]:
            total = jnp.zeros_like(center)
            for offset, value in zip(self.offsets, around, strict=True):
                smooth = [2 - abs(o) for a, o in enumerate(offset) if a != axis]
                # Less the value at the point, so that a constant leaves nothing: weights sum to zero, rounded products need not.
                total += offset[axis] * smooth[0] * smooth[1] / 16 * (value - center)
            return divide_or_zero(total, _span(shape, p, axis, -1, 1))

        return tuple(along(axis) for axis in range(3))


class PrecomputedGradient(AbstractNormals):
    """Central differences at every voxel, or with `sobel` those of `SobelDifferences`, computed once and interpolated between voxels
    linearly: smooth, for 12 bytes a voxel.

    They are computed anew in each picture unless the volume keeps them (`Volume.graded()` and `Volume.graded_by_sobel()`, not with
    `of_opacity`). Of labels, whose values
    are those of the nearest voxel, the extinction is smoothed before (1, 4, 6, 4, 1 along each axis), and the gradients are interpolated
    nevertheless: normals of a ball of labels, 10 voxels in radius, are then off by 3 degrees on average in place of 21.
    """

    reach: ClassVar[int | None] = 1

    sobel: bool = choice(doc="whether of Sobel's differences, not of central ones", default=False)
    gradients: Float[Array, "x y z 3"] | None = None

    def with_gradients(self, volume: Volume, transfer: AbstractTransfer) -> "PrecomputedGradient":
        kept = volume.sobel_gradients if self.sobel else volume.gradients
        if kept is not None and not self.of_opacity:
            return PrecomputedGradient(self.of_opacity, self.sobel, kept)
        values = volume.values.astype(volume.slope.dtype) * volume.slope + volume.intercept
        if self.of_opacity:
            values = jax.vmap(lambda s: extinction(transfer, s))(values.reshape(-1)).reshape(values.shape)
            values = smoothed(values, (1, 4, 6, 4, 1)) if isinstance(volume.interpolation, Nearest) else values
        return PrecomputedGradient(self.of_opacity, self.sobel, gradients_at_voxels(values, sobel=self.sobel))

    def resample(self, volume: Volume, p: Triple) -> Resampled:
        assert self.gradients is not None
        rows, total = self.gradients.reshape(-1, 3), jnp.zeros(3, self.gradients.dtype)
        for start, weights in Trilinear().stencil(volume.shape, p):
            total += sum(w * read_run(rows, start + i, 1)[0] for i, w in enumerate(weights))
        # One array: apart, each of its components would read all three anew.
        return volume.sample(p), (), (total,)

    def deposit(self, volume: Volume, total: tuple[Volume, Any], p: Triple, cotangent: Resampled) -> tuple[Volume, Any]:
        of_value, _, (of_gradient,) = cotangent
        own = total[1]
        if own.gradients is not None:
            rows = own.gradients.reshape(-1, 3)
            for starts, weights in jax.vmap(lambda p: Trilinear().stencil(volume.shape, p))(p):
                rows = add_runs(rows, starts, jnp.stack(weights, 1)[..., None] * of_gradient[:, None])
            own = PrecomputedGradient(self.of_opacity, self.sobel, rows.reshape(own.gradients.shape))
        return volume.deposit(total[0], p, of_value), own

    def gradient(self, transfer: AbstractTransfer, shape: tuple[int, int, int], p: Triple, resampled: Resampled) -> Triple:
        (gradient,) = resampled[2]
        return gradient[0], gradient[1], gradient[2]


def extinction(transfer: AbstractTransfer, s: Scalar) -> Scalar:
    """Extinction at a scalar, the mean of its channels."""
    sigma_t = transfer.evaluate(s).sigma_t
    return sum(sigma_t[1:], sigma_t[0]) / len(sigma_t)
