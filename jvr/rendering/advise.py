"""What each effect of a scene costs and shows, and what could go: measured, on concrete arrays. It changes no plan."""

import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from jvr.model.camera import AbstractCamera
from jvr.model.parts import AbstractPart, parts_of, spelling, with_part
from jvr.model.scene import Scene
from jvr.rendering.render import render
from jvr.rendering.settings import Settings

Variant = tuple[Scene, Settings]
Change = Callable[[Scene, Settings], Variant]


class Candidate(NamedTuple):
    """A change of a variant: where, what it is called, and what makes it; that raises `ValueError` where it cannot be made. `drops`:
    whether an effect goes, which makes a scene simpler though it may save no time."""

    place: str
    title: str
    change: Change
    drops: bool = False


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
    measured = lambda one: (one, *_difference(one.change, (scene, settings), camera, picture, repeats))
    dropped = [measured(effect) for effect in effects_of(scene)]
    contributions = tuple(Contribution(effect.title, rmse, 1 - without / seconds) for effect, rmse, without in dropped)
    proposal = None
    if tolerance is not None:
        candidates = [(one._replace(title=f"drop {one.title}", drops=True), rmse, without) for one, rmse, without in dropped]
        candidates += [measured(notch) for notch in _coarser(scene, settings)]
        proposal = _proposal(candidates, (scene, settings), camera, picture, seconds, tolerance, repeats)
    remarks = tuple(remarks_on(scene, render(scene, camera, settings).stats))
    return Advice(seconds, contributions, remarks, proposal)


def effects_of(scene: Scene) -> Iterator[Candidate]:
    """Every effect that a scene may do without, and how."""
    for name, part in parts_of(scene):
        if part.without(scene) is not None:
            yield Candidate(name, part.title(name, scene), lambda s, settings, part=part: (_without(s, part), settings))


def _without(scene: Scene, part: AbstractPart) -> Scene:
    found = part.without(scene)
    if found is None:
        raise ValueError("what is left of the scene cannot do without")
    return found


def _coarser(scene: Scene, settings: Settings) -> Iterator[Candidate]:
    """What has a knob, one notch coarser."""
    for name, part in parts_of(scene):
        for new in part.coarser(scene):
            yield Candidate(name, f"{name} = {spelling(new)}", lambda s, x, name=name, new=new: (with_part(s, name, new), x))
    for knob in settings.knobs(scene):
        value = knob.coarser(getattr(settings, knob.name))
        if value is not None:
            said = f"{value:g}" if isinstance(value, float) else spelling(value)
            yield Candidate(
                knob.name, f"{knob.name} = {said}", lambda s, x, name=knob.name, value=value: (s, x.turned(name, value))
            )


def _proposal(
    candidates: list[tuple[Candidate, float, float]],
    variant: Variant,
    camera: AbstractCamera,
    picture: np.ndarray,
    seconds: float,
    tolerance: float,
    repeats: int,
) -> Proposal:
    """Makes the changes that save most first, each only if all so far together stay within the tolerance."""
    made, rmse, places = [], 0.0, set()
    saves = lambda one, without: without < (1 - LEAST_SAVING) * seconds or one.drops
    worth = [(one, without) for one, difference, without in candidates if difference <= tolerance and saves(one, without)]
    for one, _ in sorted(worth, key=lambda c: c[1]):
        # One change in each place; what has been dropped together with another part cannot be changed.
        if one.place in places:
            continue
        try:
            changed = one.change(*variant)
        except ValueError:
            continue
        together, took = _timed(changed[0], camera, changed[1], repeats)
        difference = _rms(together - picture)
        if difference <= tolerance:
            variant, rmse, seconds = changed, difference, took
            made.append(one.title)
            places.add(one.place)
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


def remarks_on(scene: Scene, stats: Any) -> Iterator[str]:
    """What does not show though it is there, and what the `RenderStats` of a picture have to report."""
    for name, part in [*parts_of(scene), ("", scene)]:
        yield from part.remarks(name, scene, stats)
