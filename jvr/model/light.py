"""Lights: direction and irradiance of what reaches a point when nothing is in its way.

`direction` is the way that light travels, in the world; `irradiance` is power per unit area perpendicular to it. Colours are linear RGB, a
single number is grey. Everything is differentiable.
"""

import abc
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.model.by_value import at_most
from jvr.model.checks import float_array, radiances, require
from jvr.model.exact import Exact, Remainder, in_double
from jvr.model.parameters import GREY_OR_RGB, assign, declared, parameter
from jvr.model.parts import AbstractPart, PlanEntry, is_zero
from jvr.model.ranges import DEGREES, DIRECTION, NOT_NEGATIVE, POSITIVE, RADIANCE, Entries
from jvr.names import Renamed
from jvr.numerics import direction_and_length, divide_or_zero, perpendicular
from jvr.types import ArrayLike, Scalar, Triple, Vector


def brightness(doc: str) -> Any:
    """The declaration of a light's strength, grey or linear RGB."""
    return parameter(RADIANCE, shapes=GREY_OR_RGB, by_channel=True, doc=doc)


def way() -> Any:
    """The declaration of a light's direction."""
    return parameter(DIRECTION, doc="x, y, z, the way that the light travels")


def falloff() -> Any:
    """The declaration of how irradiance falls with distance."""
    terms = Entries((POSITIVE, NOT_NEGATIVE, NOT_NEGATIVE))
    return parameter(terms, doc="constant, linear, quadratic in the distance")


class LightSample(NamedTuple):
    """Light at a point: unit direction `w_i` towards the light, distance to it (infinite for directional light), irradiance."""

    w_i: Triple
    distance: Scalar
    irradiance: Triple


class AbstractLight(AbstractPart):
    """A light: one that comes from one direction at each point (`AbstractDeltaLight`), or one from all around (`AmbientLight`,
    `jvr.EnvironmentLight`)."""

    def title(self, name: str, scene: Any) -> str:
        return f"{name} {type(self).__name__}"

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        shown = scene.shows_lights
        return (PlanEntry(name, shown, type(self).__name__ + ("" if shown else ": nothing reflects or scatters it")),)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        fields = [name for name, f in declared(type(self)).items() if f.metadata["parameter"].within == RADIANCE]
        if fields and all(is_zero(getattr(self, name)) for name in fields):
            yield f"{self.title(name, scene)} has no strength: it is computed and adds nothing"
        elif not scene.shows_lights:
            yield f"{self.title(name, scene)} is not seen: nothing reflects or scatters it"

    @abc.abstractmethod
    def moved(self, origin: Exact) -> "AbstractLight":
        """The same light in a world whose origin is at `origin`."""

    def without(self, scene: Any) -> Any:
        shown = scene.shows_lights and len(scene.lights) > 1
        return scene.replaced(lights=tuple(light for light in scene.lights if light is not self)) if shown else None


class AbstractDeltaLight(AbstractLight):
    """A light that comes from one direction at each point, a delta light."""

    # Whether what is between the light and a point can shade it.
    casts_shadows: ClassVar[bool] = True

    arrives = Renamed("sample")

    @abc.abstractmethod
    def sample(self, x: Triple, w_o: Triple) -> LightSample:
        """Light at world position `x`, which is looked at from the unit direction `w_o` (to the eye)."""


class DirectionalLight(AbstractDeltaLight):
    """Directional light: parallel, as from the sun.

    **Arguments:** `direction`: `(3,)`, the way the light travels, of any length but zero; `irradiance`: a number or `(3,)`, not negative.
    """

    direction: Vector = way()
    irradiance: Float[Array, "..."] = brightness("irradiance")

    def __init__(self, direction: ArrayLike, irradiance: ArrayLike = 1.0):
        assign(self, direction=direction, irradiance=irradiance)

    def sample(self, x: Triple, w_o: Triple) -> LightSample:
        travels, _ = direction_and_length(_three(self.direction))
        return LightSample(tuple(-d for d in travels), jnp.full_like(x[0], jnp.inf), _rgb(self.irradiance))

    def moved(self, origin: Exact) -> "DirectionalLight":
        return self


