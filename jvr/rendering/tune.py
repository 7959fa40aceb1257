"""Tuning: the cheapest settings that a scene needs for a wanted accuracy, or the most accurate ones for a wanted time."""

import dataclasses
from typing import Any

from jvr.march.quadrature import Midpoint, PreIntegrated
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.model.transfer import LinearTransfer, LutTransfer
from jvr.rendering.measure import FINER, Measurement, measure
from jvr.rendering.settings import Settings

STEPS = (4.0, 2.0, 1.0, 0.5, 0.25)
# Rays that end here can change no pixel by more than a tenth of the error that is asked for, times the brightest radiance.
TERMINATION_FRACTION = 0.1
# Pictures for the prediction are this much smaller on each side.
SMALLER = 2
# Choices that are measured on the whole picture before the safest one is.
MOST_TRIES = 3


@dataclasses.dataclass(frozen=True)
class Tuned:
    """What `jvr.tune` found. `settings`: those chosen; `predicted`: error and seconds as a smaller picture foretold them; `measured`: of
    the whole picture; `met`: whether what was asked for holds in the measurement; `candidates`: what was measured on the smaller
    picture."""

    settings: Settings
    predicted: Measurement
    measured: Measurement
    met: bool
    candidates: tuple[Measurement, ...]


def tune(scene: Scene, camera: AbstractCamera, *, error: float | None = None, seconds: float | None = None) -> Tuned:
    """Measures steps and quadratures on a picture with a quarter of the pixels, and the choice on the whole one.

    **Arguments:** either `error`, a root mean square error in linear radiance: the fastest settings that meet it; or `seconds` for one
    picture: the most accurate settings that meet it. A choice that misses the mark on the whole picture gives way to the next, at
    last to the most accurate (the fastest) of all. **Raises** `ValueError` unless exactly one of the two is given and positive.
    """
    if (error is None) == (seconds is None) or not (error or seconds or 0) > 0:
        raise ValueError("tune needs either an error (linear radiance) or a time (seconds), a positive number")
    small = dataclasses.replace(camera, width=-(-camera.width // SMALLER), height=-(-camera.height // SMALLER))
    pixels = camera.width * camera.height / (small.width * small.height)
    found = tuple(
        dataclasses.replace(m, seconds=m.seconds * pixels) for m in measure(scene, small, _candidates(scene, error), repeats=3)
    )
    asked = (lambda m: m.rmse <= error) if error is not None else (lambda m: m.seconds <= seconds)
    *tries, safest = _order(found, asked, error)
    for predicted in tries:
        measured = _whole(scene, camera, predicted)
        if asked(measured):
            return Tuned(predicted.settings, predicted, measured, True, found)
    measured = _whole(scene, camera, safest)
    return Tuned(safest.settings, safest, measured, asked(measured), found)


def _whole(scene: Scene, camera: AbstractCamera, predicted: Measurement) -> Measurement:
    (measured,) = measure(scene, camera, [predicted.settings], reference_step=min(STEPS) / FINER, repeats=3)
    return measured


def _candidates(scene: Scene, error: float | None) -> list[Settings]:
    termination = 1e-3 if error is None else min(TERMINATION_FRACTION * error, 0.1)
    integrable = isinstance(scene.transfer, LinearTransfer | LutTransfer)
    quadratures: list[Any] = [Midpoint(), PreIntegrated()] if integrable else [Midpoint()]
    return [Settings(step, termination=termination, quadrature=q) for q in quadratures for step in STEPS]


def _order(found: tuple[Measurement, ...], asked: Any, error: float | None) -> list[Measurement]:
    """What to try: those that are predicted to do, the best in the other respect first, and the one that does or misses most nearly."""
    other, wanted = lambda m: m.seconds, lambda m: m.rmse
    if error is None:
        other, wanted = wanted, other
    return [*sorted(filter(asked, found), key=other)[:MOST_TRIES], min(found, key=wanted)]
