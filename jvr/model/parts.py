"""Parts: what a scene is made of and what settings choose, as `jvr.plan`, `jvr.advise` and `jvr.tune` see them.

These three loop over parts and know none by name: each part says for itself what it is in the compiled program for, what of it cannot
show, what a scene is without it, and which of its static choices trade accuracy for time.
"""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from jvr.model.by_value import is_by_gradient
from jvr.model.parameters import AbstractByScalar


class PlanEntry(NamedTuple):
    """One part of the compiled program: its name, whether it is in, why or why not, and what it needs of the others."""

    name: str
    included: bool
    reason: str
    needs: tuple[str, ...] = ()


class Knob(NamedTuple):
    """A static choice that trades accuracy for time.

    `name`: of the field that it sets; `values`: to try, the coarsest first; `reference`: at least as fine as all of them, for the picture
    that errors are measured against; `bounds_error`: a value bounds the error, in units of the brightest radiance, so that it need not
    be searched for.
    """

    name: str
    values: tuple[Any, ...]
    reference: Any
    bounds_error: bool = False

    def coarser(self, value: Any) -> Any:
        """The next coarser value, or `None` where there is none; of a number that is none of them, too. Of `None`, by which a part chooses
        for itself, that of the finest."""
        value = self.values[-1] if value is None else value
        if value in self.values:
            before = self.values[: self.values.index(value)]
        else:
            falls = self.values[0] > self.values[-1]
            before = [other for other in self.values if (other > value if falls else other < value)]
        return before[-1] if before else None


class AbstractPart(eqx.Module):
    """A part of a scene or of settings. Whatever it does not say otherwise: it is in the program where it is in the scene, shows no light,
    asks for no gradient, is in the way of no light, is worth no remark, cannot be left out and has no knobs."""

    @property
    def needs_gradient(self) -> bool:
        """Whether it asks for the gradient at each sample of a ray."""
        return False

    @property
    def shows_lights(self) -> bool:
        """Whether it makes the lights of a scene visible."""
        return False

    @property
    def shows_environment(self) -> bool:
        """Whether it makes the environment's light visible."""
        return False

    @property
    def ends_rays(self) -> bool:
        """Whether what rays see behind the medium, or where they end, differs from ray to ray because of it."""
        return False

    def title(self, name: str, scene: Any) -> str:
        """What `jvr.advise` calls it; `name`: of the field that holds it."""
        return f"{name} {spelling(self)}"

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        """What `jvr.plan` says of it, decided from the structure of scene and settings alone."""
        return (PlanEntry(name, True, spelling(self)),)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        """What of it does not show, and what a picture's `jvr.RenderStats` (or `None`) have to report of it; of concrete arrays."""
        yield from ()

    def visibility(self, scene: Any, path: Any) -> Any:
        """A `jvr.march.medium.AbstractVisibility` of the light that it is in the way of, made once for all rays of a picture, or `None`;
        differentiable. `path`: a `jvr.march.medium.LightPath` through the scene that holds it."""
        return None

    def without(self, scene: Any) -> Any:
        """The scene without it, or `None` where a scene cannot do without."""
        return None

    def knobs(self, scene: Any) -> tuple[Knob, ...]:
        """What may be turned, in a scene that holds it."""
        return ()

    def turned(self, knob: str, value: Any) -> Any:
        """The same with another value of a knob. **Raises** `ValueError` where it does not go with the other choices."""
        return dataclasses.replace(self, **{knob: value})

    def coarser(self, scene: Any) -> tuple["AbstractPart", ...]:
        """Cheaper ways to about the same, each one notch coarser."""
        notches = ((knob.name, knob.coarser(getattr(self, knob.name))) for knob in self.knobs(scene))
        return tuple(self.turned(name, value) for name, value in notches if value is not None)


def parts_of(whole: Any) -> Iterator[tuple[str, AbstractPart]]:
    """Every part that a scene or settings hold, with the name of its field, such as `radiance transfer` or `lights[0]`."""
    for field in dataclasses.fields(whole):
        held, name = getattr(whole, field.name), field.name.replace("_", " ")
        several = enumerate(held) if isinstance(held, tuple) else ()
        named = [(f"{name}[{i}]", part) for i, part in several] or [(name, held)]
        yield from ((own, part) for own, part in named if isinstance(part, AbstractPart))


def asks_gradient(part: AbstractPart) -> bool:
    """Whether a part, or a coefficient in it, asks for the gradient at each sample of a ray."""
    return part.needs_gradient or is_by_gradient(part)


def with_part(whole: Any, name: str, part: AbstractPart) -> Any:
    """A scene or settings with another part in the place of that name. **Raises** `ValueError` where there is none to replace."""
    if name not in dict(parts_of(whole)):
        raise ValueError(f"there is no {name} to replace")
    field, _, index = name.removesuffix("]").replace(" ", "_").partition("[")
    if index:
        held = getattr(whole, field)
        return dataclasses.replace(whole, **{field: (*held[: int(index)], part, *held[int(index) + 1 :])})
    return dataclasses.replace(whole, **{field: part})


def multiples(
    name: str,
    value: float | int,
    factors: tuple[float | int, ...],
    reference: float | int,
    *,
    least: float | int = 0.0,
    most: float | int = math.inf,
) -> Knob:
    """The knob of a number: its multiples by `factors`, those of the coarsest first, and by `reference`, as far as they are in range;
    integers stay integers."""
    kind = round if isinstance(value, int) else float
    scaled = [kind(max(min(value * factor, most), least)) for factor in (*factors, reference)]
    return Knob(name, tuple(dict.fromkeys(scaled[:-1])), scaled[-1])


def spelling(part: Any) -> str:
    """A part with its static choices, such as `ShadowRays(step=1, termination=0.001)`."""
    fields = [f.name for f in dataclasses.fields(part) if f.metadata.get("static")]
    chosen = ", ".join(f"{name}={getattr(part, name):g}" for name in fields if isinstance(getattr(part, name), int | float))
    inner = "".join(f", {type(x).__name__}" for x in vars(part).values() if isinstance(x, eqx.Module))
    return f"{type(part).__name__}({(chosen + inner).removeprefix(', ')})"


def is_zero(value: Any) -> bool:
    """Whether nothing of a number, of an array or of a value by scalar differs from zero."""
    array = value.values if isinstance(value, AbstractByScalar) else value
    return array is not None and not np.any(np.asarray(array))