class PointLight(AbstractDeltaLight):
    """A point that shines in all directions. Irradiance at distance `r` is `intensity / max(r, radius)^2`, or with
    `attenuation = (c, l, q)` `intensity / (c + l r + q r^2)`.

    **Arguments:** `position`: `(3,)`, world; `intensity`: power per solid angle, a number or `(3,)`, not negative; `radius`: distance
    below which the light grows no brighter, positive: at the light itself irradiance is not defined. `attenuation`: not negative, `c > 0`.
    `remainder`: of a position that JAX holds already (see `jvr.model.exact`).
    """

    position: Vector = parameter(doc="x, y, z", unit="mm")
    intensity: Float[Array, "..."] = brightness("power per solid angle")
    radius: Scalar = parameter(POSITIVE, doc="below which the light grows no brighter", unit="mm", hint="1e-3 is a good start")
    attenuation: Vector | None = falloff()
    remainder: Remainder = parameter(doc="what single precision leaves of the position")

    def __init__(
        self,
        position: ArrayLike,
        intensity: ArrayLike = 1.0,
        *,
        radius: ArrayLike = 1e-3,
        attenuation: ArrayLike | None = None,
        remainder: Remainder | None = None,
    ):
        assign(self, position=position, intensity=intensity, radius=radius, attenuation=attenuation)
        self.remainder = Remainder.left(position, self.position, remainder)

    def sample(self, x: Triple, w_o: Triple) -> LightSample:
        w_i, distance = direction_and_length(tuple(p - c for p, c in zip(_three(self.position), x, strict=True)))
        falloff = _falloff(distance, self.radius, self.attenuation)
        return LightSample(w_i, distance, tuple(i * falloff for i in _rgb(self.intensity)))

    def moved(self, origin: Exact) -> "PointLight":
        return _at(self, origin)


class SpotLight(AbstractDeltaLight):
    """A point that shines into a cone: full intensity up to the half-angle `inner` from its axis, none beyond `outer`, smooth in between
    (a cubic in the cosine).

    **Arguments:** as `PointLight`, and `direction`: `(3,)`, the axis, the way the light travels; `inner`, `outer`: degrees,
    `0 <= inner < outer <= 180`.
    """

    position: Vector = parameter(doc="x, y, z", unit="mm")
    direction: Vector = way()
    intensity: Float[Array, "..."] = brightness("power per solid angle")
    inner: Scalar = parameter(DEGREES, doc="between axis and edge of the cone", unit="degrees")
    outer: Scalar = parameter(DEGREES, doc="between axis and edge of the cone", unit="degrees")
    radius: Scalar = parameter(POSITIVE, doc="below which the light grows no brighter", unit="mm", hint="1e-3 is a good start")
    attenuation: Vector | None = falloff()
    remainder: Remainder = parameter(doc="what single precision leaves of the position")

    def __init__(
        self,
        position: ArrayLike,
        direction: ArrayLike,
        intensity: ArrayLike = 1.0,
        *,
        inner: ArrayLike = 20.0,
        outer: ArrayLike = 30.0,
        radius: ArrayLike = 1e-3,
        attenuation: ArrayLike | None = None,
        remainder: Remainder | None = None,
    ):
        assign(self, position=position, direction=direction, intensity=intensity)
        assign(self, inner=inner, outer=outer, radius=radius, attenuation=attenuation)
        self.remainder = Remainder.left(position, self.position, remainder)
        require(self.outer - self.inner, lambda width: width > 0, "a SpotLight needs 0 <= inner < outer <= 180 degrees")

    def sample(self, x: Triple, w_o: Triple) -> LightSample:
        w_i, distance = direction_and_length(tuple(p - c for p, c in zip(_three(self.position), x, strict=True)))
        axis, _ = direction_and_length(_three(self.direction))
        # With squares of sines of half the angles in place of cosines, which are all 1 in a narrow cone. That between axis and light is a
        # quarter of `|axis + w_i|^2`; that of `outer` less that of `inner` is a product.
        outer, inner = jnp.deg2rad(self.outer) / 2, jnp.deg2rad(self.inner) / 2
        aside = 0.25 * sum(jnp.square(a + b) for a, b in zip(axis, w_i, strict=True))
        width = jnp.sin(outer + inner) * jnp.sin(outer - inner)
        fraction = jnp.clip(divide_or_zero(jnp.square(jnp.sin(outer)) - aside, width), 0.0, 1.0)
        falloff = fraction * fraction * (3 - 2 * fraction) * _falloff(distance, self.radius, self.attenuation)
        return LightSample(w_i, distance, tuple(i * falloff for i in _rgb(self.intensity)))

    def moved(self, origin: Exact) -> "SpotLight":
        return _at(self, origin)


