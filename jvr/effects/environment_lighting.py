"""Environment lighting of a sample: the integral of material times incident light, both in spherical harmonics.

A material is even about the plane of normal `n` and eye. In this plane a band of the light with `2 l + 1` coefficients is known by its
values in `l + 1` directions, and those are all that is needed of it:

    integral M L = sum_l sum_k W_lk(theta_o) L_l(d_k),    d_k = cos(psi_k) n + sin(psi_k) t,    psi_k = k pi / (order + 1),

`t` across the normal towards the eye, `L_l` band `l` of the light: no rotation of coefficients for each sample. A part that is
symmetric about the normal or the eye alone needs one direction, that one.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.effects.self_shadow import SelfShadow, ShadedSegment, self_shadow_of
from jvr.effects.shading import surface_weight
from jvr.model.harmonics.basis import band_of, basis, count
from jvr.model.material import HarmonicMaterial, Lobe, SymmetryAxis
from jvr.model.scene import Scene
from jvr.numerics import clamp, direction_and_length, dot, larger
from jvr.types import Channels, Scalar, Triple


class PlaneTable(eqx.Module):
    """`W` of one part of a material: rows of `(bands, directions, channels)` for each class and polar angle of the eye."""

    rows: Float[Array, "classes polar row"]
    shape: tuple[int, int, int] = eqx.field(static=True)
    symmetry_axis: SymmetryAxis = eqx.field(static=True)

    @classmethod
    def of(cls, lobe: Lobe, order: int) -> "PlaneTable":
        """The table of a lobe, up to an order."""
        rho = lobe.coefficients[:, :, : order + 1, : order + 1]
        bands = rho.shape[2]
        if lobe.symmetry_axis == "both":
            rho = jnp.einsum("cplmh,lmk->cplkh", rho, jnp.asarray(_in_plane(bands - 1), rho.dtype))
        else:
            # Y_l0 at its own pole.
            rho = rho / jnp.sqrt((2 * jnp.arange(bands, dtype=rho.dtype) + 1) / (4 * math.pi))[:, None, None]
        classes, polar, *shape = rho.shape
        return cls(rho.reshape(classes, polar, -1), (shape[0], shape[1], shape[2]), lobe.symmetry_axis)

    def directions(self, normal: Triple, across: Triple, w_o: Triple) -> list[Triple]:
        """Where the light is looked at."""
        if self.symmetry_axis != "both":
            return [normal if self.symmetry_axis == "normal" else w_o]
        angles = [k * math.pi / self.shape[1] for k in range(self.shape[1])]
        return [tuple(math.cos(a) * n + math.sin(a) * t for n, t in zip(normal, across, strict=True)) for a in angles]

    def at(self, place: tuple[Array, Scalar], theta: Scalar) -> Float[Array, "bands directions channels"]:
        """Weights for a class and a fraction towards the next, and a polar angle of the eye."""
        classes, polar, _ = self.rows.shape
        # What has one entry is not looked up: the compiler could not know that there is nothing to choose.
        kinds = _between(place[0], place[1]) if classes > 1 else [(0, 1.0)]
        x = clamp(theta / (math.pi / 2) * (polar - 1), 0, polar - 1)
        low = jnp.clip(jnp.floor(x), 0, max(polar - 2, 0))
        angles = _between(low.astype(jnp.int32), x - low) if polar > 1 else [(0, 1.0)]
        row = sum(v * w * self.rows[i, j] for i, v in kinds for j, w in angles)
        return jnp.asarray(row).reshape(self.shape)


def _between(low: Array, fraction: Scalar) -> list[tuple[Any, Any]]:
    """An entry and the next, with their weights."""
    return [(low, 1 - fraction), (low + 1, fraction)]


class EnvironmentLighting(eqx.Module):
    """A material under environment lighting. `light`: its coefficients, of which a sample may bring the fraction that arrives, one or for
    each colour; or `None` where each sample brings the coefficients of what arrives, all colours of the first, then of the next."""

    light: Float[Array, "bands 3"] | None
    tinted: PlaneTable | None
    unmodulated: PlaneTable | None
    positions: Float[Array, "classes"]
    threshold: Scalar
    clamped: bool = eqx.field(static=True)
    shadow: SelfShadow | None = None

    @property
    def needs_gradient(self) -> bool:
        """Whether what is reflected depends on a normal."""
        return any(table is not None and table.symmetry_axis != "eye" for table in (self.tinted, self.unmodulated))

    def reflect(
        self,
        s: Scalar,
        magnitude: Scalar,
        normal: Triple,
        w_o: Triple,
        incident: Channels,
        cut: Scalar | float = 0.0,
        here: ShadedSegment | None = None,
    ) -> tuple[Triple, Triple]:
        """What the colour of the medium is multiplied with, and what is added to that in the light's own colour.

        `incident`: of the environment, and where surfaces shadow themselves, how much of one there is; `here`: the segment, then.
        `magnitude`: length of the gradient. Where it is weak, bands of the light above the first count less, but for the fraction of a
        point that is a `cut`. The normal is turned to the eye.
        """
        zero, surface = jnp.zeros_like(s), surface_weight(magnitude, self.threshold)
        surface = surface + cut * (1 - surface)
        incident, solid = (incident, zero) if self.shadow is None else (incident[:-1], incident[-1])
        coefficients, fraction = self._light(incident, s)
        turn = jnp.where(dot(normal, w_o) < 0, -1.0, 1.0)
        normal = tuple(turn * c for c in normal)
        cosine = dot(normal, w_o)
        across, sine = direction_and_length(tuple(o - cosine * n for o, n in zip(w_o, normal, strict=True)))
        # Without a normal, or without an eye (a ray that misses), there is no angle, and arctan2 no derivative.
        there = (surface > 0) & (jnp.abs(cosine) + sine > 0)
        theta = jnp.where(there, jnp.arctan2(sine, jnp.where(there, cosine, 1.0)), 0.0)
        place = self._class(s)
        kept = [(1.0,)] * 3
        if self.shadow is not None:
            assert here is not None
            kept = self.shadow.remaining(s, magnitude, normal, w_o, here, solid)
        parts = []
        for table in (self.tinted, self.unmodulated):
            if table is None:
                parts.append((zero,) * 3)
                continue
            counts = zero + 1 if table.symmetry_axis == "eye" else surface
            scales = [kept[0], *(tuple(counts * k for k in band) for band in kept[1:])]
            radiance = _integrate(table.at(place, theta), coefficients, table.directions(normal, across, w_o), scales)
            radiance = tuple(c * r for c, r in zip(fraction, radiance, strict=True))
            parts.append(tuple(larger(r, 0.0) for r in radiance) if self.clamped else radiance)
        return parts[0], parts[1]

    def _light(self, incident: Channels, s: Scalar) -> tuple[list[Triple], Triple]:
        """Coefficients of the light at a sample, and what fraction of it arrives."""
        one = jnp.ones_like(s)
        if self.light is None:
            return [incident[i : i + 3] for i in range(0, len(incident), 3)], (one, one, one)
        return [(row[0], row[1], row[2]) for row in self.light], incident * (3 // len(incident)) if incident else (one,) * 3

    def _class(self, s: Scalar) -> tuple[Array, Scalar]:
        """The class before a scalar, and the fraction of the way to the next."""
        if self.positions.shape[0] == 1:
            return jnp.zeros_like(s, jnp.int32), jnp.zeros_like(s)
        place = jnp.interp(s, self.positions, jnp.arange(self.positions.shape[0], dtype=s.dtype))
        low = jnp.clip(jnp.floor(jax.lax.stop_gradient(place)), 0, self.positions.shape[0] - 2)
        return low.astype(jnp.int32), place - low


def environment_lighting(
    material: HarmonicMaterial,
    light: Float[Array, "bands 3"],
    *,
    clamped: bool,
    order: int,
    from_samples: bool,
    shadow: SelfShadow | None = None,
) -> EnvironmentLighting:
    """`EnvironmentLighting` up to an order; `from_samples`: each sample brings the coefficients of its light."""
    tinted, unmodulated = (None if lobe is None else PlaneTable.of(lobe, order) for lobe in (material.tinted, material.plain))
    return EnvironmentLighting(
        None if from_samples else light[: count(order)],
        tinted,
        unmodulated,
        material.positions,
        material.threshold,
        clamped,
        shadow,
    )


def _integrate(
    weights: Float[Array, "bands directions channels"], light: list[Triple], directions: list[Triple], scales: Any
) -> Triple:
    """`sum_l sum_k W_lk L_l(d_k)` in each colour; `scales[l][channel]`: what counts of a band, of those above the last as of that."""
    bands, _, channels = weights.shape
    order = min(bands, math.isqrt(len(light))) - 1
    band = band_of(order)
    total: list[Any] = [0.0] * 3
    for k, d in enumerate(directions):
        functions = basis(order, d)
        for n in range(order + 1):
            own = np.flatnonzero(band == n)
            scale = scales[min(n, len(scales) - 1)]
            for c in range(3):
                value = sum(functions[i] * light[i][c] for i in own)
                total[c] = total[c] + scale[c % len(scale)] * weights[n, k, c % channels] * value
    return tuple(total)


def _in_plane(order: int) -> np.ndarray:
    """`B[l, m, k]`: with `L_l(d_k)` as at the top of this file, `sum_k B[l, m, k] L_l(d_k)` is the coefficient `(l, m)`, `m >= 0`, of
    band `l` in the frame of normal and eye."""
    angles = np.arange(order + 1) * math.pi / (order + 1)
    functions = basis(order, (np.sin(angles), np.zeros_like(angles), np.cos(angles)))
    result = np.zeros((order + 1,) * 3)
    for band in range(order + 1):
        rows = np.stack([functions[band * (band + 1) + m] for m in range(band + 1)], axis=1)
        result[band, : band + 1] = np.linalg.pinv(rows)
    return result


def environment_lighting_of(scene: Scene) -> EnvironmentLighting:
    """A scene's material under its environment. Where samples bring the coefficients of what arrives, those of a product, the order is
    that of the material, else also that of the light."""
    environment = scene.environment_light
    assert environment is not None
    assert scene.material is not None
    material: HarmonicMaterial = scene.material.projected(scene.material_order)
    exact = scene.radiance_transfer is not None and scene.radiance_transfer.exact
    order = material.order if exact else min(material.order, environment.order)
    shadow = self_shadow_of(scene, albedo_of(scene))
    return environment_lighting(
        material, environment.coefficients, clamped=environment.clamped, order=order, from_samples=exact, shadow=shadow
    )


def albedo_of(scene: Scene) -> EnvironmentLighting | None:
    """A scene's material under light of one from everywhere, where rays of its radiance transfer pick up what it reflects."""
    if scene.radiance_transfer is None or not scene.radiance_transfer.rays_need_gradient:
        return None
    assert scene.material is not None
    everywhere = jnp.full((1, 3), math.sqrt(4 * math.pi), scene.volume.slope.dtype)
    return environment_lighting(scene.material.projected(0), everywhere, clamped=True, order=0, from_samples=False)
