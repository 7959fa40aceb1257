"""Environments in pixels: radiance from far away as a latitude-longitude map, seen directly behind a volume.

y is up; columns go around as in OpenEXR: +X at a quarter of the width, +Z at its middle, -X at three quarters. Row `i` of `H` is
at the polar angle `pi (i + 1/2) / H`.
"""

import os
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.model import harmonics
from jvr.model.checks import colours, float_array
from jvr.model.environment import EnvironmentLight, check_map, map_pixels, order_of_harmonics
from jvr.model.harmonics.projection import map_directions
from jvr.model.parameters import TRIPLE, arguments, assign, choice, parameter
from jvr.model.parts import AbstractPart, PlanEntry, is_zero
from jvr.model.ranges import AT_LEAST_ONE, COLOUR, DIRECTION, NOT_NEGATIVE
from jvr.numerics import clamp, normalise
from jvr.types import ArrayLike

# Of linear Rec. 709 colours.
LUMINANCE = (0.2126, 0.7152, 0.0722)
# Pixels that are filtered at a time.
BATCH = 2**20
# A direction so near to the poles, as a fraction of its length, has no azimuth.
AT_POLE = 1e-7


class EnvironmentMap(AbstractPart):
    """An environment in pixels: radiance that arrives from each direction, the same at every point.

    As `Scene(background=...)` it is seen where rays leave the scene; as `Scene(environment=...)` it lights, by its projection on
    harmonics (`to_harmonics`). One object may do both.

    **Arguments:** `pixels`: `(height, 2 height, 3)` linear radiance, y up, row 0 at the pole above, +X at a quarter of the width, +Z at its
    middle; differentiable. `order`: of the harmonics where it lights. **Raises** `ValueError` for maps that are not 2:1 or hold NaN,
    infinite or negative radiance.
    """

    pixels: Float[Array, "height width 3"] = parameter(NOT_NEGATIVE, by_channel=True, doc="radiance, latitude-longitude, y up")
    order: int = order_of_harmonics()

    def __init__(self, pixels: ArrayLike, *, order: int = 3):
        check_map(pixels)
        assign(self, pixels=pixels, order=order)

    @classmethod
    @arguments(order=order_of_harmonics())
    def from_image(cls, image: str | os.PathLike | ArrayLike, *, order: int = 3) -> "EnvironmentMap":
        """The map in an OpenEXR or Radiance `.hdr` file, or of `(height, 2 height, 3)` linear radiance. **Raises** as the constructor, and
        what reading a file raises."""
        return cls(map_pixels(image), order=order)

    @classmethod
    @arguments(
        below=parameter(COLOUR, doc="straight down", shapes=TRIPLE),
        horizon=parameter(COLOUR, doc="at the horizon", shapes=TRIPLE),
        above=parameter(COLOUR, doc="straight up", shapes=TRIPLE),
        up=parameter(DIRECTION, doc="x, y, z", shapes=TRIPLE),
        height=choice(AT_LEAST_ONE, doc="rows of pixels", most=4096),
        order=order_of_harmonics(),
    )
    def gradient(
        cls,
        below: ArrayLike,
        horizon: ArrayLike,
        above: ArrayLike,
        *,
        up: ArrayLike = (0.0, 0.0, 1.0),
        height: int = 64,
        order: int = 3,
    ) -> "EnvironmentMap":
        """A sky over a floor, without a file: colours `(3,)`, linear in the sine of the elevation from `below` to the `horizon` and on to
        what is `above`. `up` is that of medical volumes by default, z. Differentiable in the colours and `up`."""
        ends = [colours(value, name, (3,)) for value, name in ((below, "below"), (horizon, "horizon"), (above, "above"))]
        directions, _ = map_directions(height, 2 * height)
        axis = normalise(float_array(up, "up", (3,)))
        sine = (jnp.asarray(directions, axis.dtype) @ axis)[..., None]
        down, middle, high = ends
        return cls(middle + jnp.where(sine < 0, -sine * (down - middle), sine * (high - middle)), order=order)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.pixels.shape[0], self.pixels.shape[1]

    def title(self, name: str, scene: Any) -> str:
        both = "background and environment" if scene.background is self and scene.environment is self else name
        return f"{both} {type(self).__name__}"

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        size = f"a map of {self.shape[0]} x {self.shape[1]} pixels"
        if name == "background":
            return (PlanEntry(name, True, f"{size}, seen where rays leave"),)
        return (PlanEntry(name, True, f"environment lighting, {size} on {(self.order + 1) ** 2} coefficients for each picture"),)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        if is_zero(self.pixels):
            yield f"{name} is a map that is black everywhere: it is computed and adds nothing"

    def without(self, scene: Any) -> Any:
        places = [name for name in ("background", "environment") if getattr(scene, name) is self]
        return scene.replaced(**dict.fromkeys(places))

    def radiance(self, directions: ArrayLike) -> Float[Array, "n 3"]:
        """Radiance from directions `(n, 3)` of any length, bilinear between the middles of pixels.

        Once around it wraps. Between the first row and the pole above it goes to the mean of that row, which is what is seen at the pole
        itself, and so below: a function without a jump, whose derivative is bounded; at the poles that is taken as 0.
        """
        height, width = self.shape
        d = float_array(directions, "directions", (None, 3)).astype(self.pixels.dtype)
        u, v = _place_of(d)
        row, low = _floor(clamp(v * height - 0.5, 0.0, height - 1.0))
        column, left = _floor(u * width - 0.5)
        rows = [jnp.clip(row + i, 0, height - 1) for i in (0, 1)]
        columns = [(column + i) % width for i in (0, 1)]
        read = lambda i, k: self.pixels[rows[i], columns[k]]
        across = lambda i: read(i, 0) * (1 - left)[:, None] + read(i, 1) * left[:, None]
        inner = across(0) * (1 - low)[:, None] + across(1) * low[:, None]
        for pole, distance in ((0, v), (height - 1, 1 - v)):
            near = clamp(2 * height * distance, 0.0, 1.0)[:, None]
            inner = jnp.mean(self.pixels[pole], axis=0) * (1 - near) + inner * near
        return inner

    def rotated(self, rotation: ArrayLike) -> "EnvironmentMap":
        """The environment turned by a `(3, 3)` rotation: what came from `d` comes from `R d`, resampled bilinearly."""
        directions, _ = map_directions(*self.shape)
        turn = float_array(rotation, "rotation", (3, 3))
        # Where each pixel of the turned map was before.
        before = jnp.asarray(directions.reshape(-1, 3), turn.dtype) @ turn
        return EnvironmentMap(self.radiance(before).reshape(self.pixels.shape), order=self.order)

    def to_harmonics(self, order: int) -> EnvironmentLight:
        """Its projection on harmonics, each pixel constant over its solid angle (`jvr.sh.project_map`)."""
        return EnvironmentLight(harmonics.project_map(self.pixels, order))

    def prefiltered(self, exponent: ArrayLike) -> "EnvironmentMap":
        """What a glossy mirror sees, `L_s(r) = (s + 1) / (2 pi) integral L(w) max(r . w, 0)^s dw` (course notes on GPU-based volume
        ray-casting, Eurographics 2009, 8.4.2.2), for each direction `r` of its pixels.

        By quadrature over all pixels, with weights whose sum is 1: a constant map stays as it is, and with a large exponent any map does.
        By Fourier transforms along the rows: `height^2 width log(width)` operations. Differentiable in `exponent` and pixels.
        """
        return EnvironmentMap(_convolved(self.pixels, float_array(exponent, "exponent", ())), order=self.order)

    def irradiance(self) -> "EnvironmentMap":
        """The irradiance `E(n) = integral L(w) max(n . w, 0) dw` of surfaces that face `n`, for each direction `n` of its pixels: pi times
        `prefiltered(1)`. What a white Lambertian surface reflects is `E / pi`."""
        return EnvironmentMap(jnp.pi * self.prefiltered(1.0).pixels, order=self.order)

    def table(self) -> "DirectionTable":
        """What directions are drawn from, to be made once for many: the probability of a pixel is its mean luminance times its solid
        angle. Detached from the pixels."""
        return _table(jax.lax.stop_gradient(self.pixels))

    def sample(self, u1: ArrayLike, u2: ArrayLike) -> Float[Array, "n 3"]:
        """Unit directions `(n, 3)`, drawn by numbers `(n,)` that are uniform in [0, 1): `self.table().sample(u1, u2)`."""
        return self.table().sample(u1, u2)

    def pdf(self, directions: ArrayLike) -> Float[Array, "n"]:
        """The density of `sample` at directions `(n, 3)`, per solid angle; positive wherever luminance is."""
        return self.table().pdf(directions)


