"""Shaders of an unlit medium, by the optical model alone."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.march.medium import AbstractShader
from jvr.march.steps import Point, Sample
from jvr.model.normals import AbstractNormals
from jvr.model.optical import AbstractOpticalModel
from jvr.model.transfer import Classified
from jvr.numerics import direction_and_length
from jvr.types import Channels, Scalar

# How many roundings of the scalar a difference between neighbouring voxels has to exceed to count as one.
ROUNDINGS = 4


def where_known(samples: tuple[Sample, ...], channels: Channels) -> Channels:
    """Channels that belong to some samples, zero where one of them is missing: where there are no data there is nothing to see."""
    for known in (known for sample in samples for known in sample.known):
        channels = tuple(jnp.where(known > 0.5, c, 0.0) for c in channels)
    return channels


class GradientFrame(eqx.Module):
    """Takes what the field resampled to a gradient in the world: `axes_inverse` and `intercept` are those of the volume, `shape` its
    voxels. What is no more than rounding leaves of equal scalars is zero."""

    normals: AbstractNormals
    axes_inverse: Float[Array, "3 3"]
    intercept: Scalar
    shape: tuple[int, int, int] = eqx.field(static=True)

    def in_world(self, transfer: Any, sample: Sample, point: Point) -> Sample:
        """The sample with its gradient per world length, along the world's axes."""
        along = self.normals.gradient(transfer, self.shape, point.p, (sample.s, sample.gradient, sample.neighbours))
        # The largest numbers, by which files mark what has no data, would overflow.
        largest = jnp.finfo(sample.s.dtype).max / 1024
        along = tuple(jnp.clip(g, -largest, largest) for g in along)
        # Interpolation rounds scalars before the intercept is added.
        unit = ROUNDINGS * jnp.finfo(sample.s.dtype).eps
        noise = jax.lax.stop_gradient(
            unit * self.normals.scale(transfer, sample.s, jnp.abs(sample.s) + 2 * jnp.abs(self.intercept))
        )
        is_noise = jnp.maximum(jnp.maximum(jnp.abs(along[0]), jnp.abs(along[1])), jnp.abs(along[2])) <= noise
        along = tuple(jnp.where(is_noise, 0.0, g) for g in along)
        world = tuple(sum((self.axes_inverse[j, i] * along[j] for j in range(3)), jnp.zeros_like(sample.s)) for i in range(3))
        return sample._replace(gradient=world, neighbours=())


class OpticalShader(AbstractShader):
    """The optical model alone. `frame` is there where something asks for the gradient, the transfer function for example."""

    optical: AbstractOpticalModel
    frame: GradientFrame | None

    def shade(self, classified: Classified, sample: Sample, point: Point, dt: Scalar) -> tuple[Channels, Channels]:
        return self.optical.evaluate_segment(classified, dt)

    def in_world(self, transfer: Any, sample: Sample, point: Point) -> Sample:
        return sample if self.frame is None else self.frame.in_world(transfer, sample, point)

    def classify(self, transfer: Any, sample: Sample) -> Classified:
        if transfer.takes_gradient:
            found = transfer.evaluate(sample.s, direction_and_length(sample.gradient)[1])
        else:
            found = transfer.evaluate(sample.s)
        return Classified(found.rgb, *(where_known((sample,), channels) for channels in (found.sigma_t, found.emission)))


class LightPathShader(OpticalShader):
    """What light passes on its way to a point, with no more than `densest` of extinction (see `jvr.march.medium.DENSEST`)."""

    densest: Scalar

    def classify(self, transfer: Any, sample: Sample) -> Classified:
        found = super().classify(transfer, sample)
        return found._replace(sigma_t=tuple(jnp.minimum(sigma, self.densest) for sigma in found.sigma_t))


class PreIntegratedShader(OpticalShader):
    """The optical model alone, the scalar linear along a segment."""

    quadrature_nodes: ClassVar[tuple[float, ...]] = (-0.5, 0.5)

    def evaluate_segment(self, transfer: Any, samples: tuple[Sample, ...], point: Point, dt: Scalar) -> tuple[Channels, Channels]:
        front, back = samples
        emitted, dtau = transfer.evaluate_segment(self.optical, front.s, back.s, dt)
        return where_known(samples, emitted), where_known(samples, dtau)
