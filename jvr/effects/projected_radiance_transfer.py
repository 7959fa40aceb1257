"""Radiance transfer as it was projected: coefficients at the nodes of a grid, and what they were made of."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from jvr.model.harmonics.basis import count
from jvr.model.transfer import AbstractTransfer


class ProjectedRadianceTransfer(eqx.Module):
    """Radiance transfer as it was projected, for the transfer function of that time.

    - `luminance`: `(x, y, z, 1, bands)` for a radiance transfer without colour, else `(x, y, z, 3, bands)`, or the luma alone where
    - `chroma`: `(x, y, z, 2, fewer bands)` holds orange-blue and green-purple differences (YCoCg); else `None`.
    - `solid`: `(x, y, z)`, how much of an opaque surface there is, from above 0 to 1; 0 where nothing is near and nothing was projected.
    - `facing`: `(x, y, z, 3)`, the unit vector away from the medium, shorter where that has hardly a direction.
    - `transfer`: the transfer function of that time, which the shadow of surfaces on themselves is found with.
    - `cache_key`: checksums of what it was made of (`jvr.model.kept.content`).
    - `scattered`: whether the scattering pass has been made.
    - `pinned`: whether it stays as it is although the scene is another.
    """

    luminance: Float[Array, "x y z channels bands"]
    chroma: Float[Array, "x y z 2 fewer"] | None
    solid: Float[Array, "x y z"]
    facing: Float[Array, "x y z 3"]
    transfer: AbstractTransfer
    cache_key: UInt32[Array, "parts 2"]
    scattered: bool = eqx.field(static=True, default=False)
    pinned: bool = eqx.field(static=True, default=False)

    @property
    def coefficients(self) -> Float[Array, "x y z channels bands"]:
        """Coefficients of each colour, or of all of them in one channel."""
        if self.chroma is None:
            return self.luminance
        luma = self.luminance[..., 0, :]
        missing = luma.shape[-1] - self.chroma.shape[-1]
        orange, green = jnp.moveaxis(jnp.pad(self.chroma, ((0, 0),) * 4 + ((0, missing),)), 3, 0)
        return jnp.stack([luma + orange - green, luma + green, luma - orange - green], axis=3)

    @property
    def nbytes(self) -> int:
        """Memory of the coefficients."""
        return sum(x.size * x.dtype.itemsize for x in (self.luminance, self.chroma, self.solid, self.facing) if x is not None)

    def separated(self, order: int) -> "ProjectedRadianceTransfer":
        """The same as luma, and colour differences up to an order (YCoCg, whose inverse is exact)."""
        red, green, blue = jnp.moveaxis(self.coefficients, 3, 0)
        luma = 0.25 * (red + blue) + 0.5 * green
        chroma = jnp.stack([0.5 * (red - blue), green - luma], axis=3)[..., : count(order)]
        return dataclasses.replace(self, luminance=luma[..., None, :], chroma=chroma)
