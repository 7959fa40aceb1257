"""Presets of other programs: what jvr makes of one, what of jvr they take, and what either of them cannot hold.

A `VolumeProperty` is what VTK's class of that name says, and what files of ParaView and 3D Slicer say in their own ways. A `Preset` is the
same in parts of a `jvr.Scene`.
"""

import dataclasses
import warnings
from typing import Any

import jax
import numpy as np

from jvr.io.interop.curves import Curve
from jvr.io.interop.opacity import MOST_OPAQUE, extinction_from_opacity
from jvr.io.interop.points import COLLINEAR, Samples, light_of, needed, refined, shown, single, width
from jvr.io.kinds import kind_of, maker_of
from jvr.model.effects import AbstractShading
from jvr.model.gradient_transfer import GradientOpacity
from jvr.model.interpolation import AbstractInterpolation, Nearest, Trilinear
from jvr.model.light import AbstractLight, AmbientLight, HeadLight
from jvr.model.normals import AbstractNormals, CentralDifferences
from jvr.model.parameters import AbstractByScalar
from jvr.model.transfer import AbstractTable, AbstractTransfer, GaussianTransfer, LinearTransfer

DEEPEST = float(extinction_from_opacity(MOST_OPAQUE))
ENCODINGS = ("linear", "srgb")
# More points than that are no preset that somebody made.
MOST_POINTS = 4096


@dataclasses.dataclass(frozen=True)
class VolumeProperty:
    """How a volume looks, as VTK says it.

    - `opacity`, `colour`: of the scalar, opacity over `unit_distance` (world length), colours as they are shown.
    - `gradient`: factor of the opacity by the length of the gradient, in data units per mean distance of voxels, `None` for 1.
    - `shade`, `ambient`, `diffuse`, `specular`, `power`: of Phong's model under a light at the eye.
    - `interpolation`: "nearest", "linear" or "cubic".
    - `lost`: what is not in this description, by name.
    """

    opacity: Curve
    colour: Curve
    gradient: Curve | None = None
    unit_distance: float | int = 1.0
    shade: bool = False
    ambient: float | int = 0.1
    diffuse: float | int = 0.7
    specular: float | int = 0.2
    power: float | int = 10.0
    interpolation: str = "linear"
    lost: dict[str, str] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Preset:
    """A transfer function and what belongs to it.

    - `transfer`; `shading`, `None` where colours are shown as they are; `lights`: those that the shading is meant for, a light at the eye
      and one from all around; `normals`: as VTK takes them; `interpolation`: of the volume.
    - `unit_distance`: the world length that the other program's opacities belong to; `encoding`: whether its colours are "linear" light, or
      "srgb" codes that became light; `spacing`: the mean distance of the voxels, which its lengths of gradients belong to.
    - `lost`: what jvr does not hold of it, what of it by name.
    """

    transfer: AbstractTransfer
    shading: AbstractShading | None = None
    interpolation: AbstractInterpolation = dataclasses.field(default_factory=Trilinear)
    unit_distance: float | int = 1.0
    encoding: str = "linear"
    spacing: float | int = 1.0
    lost: dict[str, str] = dataclasses.field(default_factory=dict)

    @property
    def lights(self) -> tuple[AbstractLight, ...]:
        return () if self.shading is None else (HeadLight(), AmbientLight())

    @property
    def normals(self) -> AbstractNormals:
        return CentralDifferences()


def warn_of(lost: dict[str, str], what: str) -> None:
    """One line that says what is lost, where something is."""
    if lost:
        listed = "; ".join(f"{name} ({detail})" for name, detail in lost.items())
        warnings.warn(f"{what}: not kept: {listed}", stacklevel=3)