class HeadLight(AbstractDeltaLight):
    """A headlight: light that comes from the eye along each ray; it casts no shadows. `irradiance`: a number or `(3,)`, not negative."""

    casts_shadows: ClassVar[bool] = False

    irradiance: Float[Array, "..."] = brightness("irradiance")

    def __init__(self, irradiance: ArrayLike = 1.0):
        assign(self, irradiance=irradiance)

    def sample(self, x: Triple, w_o: Triple) -> LightSample:
        return LightSample(w_o, jnp.full_like(x[0], jnp.inf), _rgb(self.irradiance))

    def moved(self, origin: Exact) -> "HeadLight":
        return self


class AmbientLight(AbstractLight):
    """Ambient light: the same radiance from everywhere; what is near takes some of it where the scene has an `occlusion`.
    `radiance`: a number or `(3,)`, not negative.

    It is shown by `Scene(shading=...)` and `Scene(scattering=...)`; materials show `jvr.EnvironmentLight.constant(radiance)`, which is the
    same light.
    """

    radiance: Float[Array, "..."] = brightness("radiance")

    def __init__(self, radiance: ArrayLike = 1.0):
        assign(self, radiance=radiance)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        yield from super().remarks(name, scene, stats)
        reflects = scene.shading is not None and not is_zero(at_most(scene.shading).ambient_reflectance())
        if scene.shows_lights and scene.scattering is None and not reflects:
            yield f"{self.title(name, scene)} is not seen: shading.ambient is zero"

    def moved(self, origin: Exact) -> "AmbientLight":
        return self

    @property
    def rgb(self) -> Triple:
        return _rgb(self.radiance)


def sphere_light(
    position: ArrayLike, radius: float, intensity: ArrayLike, *, key: Array, samples: int = 16
) -> tuple[PointLight, ...]:
    """A luminous ball as point lights at uniformly random places on its surface, for soft shadows: `Scene(lights=sphere_light(...))`.

    The places are the same for every pixel, so that their error shows as overlapping shadows rather than as noise, and falls as one over
    the square root of `samples`. Differentiable in `position` and `intensity`.
    """
    offsets = jax.random.normal(key, (samples, 3))
    offsets = offsets / jnp.linalg.norm(offsets, axis=1, keepdims=True)
    return _spread(position, radius, intensity, offsets)


def disc_light(
    position: ArrayLike, direction: ArrayLike, radius: float, intensity: ArrayLike, *, key: Array, samples: int = 16
) -> tuple[PointLight, ...]:
    """As `sphere_light`, with places on a disc across `direction`. It shines to both sides."""
    angle, square = jax.random.uniform(key, (2, samples), minval=0.0, maxval=jnp.asarray([[2 * np.pi], [1.0]]))
    axis, _ = direction_and_length(_three(DirectionalLight(direction).direction))
    u, v = (jnp.stack(side) for side in perpendicular(axis))
    offsets = jnp.sqrt(square)[:, None] * (jnp.cos(angle)[:, None] * u + jnp.sin(angle)[:, None] * v)
    return _spread(position, radius, intensity, offsets)


def _spread(position: ArrayLike, radius: float, intensity: ArrayLike, offsets: Float[Array, "n 3"]) -> tuple[PointLight, ...]:
    if not radius > 0:
        raise ValueError(f"a light's radius must be positive, not {radius!r}; a PointLight has none")
    float_array(position, "position", (3,))
    center, n = in_double(position), offsets.shape[0]
    return tuple(PointLight(center + radius * in_double(offset), radiances(intensity, "intensity") / n) for offset in offsets)


def _at(light: Any, origin: Exact) -> Any:
    """A light with a position, moved."""
    position = Exact(light.position, light.remainder.beside(light.position)).minus(origin).rounded()
    return eqx.tree_at(lambda x: (x.position, x.remainder), light, (position, Remainder.left(position, position)))


def _falloff(distance: Scalar, radius: Scalar, attenuation: Vector | None) -> Scalar:
    if attenuation is None:
        return 1.0 / jnp.square(jnp.maximum(distance, radius))
    constant, linear, quadratic = attenuation
    return 1.0 / (constant + distance * (linear + distance * quadratic))


def _rgb(colour: Float[Array, "..."]) -> Triple:
    return (colour, colour, colour) if colour.ndim == 0 else _three(colour)


def _three(v: Float[Array, "3"]) -> Triple:
    return v[0], v[1], v[2]
