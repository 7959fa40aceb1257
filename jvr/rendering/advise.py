"""What each effect of a scene costs and shows, and what could go: measured, on concrete arrays. It changes no plan."""

import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from jvr.march.quadrature import Midpoint
from jvr.model.by_value import ByValue
from jvr.model.camera import AbstractCamera
from jvr.model.effects import spelling
from jvr.model.gradient_transfer import GradientOpacity
from jvr.model.light import AbstractLight, AmbientLight
from jvr.model.normals import AnalyticGradient
from jvr.model.scene import Scene
from jvr.rendering.image import render
from jvr.rendering.settings import Settings

Variant = tuple[Scene, Settings]
Change = Callable[[Scene, Settings], Variant]

# A change that saves less of the time than this is noise.
LEAST_SAVING = 0.05


@dataclasses.dataclass(frozen=True)
class Contribution:
    """One effect: `rmse`, how much the picture changes without it (root mean square over pixels and channels, linear radiance); `share` of
    the time that is saved without it, about 0 for what costs nothing, below 0 where the picture takes longer without."""

    effect: str
    rmse: float
    share: float


@dataclasses.dataclass(frozen=True)
class Proposal:
    """Changes that together keep the picture within the tolerance: `rmse` between the pictures and `seconds` are measured with all of them
    made; `scene`, `settings`: with them made. No `changes` where nothing may go."""

    changes: tuple[str, ...]
    rmse: float
    seconds: float
    scene: Scene
    settings: Settings


@dataclasses.dataclass(frozen=True)
class Advice:
    """What `jvr.advise` found: `seconds` of a picture, a `Contribution` for each effect, `remarks` on what cannot show, and a `Proposal`
    where a tolerance was given. `print` shows it."""

    seconds: float
    contributions: tuple[Contribution, ...]
    remarks: tuple[str, ...]
    proposal: Proposal | None

    def __str__(self) -> str:
        width = max([len(c.effect) for c in self.contributions], default=0)
        lines = [f"a picture takes {1e3 * self.seconds:.0f} ms"]
        lines += [
            f"{c.effect:<{width}}  {c.share:>6.0%} of the time, changes the picture by {c.rmse:.1e}" for c in self.contributions
        ]
        lines += [f"note: {remark}" for remark in self.remarks]
        if self.proposal is not None:
            lines += [f"proposal: {change}" for change in self.proposal.changes] or ["proposal: nothing may go"]
            if self.proposal.changes:
                lines.append(f"together: changes the picture by {self.proposal.rmse:.1e}, {1e3 * self.proposal.seconds:.0f} ms")
        return "\n".join(lines)


def advise(
    scene: Scene, camera: AbstractCamera, settings: Settings = Settings(), *, tolerance: float | None = None, repeats: int = 3
) -> Advice:
    """Renders the scene with and without each of its effects, and says what each contributes to picture and time.

    With a `tolerance` (root mean square difference of linear radiance, `1 / 255` for example) it also tries to drop effects and to coarsen
    what has a knob, keeps what stays within the tolerance and saves time, and measures all of that together. Times are medians of
    `repeats` pictures, compilation apart. Not traceable; each variant is compiled once.

    **Raises** `ValueError` for a tolerance that is not positive.
    """
    if tolerance is not None and not tolerance > 0:
        raise ValueError(
            f"tolerance must be a positive difference of radiance, not {tolerance!r}; 1/255 is one step of an 8-bit picture"
        )
    picture, seconds = _timed(scene, camera, settings, repeats)
    contributions, candidates = [], []
    for effect, change in effects_of(scene):
        rmse, without = _difference(change, (scene, settings), camera, picture, repeats)
        contributions.append(Contribution(effect, rmse, 1 - without / seconds))
        candidates.append((f"drop {effect}", change, rmse, without))
    proposal = None
    if tolerance is not None:
        for name, change in _coarser(scene, settings):
            candidates.append((name, change, *_difference(change, (scene, settings), camera, picture, repeats)))
        proposal = _proposal(candidates, (scene, settings), camera, picture, seconds, tolerance, repeats)
    return Advice(
        seconds, tuple(contributions), tuple(remarks_on(scene, render(scene, camera, settings).stats.shadows)), proposal
    )


def effects_of(scene: Scene) -> Iterator[tuple[str, Change]]:
    """Every effect that a scene may do without, and how."""
    lit = scene.shading is not None or scene.scattering is not None
    if scene.shadows is not None:
        yield f"shadows {spelling(scene.shadows)}", lambda s, settings: (dataclasses.replace(s, shadows=None), settings)
    if scene.shading is not None:
        yield f"shading {spelling(scene.shading)}", lambda s, settings: (_without(s, shading=None), settings)
    if scene.scattering is not None:
        yield f"scattering {spelling(scene.scattering)}", lambda s, settings: (_without(s, scattering=None), settings)
    if isinstance(scene.transfer, GradientOpacity):
        inner = scene.transfer.transfer
        yield "gradient opacity", lambda s, settings: (dataclasses.replace(s, transfer=inner), settings)
    if scene.radiance_transfer is not None:
        yield (
            f"radiance transfer {spelling(scene.radiance_transfer)}",
            lambda s, x: (dataclasses.replace(s, radiance_transfer=None), x),
        )
    if scene.environment is not None:
        none = {"environment": None, "material": None, "radiance_transfer": None}
        yield f"environment and material {spelling(scene.material)}", lambda s, x: (dataclasses.replace(s, **none), x)
    for i, light in enumerate(scene.lights if lit and len(scene.lights) > 1 else ()):
        keep = lambda s, settings, light=light: (_without(s, lights=tuple(x for x in s.lights if x is not light)), settings)
        yield f"lights[{i}] {type(light).__name__}", keep


