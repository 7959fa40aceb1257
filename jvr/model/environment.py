"""Environment lighting: radiance from far away as a function of direction, in spherical harmonics."""

import math
import os
from collections.abc import Callable, Iterator
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.model import harmonics
from jvr.model.checks import float_array, known, radiances, require
from jvr.model.exact import Exact
from jvr.model.harmonics.projection import cap
from jvr.model.light import AbstractLight
from jvr.model.parameters import GREY_OR_RGB, TRIPLE, arguments, assign, choice, parameter
from jvr.model.parts import PlanEntry, is_zero, spelling
from jvr.model.ranges import DIRECTION, NOT_NEGATIVE, POSITIVE, RADIANCE, Interval
from jvr.numerics import normalise
from jvr.pictures import as_radiance
from jvr.types import ArrayLike


def order_of_harmonics() -> Any:
    """The declaration of the order of an environment."""
    return choice(Interval(low=0.0), doc="order of the harmonics", hint="3 is a good start", most=10)


def radiance_of_light() -> Any:
    """The declaration of the radiance of an environment."""
    return parameter(RADIANCE, doc="radiance", shapes=GREY_OR_RGB)


class EnvironmentLight(AbstractLight):
    """An environment light: radiance that arrives from direction `d` (pointing away from the scene): `L_i(d) = sum_j c_j Y_j(d)`, the
    same at every point.

    **Arguments:** `coefficients`: `((order + 1)^2, 3)`, linear RGB, of `jvr.sh`'s functions in the world's axes; differentiable. `clamped`:
    where the series rings below zero, what a sample reflects is cut off at zero; without it negative radiance may reach the picture.

    Sums of environments are environments: `probe + EnvironmentLight.disc(...)`.
    """

    coefficients: Float[Array, "bands 3"] = parameter(by_channel=True, doc="of the harmonics, red, green, blue")
    clamped: bool = choice(doc="whether negative radiance is cut off")

    def __init__(self, coefficients: ArrayLike, *, clamped: bool = True):
        assign(self, coefficients=coefficients, clamped=clamped)
        harmonics.order_of(self.coefficients)

    def title(self, name: str, scene: Any) -> str:
        return f"{name} and material {spelling(scene.material)}" if scene.environment is self else f"{name} {type(self).__name__}"

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry(name, True, f"environment lighting, {len(self.coefficients)} coefficients"),)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        if is_zero(self.coefficients):
            yield f"{name} has no strength: it is computed and adds nothing"

    def without(self, scene: Any) -> Any:
        if scene.environment is self:
            return scene.replaced(environment=None)
        return scene.replaced(lights=tuple(light for light in scene.lights if light is not self))

    def moved(self, origin: Exact) -> "EnvironmentLight":
        return self

    @classmethod
    @arguments(
        order=order_of_harmonics(),
        window=parameter(POSITIVE, doc="band from which nothing is left"),
        clamped=choice(doc="whether negative radiance is cut off"),
    )
    def from_image(
        cls, image: str | os.PathLike | ArrayLike, order: int = 3, *, window: float | int | None = None, clamped: bool = True
    ) -> "EnvironmentLight":
        """The projection of a latitude-longitude map, y up: +X at u = 1/4, +Z at the centre, -X at u = 3/4.

        **Arguments:** `image`: an OpenEXR or Radiance `.hdr` file, or `(height, 2 height, 3)` linear radiance; `window`: as
        `jvr.sh.window`, against ringing about bright lamps; `None` for none. **Raises** `ValueError` for maps that are not 2:1 or hold NaN,
        infinite or negative radiance, and what reading a file raises.
        """
        return cls(_windowed(harmonics.project_map(map_pixels(image), order), window), clamped=clamped)

    @classmethod
    def from_function(
        cls, fn: Callable[[Float[Array, "n 3"]], Float[Array, "n 3"]], order: int = 3, *, window: float | int | None = None
    ) -> "EnvironmentLight":
        """The projection of radiance given as a function of unit directions, `(n, 3)` -> `(n, 3)`."""
        return cls(_windowed(harmonics.project(fn, order), window))

    @classmethod
    @arguments(radiance=radiance_of_light(), order=order_of_harmonics())
    def constant(cls, radiance: ArrayLike = 1.0, order: int = 0) -> "EnvironmentLight":
        """The same radiance, a number or `(3,)`, from everywhere."""
        rgb = jnp.broadcast_to(radiances(radiance, "radiance"), (3,))
        coefficients = jnp.zeros(((order + 1) ** 2, 3), rgb.dtype)
        return cls(coefficients.at[0].set(math.sqrt(4 * math.pi) * rgb))

    @classmethod
    @arguments(
        towards=parameter(DIRECTION, doc="x, y, z, from the scene to the light", shapes=TRIPLE),
        half_angle=parameter(Interval(0.0, 180.0, "(]"), doc="from the middle to the rim", unit="degrees"),
        radiance=radiance_of_light(),
        order=order_of_harmonics(),
    )
    def disc(cls, towards: ArrayLike, half_angle: ArrayLike, radiance: ArrayLike = 1.0, order: int = 3) -> "EnvironmentLight":
        """A round area light, far away: `radiance` (a number or `(3,)`) from all directions within `half_angle` degrees of `towards`,
        `(3,)`; projected in closed form and differentiable in all three. **Raises** `ValueError` for angles outside of 0 to 180."""
        angle = float_array(half_angle, "half_angle", ())
        axis = float_array(towards, "towards", (3,))
        rgb = jnp.broadcast_to(radiances(radiance, "radiance"), (3,))
        kernel = jnp.stack(cap(2 * jnp.square(jnp.sin(jnp.deg2rad(angle) / 2)), order))
        lobe = harmonics.evaluate(order, normalise(axis)[None])[0]
        return cls(harmonics.convolve(lobe, kernel)[:, None] * rgb)

    @property
    def order(self) -> int:
        return harmonics.order_of(self.coefficients)

    def rotated(self, rotation: ArrayLike) -> "EnvironmentLight":
        """The environment turned by a `(3, 3)` rotation: what came from `d` comes from `R d`. Coefficients alone are turned."""
        return EnvironmentLight(harmonics.rotate(self.coefficients, rotation), clamped=self.clamped)

    def radiance(self, directions: ArrayLike) -> Float[Array, "n 3"]:
        """Radiance from directions `(n, 3)`, with whatever ringing there is."""
        return harmonics.evaluate(self.order, directions) @ self.coefficients

    def __add__(self, other: "EnvironmentLight") -> "EnvironmentLight":
        if not isinstance(other, EnvironmentLight):
            return NotImplemented
        large, small = sorted((self.coefficients, other.coefficients), key=len, reverse=True)
        return EnvironmentLight(large.at[: len(small)].add(small), clamped=self.clamped and other.clamped)


def map_pixels(image: str | os.PathLike | ArrayLike) -> Float[Array, "height width 3"]:
    """The radiance of a latitude-longitude map, of a file or an array; **raises** as `EnvironmentLight.from_image`."""
    if isinstance(image, str | os.PathLike):
        from jvr.io.environment import read_environment

        image = read_environment(image)
    check_map(image)
    pixels = float_array(image, "an environment map", (None, None, 3))
    require(pixels, NOT_NEGATIVE.holds, "an environment map must be finite and not negative: mend its pixels")
    return pixels


def check_map(image: ArrayLike) -> None:
    """**Raises** `ValueError` for codes in place of radiance, and for maps that are not 2:1."""
    if known(image) is not None:
        as_radiance(image, "an environment map")
    height, width, _ = float_array(image, "an environment map", (None, None, 3)).shape
    if width != 2 * height:
        raise ValueError(f"an environment map is twice as wide as high, not {width} x {height}: crop or resample it to 2:1")


def _windowed(coefficients: Float[Array, "bands 3"], window: float | int | None) -> Float[Array, "bands 3"]:
    return coefficients if window is None else harmonics.window(coefficients, window)
