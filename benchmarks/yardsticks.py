"""What one would write first; `jvr` is measured against these in the same run."""

from typing import Any

import jax
import jax.numpy as jnp

import jvr
from jvr.march.steps import Rays


def vmapped_march(volume: jvr.Volume, transfer: jvr.LutTransfer, rays: Rays, dt: Any, segments: int) -> Any:
    """`vmap` of a `fori_loop` over one ray, with `(3,)` vectors: the afternoon's version of a volume renderer."""
    values, (low, high), last = volume.values, transfer.domain, transfer.rgb.shape[0] - 1

    def sample(p: jax.Array) -> jax.Array:
        corner = jnp.clip(jnp.floor(p), 0, jnp.asarray(values.shape) - 2).astype(int)
        f = p - corner
        value = jnp.zeros(())
        for a in (0, 1):
            for b in (0, 1):
                for c in (0, 1):
                    weight = (f[0] if a else 1 - f[0]) * (f[1] if b else 1 - f[1]) * (f[2] if c else 1 - f[2])
                    value += weight * values[corner[0] + a, corner[1] + b, corner[2] + c]
        return value

    def one(entry: jax.Array, direction: jax.Array, length: jax.Array):
        def body(k: Any, carry: tuple[jax.Array, jax.Array]):
            radiance, clear = carry
            extent = jnp.clip(length - k * dt, 0, dt)
            u = jnp.clip((sample(entry + (k * dt + extent / 2) * direction) - low) / (high - low) * last, 0, last)
            i = jnp.clip(jnp.floor(u), 0, last - 1).astype(int)
            f = u - i
            rgb = (1 - f) * transfer.rgb[i] + f * transfer.rgb[i + 1]
            sigma_t = (1 - f) * transfer.sigma_t[i] + f * transfer.sigma_t[i + 1]
            alpha = -jnp.expm1(-sigma_t * extent)
            return radiance + clear * alpha * rgb, clear * (1 - alpha)

        return jax.lax.fori_loop(0, segments, body, (jnp.zeros(3), jnp.ones(())))

    return jax.vmap(one)(jnp.stack(rays.entry, -1), jnp.stack(rays.direction, -1), rays.length)


def kept_march(medium: Any, rays: Rays, dt: Any) -> Any:
    """A plain structure-of-arrays forward march over kept samples: one `while_loop` over the batch, every ray to the longest end."""
    transfer = medium.transfer
    count = jnp.ceil(rays.length / dt).astype(jnp.int32)
    stored, start, stride = medium.field.stored, medium.field.start, medium.field.stride
    (low, high), last = transfer.domain, transfer.rgb.shape[0] - 1

    def body(state: Any):
        k, r, g, b, clear = state
        s = medium.field.low + medium.field.scale * stored.at[start + k * stride].get(mode="clip").astype(jnp.float32)
        extent = jnp.clip(rays.length - k * dt, 0, dt)
        u = jnp.clip((s - low) / (high - low) * last, 0, last)
        i = jnp.clip(jnp.floor(u), 0, last - 1).astype(jnp.int32)
        f = u - i
        read = lambda table: (1 - f) * table[i] + f * table[i + 1]
        alpha = -jnp.expm1(-read(transfer.sigma_t) * extent)
        r, g, b = (c + clear * alpha * read(transfer.rgb[:, j]) for j, c in enumerate((r, g, b)))
        return k + 1, r, g, b, clear * (1 - alpha)

    zero = jnp.zeros_like(rays.length)
    return jax.lax.while_loop(lambda state: state[0] < jnp.max(count), body, (0, zero, zero, zero, zero + 1))[1:]
