"""What all knobs of a scene and its settings do together, foretold from small pictures in which few of them are turned.

Knobs of the settings, which say where rays are sampled, are turned together; those of each part of the scene one at a time, at the default
settings. To first order errors of pixels add up: the error of a choice is that of its settings and, for each other knob, the
difference that it makes. What a picture prepares for all of its rays does not grow with the picture, and is timed by itself; the rest
grows with its pixels and with what each knob makes of it.
"""

import dataclasses
import functools
import itertools
import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jvr.model.camera import AbstractCamera
from jvr.model.parts import Knob, parts_of, with_part
from jvr.model.scene import Scene
from jvr.rendering.measure import Measurement, TimedPicture, compared, reference, timed_pictures
from jvr.rendering.medium import prepare
from jvr.rendering.settings import Settings
from jvr.rendering.trace import near_volume, step_length

# Pictures are this much smaller on each side.
SMALLER = 2
REPEATS = 5
# A part of a time that is smaller than this fraction of it is not known any better.
LEAST_FRACTION = 0.02

Variant = tuple[Scene, Settings]
Choice = dict[str, Any]


class Turn(NamedTuple):
    """A knob and where it is: in a part of the scene, or, for an empty name, in the settings."""

    place: str
    knob: Knob

    @property
    def name(self) -> str:
        return f"{self.place}.{self.knob.name}" if self.place else self.knob.name


def turns_of(scene: Scene, settings: Settings, bound: float) -> tuple[Turn, ...]:
    """Every knob there is; one that bounds the error has a single value, the largest that is no larger than `bound`, or its smallest."""

    def bounded(knob: Knob) -> Knob:
        values = [value for value in knob.values if value <= bound] if knob.bounds_error else []
        return knob._replace(values=(values[0] if values else knob.values[-1],)) if knob.bounds_error else knob

    found = [("", knob) for knob in settings.knobs(scene)]
    found += [(name, knob) for name, part in parts_of(scene) for knob in part.knobs(scene)]
    return tuple(Turn(place, bounded(knob)) for place, knob in found)


def turned(variant: Variant, turns: Sequence[Turn], choice: Choice) -> Variant:
    """A scene and settings with other values of their knobs, of those that `choice` names. **Raises** `ValueError` where these do not go
    together."""
    scene, settings = variant
    for turn in (turn for turn in turns if turn.name in choice):
        if turn.place:
            part = dict(parts_of(scene))[turn.place]
            scene = with_part(scene, turn.place, part.turned(turn.knob.name, choice[turn.name]))
        else:
            settings = settings.turned(turn.knob.name, choice[turn.name])
    return scene, settings


def reference_of(variant: Variant, camera: AbstractCamera, turns: Sequence[Turn]) -> tuple[np.ndarray, Any]:
    """The picture that errors are measured against: every knob finer than its values, no sample left out, in double precision."""
    scene, settings = turned(variant, turns, {turn.name: turn.knob.reference for turn in turns})
    return reference(scene, camera, dataclasses.replace(settings, skipping=False))