class DirectionTable(NamedTuple):
    """Probabilities of the rows of a map, and of the pixels within each row; the sums of both up to and with each."""

    rows: Float[Array, "height"]
    pixels: Float[Array, "height width"]
    row_ends: Float[Array, "height"]
    pixel_ends: Float[Array, "height width"]

    def sample(self, u1: ArrayLike, u2: ArrayLike) -> Float[Array, "n 3"]:
        """See `EnvironmentMap.sample`."""
        height, width = self.pixels.shape
        first, second = (float_array(u, name, (None,)).astype(self.rows.dtype) for u, name in ((u1, "u1"), (u2, "u2")))
        row, down = _invert(self.row_ends[None], self.rows[None], jnp.zeros(first.shape, jnp.int32), first)
        column, along = _invert(self.pixel_ends, self.pixels, row, second)
        # Uniform within a pixel: in the cosine of the polar angle, and around.
        top, bottom = (jnp.cos(jnp.pi * (row + i) / height) for i in (0, 1))
        y = clamp(top + (bottom - top) * down, -1.0, 1.0)
        around = 2 * jnp.pi * (0.5 - (column + along) / width)
        across = jnp.sqrt((1 - y) * (1 + y))
        return jnp.stack([across * jnp.sin(around), y, across * jnp.cos(around)], axis=1)

    def pdf(self, directions: ArrayLike) -> Float[Array, "n"]:
        """See `EnvironmentMap.pdf`."""
        height, width = self.pixels.shape
        u, v = _place_of(float_array(directions, "directions", (None, 3)).astype(self.rows.dtype))
        row = jnp.clip(jnp.floor(v * height).astype(jnp.int32), 0, height - 1)
        column = jnp.floor(u * width).astype(jnp.int32) % width
        return self.rows[row] * self.pixels[row, column] / _solid_angle(height, width, self.rows.dtype)[row]


