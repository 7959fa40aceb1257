"""Tuning: the cheapest choices that a scene needs for a wanted accuracy, or the most accurate ones for a wanted time.

Every knob that settings and parts of the scene declare is turned. `jvr.rendering.foretelling` measures on small pictures what each
does, and foretells what all of them do together. The most promising choices are drawn whole, beside a reference that is finer in
every knob, and the best that does what was asked for is taken.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.rendering.foretelling import Choice, Foretold, foretelling, reference_of, turned, turns_of
from jvr.rendering.measure import Measurement, compared, timed_pictures
from jvr.rendering.settings import Settings

# What bounds the error may change no pixel by more than this fraction of the error that is asked for, times the brightest radiance; and
# by how much where a time is asked for.
BOUND_FRACTION, BOUND = 0.1, 1e-3
# Choices that are drawn whole at a time, and how often before the safest one is.
TOGETHER, MOST_ROUNDS = 3, 2
# One of them is foretold to miss the mark by no more than this factor: what was foretold may be wrong by as much.
SLACK = 1.25
REPEATS = 5


@dataclasses.dataclass(frozen=True)
class Tuned:
    """What `jvr.tune` found.

    `scene`, `settings`: those chosen; `turned`: what was chosen for each knob, by its place, such as `step` or `shadows.resolution`;
    `predicted`: error and seconds as smaller pictures foretold them; `measured`: of the whole picture; `met`: whether what was asked for
    holds in the measurement; `candidates`: what was measured on the smaller picture, in seconds of the whole one.
    """

    scene: Scene
    settings: Settings
    turned: Choice
    predicted: Measurement
    measured: Measurement
    met: bool
    candidates: tuple[Measurement, ...]


def tune(scene: Scene, camera: AbstractCamera, *, error: float | None = None, seconds: float | None = None) -> Tuned:
    """Turns every knob of a scene and of its settings: measured on a picture with a quarter of the pixels, and checked on the whole one.

    **Arguments:** either `error`, a root mean square error in linear radiance: the fastest choice that meets it; or `seconds` for one
    picture: the most accurate choice that meets it. Where none of those that are drawn whole does, the most accurate (the fastest) of
    them is taken, with the safest one of all among them. Errors are those beside a picture in double precision that is finer in every
    knob. Not traceable; a program is compiled for each value of a knob but the step. **Raises** `ValueError` unless exactly one of the
    two is given and positive.
    """
    if (error is None) == (seconds is None) or not (error or seconds or 0) > 0:
        raise ValueError("tune needs either an error (linear radiance) or a time (seconds), a positive number")
    given = (scene, Settings())
    turns = turns_of(*given, BOUND if error is None else BOUND_FRACTION * error)
    foretold = foretelling(given, camera, turns)
    truth = reference_of(given, camera, turns)
    limited, free = (lambda x: x.rmse), (lambda x: x.seconds)
    if error is None:
        limited, free = free, limited
    limit = error or seconds or 0.0
    tried: list[tuple[Foretold, Measurement]] = []
    met: list[tuple[Foretold, Measurement]] = []
    for last in range(MOST_ROUNDS + 1):
        if last == MOST_ROUNDS:
            chosen = [min(foretold.choices, key=limited)]
        else:
            # What whole pictures said of those before corrects what is foretold of the others; a small one without any error says nothing.
            wrong = max([limited(m) / limited(f) for f, m in tried if limited(f) > 0], default=1.0)
            rest = [f for f in foretold.choices if f not in [f for f, _ in tried]]
            chosen = _promising(rest, limited, free, limit / wrong)
        variants = [turned(given, turns, one.choice) for one in chosen]
        drawn = timed_pictures(variants, camera, repeats=REPEATS)
        tried += [(f, compared(truth, settings, x)) for f, (_, settings), x in zip(chosen, variants, drawn, strict=True)]
        met = [one for one in tried if limited(one[1]) <= limit]
        if met:
            break
    best, measured = min(met, key=lambda t: free(t[1])) if met else min(tried, key=lambda t: limited(t[1]))
    chosen = turned(given, turns, best.choice)
    return Tuned(*chosen, best.choice, foretold.measurement(best, chosen[1]), measured, bool(met), foretold.measured)


def _promising(
    choices: Sequence[Foretold], limited: Callable[[Any], float], free: Callable[[Any], float], limit: float
) -> list[Foretold]:
    """The best that are foretold to meet a limit, and the best of those that might."""
    order = sorted(choices, key=free)
    meet = [one for one in order if limited(one) <= limit][: TOGETHER - 1]
    may = [one for one in order if limited(one) <= SLACK * limit and one not in meet][: TOGETHER - len(meet)]
    return meet + may