def preset_of(said: VolumeProperty, spacing: float | int = 1.0, encoding: str = "linear") -> Preset:
    """The preset that jvr makes of a description.

    **Raises** `ValueError` for opacities beyond 0 ... 1, negative colours, more than 4,096 points, and positions beyond single precision.
    """
    _check(said, spacing, encoding)
    lost = dict(said.lost)
    opacity, colour = (dataclasses.replace(curve, x=single(curve.x)) for curve in (said.opacity, said.colour))

    def function(x: np.ndarray) -> Samples:
        depth = extinction_from_opacity(np.clip(opacity(x)[:, 0], 0, 1))
        return Samples(depth, np.broadcast_to(light_of(colour(x), encoding), (len(x), 3)))

    least = width(np.concatenate([opacity.x, colour.x]))
    x, (depth, light) = refined(np.concatenate([opacity.points(least), colour.points(least)]), function, encoding)
    chosen = needed(x, np.column_stack([depth, light]), COLLINEAR / 100)
    transfer = LinearTransfer(x[chosen], light[chosen], depth[chosen] / said.unit_distance)
    if np.any(opacity.values >= 1):
        length = f"{said.unit_distance:g} of length"
        lost["opacity of 1"] = f"it hides all within no distance: taken as 1 - 2^-16 over {length}"
    for name, curve in (("opacity", opacity), ("colours", colour)):
        if not curve.is_plain:
            lost[f"way between points of {name}"] = "midpoint, sharpness, space or ends: met by more points, to 1/512"
    scaled = transfer if said.gradient is None else _with_gradient(transfer, said.gradient, spacing, lost)
    shading = _shading(said, lost)
    if said.interpolation == "cubic":
        lost["cubic interpolation"] = "taken as trilinear"
    interpolation = Nearest() if said.interpolation == "nearest" else Trilinear()
    return Preset(scaled, shading, interpolation, said.unit_distance, encoding, spacing, lost)


def _check(said: VolumeProperty, spacing: float | int, encoding: str) -> None:
    if encoding not in ENCODINGS:
        raise ValueError(f"encoding must be one of {', '.join(map(repr, ENCODINGS))}, not {encoding!r}")
    if not 0 < spacing < np.inf:
        raise ValueError(f"spacing must be positive and finite (world length), not {spacing:g}")
    if max(len(said.opacity.x), len(said.colour.x)) > MOST_POINTS:
        raise ValueError(f"more than {MOST_POINTS:,} points in a function: resample it")
    outside = (curve for curve in (said.opacity.below, said.opacity.above) if curve is not None)
    if not all(np.all((values >= 0) & (values <= 1)) for values in (said.opacity.values, *outside)):
        raise ValueError("opacity must be between 0 and 1")
    if not np.all((said.colour.values >= 0) & (said.colour.values <= 1)):
        raise ValueError("colours must be between 0 and 1")
    if not 0 < said.unit_distance < np.inf:
        raise ValueError(f"unit_distance must be positive and finite (world length), not {said.unit_distance:g}")


def _shading(said: VolumeProperty, lost: dict[str, str]) -> AbstractShading | None:
    if not said.shade:
        return None
    if said.power < 1 and said.specular > 0:
        lost["specular power below 1"] = f"{said.power:g} is taken as 1"
    return maker_of(AbstractShading, "phong")(said.ambient, said.diffuse, said.specular, max(said.power, 1.0))


def _with_gradient(transfer: LinearTransfer, gradient: Curve, spacing: float | int, lost: dict[str, str]) -> AbstractTransfer:
    """The transfer function with an opacity by gradient that is 1 everywhere, or one ramp from 0 to 1."""
    x = np.unique(np.maximum(np.append(gradient.points(width(gradient.x)), 0), 0))
    bends = needed(x, gradient(x))
    x, factor = x[bends], gradient(x[bends])[:, 0]
    if np.all(factor >= 1 - COLLINEAR):
        return transfer
    bends = np.flatnonzero(np.abs(np.diff(factor)) > COLLINEAR)
    is_ramp = len(bends) == 1 and factor[bends[0]] <= COLLINEAR and factor[bends[0] + 1] >= 1 - COLLINEAR
    if not (gradient.is_plain and is_ramp):
        lost["opacity by gradient"] = f"{len(gradient.x)} points are not one ramp from 0 to 1: left out"
        return transfer
    low, high = x[bends[0] : bends[0] + 2] / spacing
    return GradientOpacity(transfer, low, high)


def property_of(preset: Preset) -> VolumeProperty:
    """The description of a preset; what another program cannot hold is in its `lost`.

    **Raises** `ValueError` for transfer functions that are neither tables nor Gaussians of the scalar, and no `jvr.GradientOpacity` of one.
    """
    lost: dict[str, str] = {}
    transfer, gradient = preset.transfer, None
    if isinstance(transfer, GradientOpacity):
        low, high = float(transfer.low) * preset.spacing, float(transfer.high) * preset.spacing
        gradient, transfer = Curve.of(np.array([[low, 0], [high, 1]]), shaped=False), transfer.transfer
    if transfer.takes_gradient:
        raise ValueError(f"a {type(transfer).__name__} has no form in other programs: give one of the scalar alone")
    positions = _positions(transfer)
    sampled = _sampled(transfer, preset, lost)
    x, (depth, light) = refined(positions, sampled, preset.encoding)
    alpha = np.where(depth >= DEEPEST * (1 - COLLINEAR), 1, -np.expm1(-depth))
    opacity, colour = (_through(x, values) for values in (alpha[:, None], shown(light, preset.encoding)))
    interpolation = "nearest" if isinstance(preset.interpolation, Nearest) else "linear"
    return VolumeProperty(
        opacity,
        colour,
        gradient,
        preset.unit_distance,
        **_coefficients(preset.shading, lost),
        interpolation=interpolation,
        lost=lost,
    )