def _place_of(d: Float[Array, "n 3"]) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Where on a map directions are, `u` from its left and `v` from its top, both from 0 to 1. At the poles, where `u` could be anything,
    both have the derivative zero."""
    x, y, z = d[:, 0], d[:, 1], d[:, 2]
    square = x * x + z * z
    at_pole = square <= (AT_POLE * y) ** 2
    x, z, square = (jnp.where(at_pole, stand_in, value) for stand_in, value in ((0.0, x), (1.0, z), (1.0, square)))
    v = jnp.where(at_pole, jnp.where(y < 0, 1.0, 0.0), jnp.arctan2(jnp.sqrt(square), y) / jnp.pi)
    return 0.5 - jnp.arctan2(x, z) / (2 * jnp.pi), v


def _floor(x: Float[Array, "n"]) -> tuple[Int[Array, "n"], Float[Array, "n"]]:
    """The whole number below, and what is left."""
    whole = jax.lax.stop_gradient(jnp.floor(x))
    return whole.astype(jnp.int32), x - whole


def _solid_angle(height: int, width: int, dtype: Any) -> Float[Array, "height"]:
    """Of a pixel of each row."""
    return jnp.asarray(map_directions(height, width)[1], dtype)


def _table(pixels: Float[Array, "height width 3"]) -> DirectionTable:
    height, width, _ = pixels.shape
    luminance = pixels @ jnp.asarray(LUMINANCE, pixels.dtype)
    # Means over each pixel of what `radiance` makes of it and its neighbours: beside a lamp it is light, too, and to be drawn.
    poles = jnp.mean(luminance[0]), jnp.mean(luminance[-1])
    above = jnp.concatenate([jnp.full((1, width), poles[0]), luminance[:-1]])
    below = jnp.concatenate([luminance[1:], jnp.full((1, width), poles[1])])
    rows = (above + 6 * luminance + below) / 8
    mean = (jnp.roll(rows, 1, axis=1) + 6 * rows + jnp.roll(rows, -1, axis=1)) / 8
    power = mean * _solid_angle(height, width, pixels.dtype)[:, None]
    of_rows = jnp.sum(power, axis=1)
    # Where everything is black all directions are alike; a row that is has no pixel to be drawn.
    total, is_black = jnp.sum(of_rows), of_rows == 0
    plain = jnp.full_like(power, 1 / width)
    pixels_in_row = jnp.where(is_black[:, None], plain, power / jnp.where(is_black, 1.0, of_rows)[:, None])
    uniform = _solid_angle(height, width, pixels.dtype) * width / (4 * jnp.pi)
    row_probability = jnp.where(total > 0, of_rows / jnp.where(total > 0, total, 1.0), uniform)
    return DirectionTable(row_probability, pixels_in_row, _ends(row_probability), _ends(pixels_in_row))


def _ends(probability: Float[Array, "*rows n"]) -> Float[Array, "*rows n"]:
    """Cumulated sums along the last axis. What has no probability ends where it begins, however sums are rounded, and is never drawn."""
    sums = jnp.where(probability > 0, jnp.cumsum(probability, axis=-1), 0.0)
    return jax.lax.cummax(sums, axis=sums.ndim - 1)


def _invert(
    ends: Float[Array, "rows n"], probability: Float[Array, "rows n"], row: Int[Array, "samples"], u: Float[Array, "samples"]
) -> tuple[Int[Array, "samples"], Float[Array, "samples"]]:
    """Which entry of its row each `u` falls in, where their cumulated probabilities are their `ends`, and where in it, 0 to 1."""
    last = ends.shape[1] - 1
    # Rounded sums end a little off 1.
    u = jnp.minimum(u * ends[row, last], jnp.nextafter(ends[row, last], jnp.zeros_like(u)))

    def halve(_: Any, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = (low + high) // 2
        beyond = ends[row, middle] <= u
        return jnp.where(beyond, jnp.minimum(middle + 1, last), low), jnp.where(beyond, high, middle)

    start = jnp.zeros_like(row), jnp.full_like(row, last)
    index, _ = jax.lax.fori_loop(0, last.bit_length() + 1, halve, start)
    chance = probability[row, index]
    return index, clamp((u - (ends[row, index] - chance)) / jnp.where(chance > 0, chance, 1.0), 0.0, 1.0)


def _convolved(pixels: Float[Array, "height width 3"], exponent: Float[Array, ""]) -> Float[Array, "height width 3"]:
    """Weighted means of all pixels, with weights `max(r . w, 0)^exponent` times solid angle."""
    height, width, _ = pixels.shape
    dtype = pixels.dtype
    polar = jnp.pi * (jnp.arange(height, dtype=dtype) + 0.5) / height
    half_turn = jnp.square(jnp.sin(jnp.pi * jnp.arange(width, dtype=dtype) / width))
    solid_angle = _solid_angle(height, width, dtype)
    spectrum = jnp.fft.rfft(pixels * solid_angle[:, None, None], axis=1)

    def row(angle: Float[Array, ""]) -> Float[Array, "width 3"]:
        # 1 - cosine of the angle between directions, without cancellation: near the peak a large exponent needs its digits.
        apart = jnp.square(jnp.sin((angle - polar) / 2))[:, None]
        gap = 2 * (apart + (jnp.sin(angle) * jnp.sin(polar))[:, None] * half_turn)
        seen = gap < 1
        kernel = jnp.where(seen, jnp.exp(exponent * jnp.log1p(-jnp.where(seen, gap, 0.0))), 0.0)
        total = jnp.sum(kernel * solid_angle[:, None])
        product = jnp.einsum("hk,hkc->kc", jnp.fft.rfft(kernel, axis=1), spectrum)
        return jnp.fft.irfft(product, width, axis=0) / total

    # Transforms round: what is zero everywhere around must not become negative.
    return jnp.maximum(jax.lax.map(row, polar, batch_size=max(1, BATCH // (height * width))), 0.0)
