"""HTML of volumes and transfer functions for notebooks: a few small pictures and a line of words."""

import base64
from html import escape
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jvr.pictures import shown

if TYPE_CHECKING:
    from jvr.model.transfer import AbstractTransfer
    from jvr.model.volume import Volume

# Columns and rows of a transfer function's picture.
COLUMNS, ROWS = 320, 64


def volume_html(volume: "Volume") -> str:
    """The middle slices across z, y and x, dark to bright from the 1st to the 99th percentile, each with its true proportions."""
    values, spacing = np.asarray(volume.values), np.asarray(volume.spacing, np.float64)
    middle = [n // 2 for n in values.shape]
    slices = [(values[:, :, middle[2]], 0, 1), (values[:, middle[1]], 0, 2), (values[middle[0]], 1, 2)]
    scaled = [float(volume.slope) * part.astype(np.float64) + float(volume.intercept) for part, _, _ in slices]
    finite = np.concatenate([part[np.isfinite(part)] for part in scaled])
    low, high = np.percentile(finite, [1, 99]) if finite.size else (0.0, 1.0)
    tags = []
    for part, (_, across, down) in zip(scaled, slices, strict=True):
        # Rows go down the page, and the second axis up in the world.
        grey = np.clip((part.T[::-1] - low) / max(high - low, 1e-30), 0, 1) ** 2.2
        aspect = (values.shape[across] * spacing[across]) / (values.shape[down] * spacing[down])
        tags.append(_image(np.stack([grey] * 3, -1), round(160 * aspect), 160))
    numbers = lambda array: " x ".join(f"{x:g}" for x in array)
    words = f"Volume: {numbers(values.shape)} voxels, {values.dtype}, {numbers(spacing)} apart; most values {low:g} ... {high:g}"
    return f"<div>{' '.join(tags)}<br>{escape(words)}</div>"


def transfer_html(transfer: "AbstractTransfer") -> str:
    """Colour below the curve of extinction over the scalar; where the length of the gradient counts, colour by extinction over both."""
    (low, high), steep = _span(transfer), _steepest(transfer)
    s, rows = np.linspace(low, high, COLUMNS), np.linspace(1, 0, ROWS)
    if transfer.takes_gradient:
        at = np.meshgrid(s, steep * rows)
        rgb, sigma_t = _evaluated(transfer, *at)
        cover = sigma_t / max(sigma_t.max(), 1e-30)
        words = f"length of the gradient up to {steep:g}, upwards"
    else:
        rgb, sigma_t = _evaluated(transfer, s[None], None)
        cover = (rows[:, None] <= sigma_t / max(sigma_t.max(), 1e-30)) & (sigma_t > 0)
        words = "extinction upwards"
    picture = np.where(cover[..., None], cover[..., None] * rgb + (1 - cover[..., None]), 1.0)
    words = (
        f"{type(transfer).__name__}: values {low:g} ... {high:g}, {words}; extinction up to {sigma_t.max():g} per world length"
    )
    return f"<div>{_image(picture, 2 * COLUMNS, 2 * ROWS)}<br>{escape(words)}</div>"


def _image(picture: np.ndarray, width: int, height: int) -> str:
    data = base64.b64encode(shown(np.clip(picture, 0, 1))).decode("ascii")
    return f'<img width="{max(width, 1)}" height="{height}" src="data:image/png;base64,{data}">'


def _evaluated(transfer: "AbstractTransfer", s: np.ndarray, magnitude: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Colours and the mean extinction at scalars of any shape."""
    real = lambda x: jnp.asarray(x.ravel(), jnp.result_type(float))
    points = (real(s),) if magnitude is None else (real(s), real(magnitude))
    found = jax.vmap(transfer.evaluate)(*points)
    column = lambda x: np.broadcast_to(np.asarray(x, np.float64), s.size).reshape(s.shape)
    return np.stack([column(x) for x in found.rgb], -1), np.mean([column(x) for x in found.sigma_t], axis=0)


def _span(transfer: Any) -> tuple[float, float]:
    """The scalars between which there is something to show."""
    if hasattr(transfer, "transfer"):
        return _span(transfer.transfer)
    if hasattr(transfer, "center"):
        center, width = np.asarray(transfer.center), np.asarray(transfer.width)
        return float(np.min(center - 3.5 * width)), float(np.max(center + 3.5 * width))
    ends = transfer.domain if hasattr(transfer, "domain") else transfer.positions
    return float(ends[0]), float(ends[-1])


def _steepest(transfer: Any) -> float:
    """The largest length of the gradient that makes a difference."""
    return float(transfer.magnitudes[1]) if hasattr(transfer, "magnitudes") else float(getattr(transfer, "high", 1.0))
