"""Fields, shaders and visibility: the contracts between the ray marching loop and the medium that it goes through.

The loop knows no effect by name. It is handed a `Medium`: a field that is resampled at a point, a shader that turns what was resampled
into emitted radiance and optical depth, and where the scene asks for it, how much light arrives.
"""

import abc
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jvr.march.occupancy import Occupancy
from jvr.march.steps import Point, Sample, Transmittances
from jvr.model.transfer import AbstractTable, Classified
from jvr.types import Channels, Scalar

# Optical depth of a segment, and of a voxel on a path of light, beyond which denser media are lit alike: light gets about as deep into
# them as the eye sees. Without it the two would be compared at distances that a position in single precision cannot tell apart.
DENSEST = 64.0


class AbstractField(eqx.Module):
    """A field that is resampled along rays; its arrays may be large."""

    @abc.abstractmethod
    def resample(self, point: Point) -> Sample:
        """What is known at one point, but for the light there."""

    @abc.abstractmethod
    def deposit(self, gradient: "AbstractField", points: Point, cotangent: Sample) -> "AbstractField":
        """Adds the derivative of `sum(cotangent * resample(points))` to `gradient`, in place where the compiler can; leaves of
        `gradient` that are `None` are not asked for."""


class AbstractVisibility(eqx.Module):
    """Visibility: how much of the light reaches a point, of what it knows something of: the lights, the environment, ambient light."""

    @abc.abstractmethod
    def transmittances(self, points: Point, wanted: Bool[Array, "rays"], *, reverse: bool) -> Transmittances:
        """The transmittance between what shines and each of a batch of points. What is not `wanted` may be anything finite.

        Differentiable in reverse mode where `reverse` says so, else in forward mode.
        """

    @property
    @abc.abstractmethod
    def stats(self) -> Any:
        """What is to be reported about it, or `None`."""


class Visibilities(AbstractVisibility):
    """Several, each of which knows of other light: what is in the way of lights, and what is in the way of the environment's."""

    each: tuple[AbstractVisibility, ...]

    def transmittances(self, points: Point, wanted: Bool[Array, "rays"], *, reverse: bool) -> Transmittances:
        found = (one.transmittances(points, wanted, reverse=reverse) for one in self.each)
        return functools.reduce(Transmittances.beside, found)

    @property
    def stats(self) -> Any:
        """Of the first that reports something."""
        return next((one.stats for one in self.each if one.stats is not None), None)


class AbstractShader(eqx.Module):
    """A shader, what a segment emits and absorbs: everything between the scalar and the eye. Its arrays are small."""

    # Where in a segment the field is resampled, from -1/2 at its front to 1/2 at its back.
    quadrature_nodes: ClassVar[tuple[float, ...]] = (0.0,)

    @abc.abstractmethod
    def shade(self, classified: Classified, sample: Sample, point: Point, dt: Scalar) -> tuple[Channels, Channels]:
        """Emitted radiance (three components or none) and optical depth (one, three or none) of one segment of length `dt` whose
        properties are constant."""

    def evaluate_segment(self, transfer: Any, samples: tuple[Sample, ...], point: Point, dt: Scalar) -> tuple[Channels, Channels]:
        """The same for a segment around `point`, from what is known at `quadrature_nodes`."""
        sample = self.in_world(transfer, samples[0], point)
        return self.shade(self.classify(transfer, sample), sample, point, dt)

    def in_world(self, transfer: Any, sample: Sample, point: Point) -> Sample:
        """The sample with its gradient in the world."""
        return sample

    def classify(self, transfer: Any, sample: Sample) -> Classified:
        """Colour and extinction of a sample `in_world`."""
        return transfer.evaluate(sample.s)


class Medium(NamedTuple):
    """What rays march through: resampled, classified, shaded; where `occupancy` is not `None`, only in visible bricks; where
    `visibility` is not `None`, each sample knows how much light reaches it."""

    field: AbstractField
    transfer: Any  # what `shader.evaluate_segment` reads: an AbstractTransfer, or one made for the shader
    shader: AbstractShader
    occupancy: Occupancy | None = None
    visibility: AbstractVisibility | None = None


# What light passes on its way to a point: a medium that emits nothing, with gradients where that is asked for (`True`).
LightPath = Callable[[bool], Medium]


def for_derivatives(medium: Medium, wanted: Medium, moved: Any = None) -> Medium:
    """What a march goes through that is differentiated in the leaves of `wanted` that are not `None`, and with `moved`, of rays or steps,
    in where samples lie.

    An empty brick has a derivative in the extinctions and emissions of the transfer function, since that at zero is not zero. In what
    moves samples or the entries of a table it has one only where that may make it visible, and in anything else, such as colours and
    light, none.
    """
    occupancy, transfer = medium.occupancy, wanted.transfer
    if occupancy is None or occupancy.is_bounded:
        return medium
    is_table = isinstance(transfer, AbstractTable)
    if any(name != "rgb" for name in transfer.entries) if is_table else jax.tree.leaves(transfer):
        return medium._replace(occupancy=None)
    of_colours = is_table and transfer.rgb is not None
    moves = len(jax.tree.leaves((transfer, wanted.field, moved))) > of_colours
    return medium._replace(occupancy=occupancy.for_slopes()) if moves else medium


def taking_all(medium: Medium) -> Medium:
    """A medium in which nothing that may have a derivative is skipped, along the paths of light neither."""
    is_occupancy = lambda x: isinstance(x, Occupancy)
    dropped = lambda x: None if is_occupancy(x) and not x.is_bounded else x
    return jax.tree.map(dropped, medium, is_leaf=is_occupancy)


def showing_all(media: Any) -> Any:
    """Media, whole or in parts, in which nothing that may have a derivative is skipped: as `taking_all`, in the same structure."""
    is_occupancy = lambda x: isinstance(x, Occupancy)
    shown = lambda x: jax.tree.map(jnp.zeros_like, x) if is_occupancy(x) and not x.is_bounded else x
    return jax.tree.map(shown, media, is_leaf=is_occupancy)