class Foretold(NamedTuple):
    """What a choice is expected to do to the whole picture; `terms`: the pictures that its error is the sum of."""

    choice: Choice
    rmse: float
    seconds: float
    terms: tuple[int, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Foretelling:
    """All choices, and the small pictures that they are foretold from: `errors`, of each against `truth`, and how they were `measured`."""

    choices: tuple[Foretold, ...]
    errors: Float[np.ndarray, "pictures numbers"]
    truth: np.ndarray
    measured: tuple[Measurement, ...]

    def measurement(self, foretold: Foretold, settings: Settings) -> Measurement:
        """A choice as a `Measurement`, with the number of samples at its settings."""
        rgb = self.truth + self.errors[list(foretold.terms)].sum(axis=0).reshape(self.truth.shape)
        picture = TimedPicture(rgb, self.measured[foretold.terms[0]].samples, None, foretold.seconds, foretold.seconds, 0.0)
        return compared((self.truth, None), settings, picture)


def foretelling(variant: Variant, camera: AbstractCamera, turns: Sequence[Turn]) -> Foretelling:
    """Measures on small pictures, and foretells all choices."""
    small = dataclasses.replace(camera, width=-(-camera.width // SMALLER), height=-(-camera.height // SMALLER))
    pixels = camera.width * camera.height / (small.width * small.height)
    of_settings, of_scene = [t for t in turns if not t.place], [t for t in turns if t.place]
    crossed = _that_go(variant, turns, of_settings)
    # Each of the others alone, at the given settings but for what bounds the error.
    given = turned(variant, turns, {t.name: t.knob.values[0] for t in of_settings if t.knob.bounds_error})
    alone = [{t.name: value} for t in of_scene for value in t.knob.values]
    variants = [turned(variant, turns, c) for c in crossed] + [given] + [turned(given, turns, c) for c in alone]
    pictures = timed_pictures(variants, small, repeats=REPEATS)
    truth = reference_of(variant, small, turns)
    base = len(crossed)
    prepared = _prepared(variants[base:])
    rays = [max(p.least_seconds - f, LEAST_FRACTION * p.least_seconds) for p, f in zip(pictures[base:], prepared, strict=True)]

    errors = np.stack([np.ravel(p.rgb.astype(np.float64) - truth[0]) for p in pictures])
    errors[base:] -= errors[base].copy()
    gram = errors @ errors.T / errors.shape[1]
    at = {(name, i): base + 1 + k for k, (name, i) in enumerate((t.name, i) for t in of_scene for i in range(len(t.knob.values)))}

    def foretold(first: int, chosen: tuple[int, ...]) -> Foretold:
        terms = (first, *(at[t.name, i] for t, i in zip(of_scene, chosen, strict=True)))
        choice = crossed[first] | {t.name: t.knob.values[i] for t, i in zip(of_scene, chosen, strict=True)}
        before: dict[str, float] = {}
        for t, k in zip(of_scene, terms[1:], strict=True):
            before[t.place] = before.get(t.place, 1.0) * prepared[k - base] / prepared[0]
        fixed = prepared[0] * max(1 + sum(ratio - 1 for ratio in before.values()), 0.0)
        own = max(pictures[first].least_seconds - prepared[0], LEAST_FRACTION * pictures[first].least_seconds)
        marched = own * math.prod(rays[k - base] / rays[0] for k in terms[1:])
        return Foretold(choice, math.sqrt(max(gram[np.ix_(terms, terms)].sum(), 0.0)), fixed + pixels * marched, terms)

    ranges = [range(len(t.knob.values)) for t in of_scene]
    choices = tuple(foretold(first, chosen) for first in range(base) for chosen in itertools.product(*ranges))
    scaled = [
        dataclasses.replace(compared(truth, s, p), seconds=p.seconds * pixels)
        for (_, s), p in zip(variants, pictures, strict=True)
    ]
    return Foretelling(choices, errors, truth[0], tuple(scaled))


def _that_go(variant: Variant, turns: Sequence[Turn], crossed: Sequence[Turn]) -> list[Choice]:
    """All choices of some knobs whose values go together."""
    found = []
    for values in itertools.product(*(turn.knob.values for turn in crossed)):
        choice = {turn.name: value for turn, value in zip(crossed, values, strict=True)}
        try:
            turned(variant, turns, choice)
        except ValueError:
            continue
        found.append(choice)
    return found


@functools.partial(jax.jit, static_argnums=1)
def _prepare(scene: Scene, settings: Settings) -> Any:
    (scene,) = near_volume(scene)
    prepared = prepare(scene, settings, step_length(scene, settings))
    return prepared.occupancy, prepared.visibility, prepared.lighting, prepared.search


def _prepared(variants: Sequence[Variant]) -> list[float]:
    """The least seconds that it takes to prepare each for its rays, one after the other in turns."""
    for variant in variants:
        jax.block_until_ready(_prepare(*variant))
    times: list[list[float]] = [[] for _ in variants]
    for _ in range(REPEATS):
        for variant, seconds in zip(variants, times, strict=True):
            began = time.perf_counter()
            jax.block_until_ready(_prepare(*variant))
            seconds.append(time.perf_counter() - began)
    return [min(seconds) for seconds in times]
