"""Bijectors: maps from unconstrained space, in which a solver moves, to the values that an unknown may take.

A solver moves a vector of unconstrained numbers. Solvers that keep to bounds move the values themselves between the ends of their
ranges; others need a smooth map from unconstrained space into the range.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.model.ranges import Entries, Increasing, Interval, Range, UnitVector
from jvr.names import Renamed
from jvr.numerics import normalise, rounded_into

# How near to the end of its range a start value may lie: at the end itself a smooth map has no slope and the fit cannot leave.
MARGIN = 1e-3
# What is positive, or a gap between positions, stays above this fraction of its scale.
LEAST = 1e-6

Bounds = tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]


class AbstractBijector(eqx.Module):
    """A map from unconstrained numbers, within bounds, onto the values that an unknown may take."""

    reach = Renamed("trust_radius")

    @abc.abstractmethod
    def forward(self, unconstrained: Float[Array, "..."]) -> Float[Array, "..."]:
        """The value."""

    @abc.abstractmethod
    def inverse(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """The unconstrained number that gives `value`, or the nearest value that has one."""

    @abc.abstractmethod
    def bounds(self, unconstrained: Float[np.ndarray, "..."]) -> Bounds:
        """The least and the largest unconstrained number for each of `unconstrained`."""

    @abc.abstractmethod
    def trust_radius(self, unconstrained: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """How far from each of `unconstrained` a linearisation of the pictures may be good for."""


def _unbounded(unconstrained: Float[np.ndarray, "..."]) -> Bounds:
    return np.full(unconstrained.shape, -np.inf), np.full(unconstrained.shape, np.inf)


class Identity(AbstractBijector):
    """The identity: any real value."""

    def forward(self, unconstrained: Float[Array, "..."]) -> Float[Array, "..."]:
        return unconstrained

    def inverse(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        return value

    def bounds(self, unconstrained: Float[np.ndarray, "..."]) -> Bounds:
        return _unbounded(unconstrained)

    def trust_radius(self, unconstrained: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        return np.full(unconstrained.shape, np.inf)


class Bounded(AbstractBijector):
    """The value itself between `low` and `high`, for solvers that keep to bounds; in units of `scale`, a typical value."""

    low: float = eqx.field(static=True, default=0.0)
    high: float = eqx.field(static=True, default=1.0)
    scale: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=1.0)

    def forward(self, unconstrained: Float[Array, "..."]) -> Float[Array, "..."]:
        value = self.scale * unconstrained
        # The product may be rounded out of its range; an unknown at its bound keeps its slope, so that it can leave.
        return rounded_into(value, self.low, self.high)

    def inverse(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.clip(value, self.low, self.high) / self.scale

    def bounds(self, unconstrained: Float[np.ndarray, "..."]) -> Bounds:
        ends = (np.full(unconstrained.shape, end / float(self.scale)) for end in (self.low, self.high))
        return next(ends), next(ends)

    def trust_radius(self, unconstrained: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        # What is bounded on one side acts by its logarithm, as extinctions do: a linearisation is good for a few times the value.
        one_sided = np.isfinite(self.low) and not np.isfinite(self.high)
        return 0.1 + 2 * np.abs(unconstrained) if one_sided else np.full(unconstrained.shape, np.inf)


# Within this distance the curved bijectors change their slope by less than an order of magnitude.
TRUST_RADIUS = 2.0


class Softplus(AbstractBijector):
    """Softplus: values above `low`, `low + scale * log(1 + exp(x))`; `scale` is a typical distance from it, in the unknown's own unit."""

    scale: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=1.0)
    low: float = eqx.field(static=True, default=0.0)

    def forward(self, unconstrained: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.low + self.scale * jax.nn.softplus(unconstrained)

    def inverse(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        ratio = jnp.maximum((value - self.low) / self.scale, MARGIN)
        return ratio + jnp.log(-jnp.expm1(-ratio))

    def bounds(self, unconstrained: Float[np.ndarray, "..."]) -> Bounds:
        return _unbounded(unconstrained)

    def trust_radius(self, unconstrained: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        return np.full(unconstrained.shape, TRUST_RADIUS)


class Sigmoid(AbstractBijector):
    """A sigmoid: values between `low` and `high`."""

    low: float = eqx.field(static=True, default=0.0)
    high: float = eqx.field(static=True, default=1.0)

    def forward(self, unconstrained: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.low + (self.high - self.low) * jax.nn.sigmoid(unconstrained)

    def inverse(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        fraction = jnp.clip((value - self.low) / (self.high - self.low), MARGIN, 1 - MARGIN)
        return jnp.log(fraction) - jnp.log1p(-fraction)

    def bounds(self, unconstrained: Float[np.ndarray, "..."]) -> Bounds:
        return _unbounded(unconstrained)

    def trust_radius(self, unconstrained: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        return np.full(unconstrained.shape, TRUST_RADIUS)


class Direction(AbstractBijector):
    """Unit vectors: what has no length to be found."""

    def forward(self, unconstrained: Float[Array, "3"]) -> Float[Array, "3"]:
        return normalise(unconstrained)

    def inverse(self, value: Float[Array, "3"]) -> Float[Array, "3"]:
        return normalise(value)

    def bounds(self, unconstrained: Float[np.ndarray, "..."]) -> Bounds:
        return _unbounded(unconstrained)

    def trust_radius(self, unconstrained: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        # About 30 degrees.
        return np.full(unconstrained.shape, 0.5)


# Degrees, and the way of a point at the volume's surface as it turns by as much.
MOTION_RADIUS = 10.0


class Motion(AbstractBijector):
    """Motions of a pose (`jvr.model.motion`) about the centre of a volume of a `radius`: rotations in degrees, translations in units that
    move the volume's surface as far."""

    radius: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def forward(self, unconstrained: Float[Array, "6"]) -> Float[Array, "6"]:
        return unconstrained * self._unit

    def inverse(self, value: Float[Array, "6"]) -> Float[Array, "6"]:
        return value / self._unit

    def bounds(self, unconstrained: Float[np.ndarray, "..."]) -> Bounds:
        return _unbounded(unconstrained)

    def trust_radius(self, unconstrained: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        return np.full(unconstrained.shape, MOTION_RADIUS)

    @property
    def _unit(self) -> Float[Array, "6"]:
        return jnp.concatenate([jnp.ones(3, self.radius.dtype), jnp.full(3, jnp.deg2rad(self.radius))])


class Ordered(AbstractBijector):
    """Strictly increasing values with both ends free: the first as it is, then softplus of every gap over the mean gap."""

    scale: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=1.0)

    def forward(self, unconstrained: Float[Array, "n"]) -> Float[Array, "n"]:
        gaps = self.scale * jax.nn.softplus(unconstrained[1:])
        return jnp.concatenate([self.scale * unconstrained[:1], self.scale * unconstrained[0] + jnp.cumsum(gaps)])

    def inverse(self, value: Float[Array, "n"]) -> Float[Array, "n"]:
        gaps = Softplus(self.scale).inverse(jnp.diff(value))
        return jnp.concatenate([value[:1] / self.scale, gaps])

    def bounds(self, unconstrained: Float[np.ndarray, "..."]) -> Bounds:
        return _unbounded(unconstrained)

    def trust_radius(self, unconstrained: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        return np.full(unconstrained.shape, TRUST_RADIUS)


class Gaps(AbstractBijector):
    """Strictly increasing values for solvers that keep to bounds: the first, then every gap, in units of the mean gap `scale`."""

    scale: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=1.0)

    def forward(self, unconstrained: Float[Array, "n"]) -> Float[Array, "n"]:
        return self.scale * jnp.cumsum(unconstrained)

    def inverse(self, value: Float[Array, "n"]) -> Float[Array, "n"]:
        return jnp.concatenate([value[:1], jnp.diff(value)]) / self.scale

    def bounds(self, unconstrained: Float[np.ndarray, "..."]) -> Bounds:
        low, high = _unbounded(unconstrained)
        low[1:] = MARGIN
        return low, high

    def trust_radius(self, unconstrained: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        return np.full(unconstrained.shape, 0.5)


class Entrywise(AbstractBijector):
    """A map of its own for each entry of a vector."""

    parts: tuple[AbstractBijector, ...]

    def forward(self, unconstrained: Float[Array, "n"]) -> Float[Array, "n"]:
        return jnp.concatenate([part.forward(x) for part, x in self._apart(unconstrained)])

    def inverse(self, value: Float[Array, "n"]) -> Float[Array, "n"]:
        return jnp.concatenate([part.inverse(x) for part, x in self._apart(value)])

    def bounds(self, unconstrained: Float[np.ndarray, "n"]) -> Bounds:
        low, high = zip(*(part.bounds(x) for part, x in self._apart(unconstrained)), strict=True)
        return np.concatenate(low), np.concatenate(high)

    def trust_radius(self, unconstrained: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return np.concatenate([part.trust_radius(x) for part, x in self._apart(unconstrained)])

    def _apart(self, values: Any) -> Any:
        """Each map with its entry, `(1,)`."""
        return [(part, values[i : i + 1]) for i, part in enumerate(self.parts)]


def bijector_of(within: Range, value: Float[Array, "..."], voxel: Float[Array, ""], bounds: Interval | None) -> AbstractBijector:
    """The map for an unknown of a declared range: of its values within the range and `bounds`, or with `None` a smooth one from all of
    unconstrained space into the range.

    `voxel`: the smallest spacing of the volume, by which typical extinctions are known.
    """
    if isinstance(within, UnitVector):
        return Direction()
    if isinstance(within, Entries):
        # Of one scale: an entry that is zero has none of its own.
        return Entrywise(tuple(bijector_of(interval, value, voxel, bounds) for interval in within.intervals))
    if isinstance(within, Increasing):
        if value.size < 2:
            return Identity()  # it has no gap
        scale = jnp.mean(jnp.diff(value))
        return Ordered(scale) if bounds is None else Gaps(scale)
    low, high = within.low, within.high
    if not np.isfinite(low):
        scale = jnp.ones(())
    elif np.isfinite(high):
        scale = jnp.asarray(high - low)
    else:
        scale = 1.0 / voxel if within.per_length else jnp.maximum(jnp.mean(jnp.abs(value - low)), MARGIN)
    if within.is_open:
        inset = LEAST * float(scale)
        low, high = low + inset, high - inset
    if bounds is not None:
        return Bounded(max(low, bounds.low), min(high, bounds.high), scale)
    if np.isfinite(high):
        return Sigmoid(low, high)
    return Softplus(scale, low) if np.isfinite(low) else Identity()