def _without(scene: Scene, **parts: Any) -> Scene:
    """The scene with some parts replaced; shadows go with the last light that casts them and the last effect that shows them."""
    light, shading, scattering = (parts.get(name, getattr(scene, name)) for name in ("lights", "shading", "scattering"))
    casts = any(isinstance(x, AbstractLight) and x.casts_shadows for x in light)
    if not casts or (shading is None and scattering is None):
        parts["shadows"] = None
    return dataclasses.replace(scene, **parts)


def _coarser(scene: Scene, settings: Settings) -> Iterator[tuple[str, Change]]:
    """What has a knob, one notch coarser."""
    if scene.shadows is not None:
        for coarser in scene.shadows.coarser():
            yield f"shadows = {spelling(coarser)}", lambda s, x, new=coarser: (dataclasses.replace(s, shadows=new), x)
    if scene.radiance_transfer is not None:
        for coarser in scene.radiance_transfer.coarser():
            yield (
                f"radiance transfer = {spelling(coarser)}",
                lambda s, x, new=coarser: (dataclasses.replace(s, radiance_transfer=new), x),
            )
    if type(scene.normals) is not AnalyticGradient:
        analytic = AnalyticGradient(scene.normals.of_opacity)
        yield f"normals = {spelling(analytic)}", lambda s, x: (dataclasses.replace(s, normals=analytic), x)
    if isinstance(settings.quadrature, Midpoint):
        yield f"step = {2 * settings.step:g}", lambda s, x: (s, dataclasses.replace(x, step=2 * x.step))
    if settings.termination < 1e-2:
        yield "termination = 0.01", lambda s, x: (s, dataclasses.replace(x, termination=1e-2))


def _proposal(
    candidates: list[tuple[str, Change, float, float]],
    variant: Variant,
    camera: AbstractCamera,
    picture: np.ndarray,
    seconds: float,
    tolerance: float,
    repeats: int,
) -> Proposal:
    """Makes the changes that save most first, each only if all so far together stay within the tolerance."""
    made, rmse = [], 0.0
    worth = [c for c in candidates if c[2] <= tolerance and (c[3] < (1 - LEAST_SAVING) * seconds or c[0].startswith("drop"))]
    knobs = set()
    for name, change, _, _ in sorted(worth, key=lambda c: c[3]):
        # One value for each knob, and none for what has been dropped.
        knob = name.removeprefix("drop ").split(" ")[0]
        if knob in knobs:
            continue
        try:
            changed = change(*variant)
        except ValueError:
            continue
        together, took = _timed(changed[0], camera, changed[1], repeats)
        difference = _rms(together - picture)
        if difference <= tolerance:
            variant, rmse, seconds = changed, difference, took
            made.append(name)
            knobs.add(knob)
    return Proposal(tuple(made), rmse, seconds, *variant)


def _difference(
    change: Change, variant: Variant, camera: AbstractCamera, picture: np.ndarray, repeats: int
) -> tuple[float, float]:
    scene, settings = change(*variant)
    without, seconds = _timed(scene, camera, settings, repeats)
    return _rms(without - picture), seconds


def _timed(scene: Scene, camera: AbstractCamera, settings: Settings, repeats: int) -> tuple[np.ndarray, float]:
    """A picture and the median of the seconds that it takes."""
    image = jax.block_until_ready(render(scene, camera, settings).rgb)
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(render(scene, camera, settings).rgb)
        times.append(time.perf_counter() - began)
    return np.asarray(image, np.float64), statistics.median(times)


def _rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(difference))))


def remarks_on(scene: Scene, shadow_stats: Any) -> Iterator[str]:
    """What a present value cannot show, and what shadows have to report."""
    for i, light in enumerate(scene.lights):
        strength = next(getattr(light, name) for name in ("irradiance", "intensity", "radiance") if hasattr(light, name))
        if not np.any(np.asarray(strength)):
            yield f"lights[{i}] {type(light).__name__} has no strength: it is computed and adds nothing"
        elif scene.shading is None and scene.scattering is None:
            yield f"lights[{i}] {type(light).__name__} is not seen: nothing reflects or scatters it"
        if scene.scattering is None and isinstance(light, AmbientLight) and _is_zero(getattr(scene.shading, "ambient", None)):
            yield f"lights[{i}] AmbientLight is not seen: shading.ambient is zero"
    if not scene.lights and (scene.shading is not None or scene.scattering is not None):
        yield "there is no light: shading shows black, and nothing is scattered"
    if scene.scattering is not None and _is_zero(getattr(scene.scattering, "albedo", None)):
        yield "scattering.albedo is zero everywhere: nothing is scattered"
    if scene.shading is not None and all(_is_zero(getattr(scene.shading, k, 0.0)) for k in ("diffuse", "specular")):
        yield "shading.diffuse and shading.specular are zero: nothing but ambient light is reflected"
    if scene.environment is not None and not np.any(np.asarray(scene.environment.coefficients)):
        yield "environment has no strength: it is computed and adds nothing"
    if scene.radiance_transfer is not None:
        yield from scene.radiance_transfer.stale(scene)
    if shadow_stats is not None and float(shadow_stats.overflow) > 0:
        share, error = float(shadow_stats.overflow), float(shadow_stats.error)
        yield f"{share:.0%} of the rays of a deep shadow map ran out of layers (error {error:.2g}): give it more"


def _is_zero(value: Any) -> bool:
    array = value.values if isinstance(value, ByValue) else value
    return array is not None and not np.any(np.asarray(array))