def _through(x: np.ndarray, values: np.ndarray) -> Curve:
    bends = needed(x, values)
    return Curve.of(np.column_stack([x[bends], values[bends]]), shaped=False)


def _positions(transfer: AbstractTransfer) -> np.ndarray:
    if isinstance(transfer, AbstractTable):
        return np.asarray(transfer.positions, np.float64)  # pyright: ignore[reportAttributeAccessIssue]
    if not isinstance(transfer, GaussianTransfer):
        raise ValueError(f"a {type(transfer).__name__} has no form in other programs: give a table or Gaussians")
    center, width = (np.asarray(getattr(transfer, name), np.float64) for name in ("center", "width"))
    # Six widths away a Gaussian is 1.5e-8 of its height.
    return np.unique(np.concatenate([center + k * width for k in range(-6, 7)]))


def _sampled(transfer: AbstractTransfer, preset: Preset, lost: dict[str, str]) -> Any:
    """The transfer function in double precision, with grey extinction that another program can hold."""
    evaluate = jax.jit(jax.vmap(transfer.evaluate))

    def rows(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if isinstance(transfer, AbstractTable):
            at, rgb, sigma = (np.asarray(getattr(transfer, name), np.float64) for name in ("positions", "rgb", "sigma_t"))
            columns = np.column_stack([rgb, sigma])
            found = np.stack([np.interp(x, at, column) for column in columns.T], axis=1)
            return found[:, :3], found[:, 3:]
        rgb, sigma, _ = evaluate(x)
        return np.stack(rgb, axis=1).astype(np.float64), np.stack(sigma, axis=1).astype(np.float64)

    rgb, sigma = rows(_positions(transfer))
    if sigma.shape[1] == 3:
        lost["coloured extinction"] = "taken as its mean"
    if np.any(sigma.mean(axis=1) * preset.unit_distance > DEEPEST * (1 + COLLINEAR)):
        lost["extinction"] = f"what is above {DEEPEST / preset.unit_distance:.4g} is opaque: give a smaller unit_distance"
    if np.any(rgb > 1):
        lost["colours"] = "what is brighter than 1 is cut"
    if getattr(transfer, "emission", None) is not None:
        lost["emission of its own"] = "media glow by their extinction alone there"

    def function(x: np.ndarray) -> Samples:
        rgb, sigma = rows(x)
        return Samples(np.minimum(sigma.mean(axis=1) * preset.unit_distance, DEEPEST), np.minimum(rgb, 1))

    return function


def _coefficients(shading: Any, lost: dict[str, str]) -> dict[str, Any]:
    """Keywords of a `VolumeProperty`."""
    if shading is None:
        return {"shade": False}
    kind = kind_of(shading)
    if kind not in ("lambert", "phong", "blinn-phong"):
        lost["shading"] = f"{type(shading).__name__} has no form in other programs"
        return {"shade": False}
    names = {"ambient": "ambient", "diffuse": "diffuse", "specular": "specular", "shininess": "power"}
    found: dict[str, Any] = {"shade": True, "specular": 0.0}
    for ours, theirs in names.items():
        value = getattr(shading, ours, None)
        if isinstance(value, AbstractByScalar):
            lost[f"{ours} by {'gradient' if value.needs_gradient else 'value'}"] = "taken at its mean"
            value = np.mean(np.asarray(value.values))
        found |= {} if value is None else {theirs: float(value)}
    if kind == "blinn-phong":
        lost["half-way highlights"] = "VTK's mapper on the graphics card has Phong's mirrored ones"
    if float(shading.threshold) > 0:
        lost["threshold of surfaces"] = "all gradients are surfaces there"
    if not shading.two_sided:
        lost["one-sided surfaces"] = "both sides are lit there"
    return found
