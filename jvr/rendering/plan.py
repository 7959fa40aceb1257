"""What of a scene is in the compiled program, decided from its structure alone."""

import dataclasses
from collections import Counter
from collections.abc import Iterator
from typing import Any

import jax

from jvr.execution.devices import cores, shares
from jvr.model.parts import AbstractPart, PlanEntry
from jvr.model.scene import Scene
from jvr.rendering.settings import Settings


@dataclasses.dataclass(frozen=True)
class Plan:
    """The plan of a rendering: what it compiles to. Equal plans compile to the same program; `print` explains it."""

    parts: tuple[PlanEntry, ...]
    key: str

    def __str__(self) -> str:
        width = max(len(part.name) for part in self.parts)
        needs = lambda part: f"; needs {', '.join(part.needs)}" if part.needs else ""
        return "\n".join(
            f"{'+' if part.included else '-'} {part.name:<{width}}  {part.reason}{needs(part)}" for part in self.parts
        )


def plan(scene: Scene, settings: Settings = Settings()) -> Plan:
    """What `render(scene, camera, settings)` puts into the compiled program, and why.

    A pure function of the scene's structure (which parts there are, shapes, types, static choices) and of the settings, never of the
    values of arrays: a scene with other numbers has the same plan and is not compiled again. Hashable.
    """
    entries = [*_entries(scene, scene, settings), *_entries(settings, scene, settings), _devices()]
    shapes = jax.tree.map(lambda x: (x.shape, str(x.dtype)), jax.tree.leaves(scene))
    return Plan(tuple(entries), f"{jax.tree.structure((scene, settings))} {shapes}")


def _entries(whole: AbstractPart, scene: Scene, settings: Settings) -> Iterator[PlanEntry]:
    """What the parts of a scene, or of settings, say, those that it does not have, and what it says itself."""
    for field in dataclasses.fields(whole):
        held: Any = getattr(whole, field.name)
        name, parts = field.name.replace("_", " "), held if isinstance(held, tuple) else (held,)
        if held is None or not parts:
            yield PlanEntry(name, False, "the scene names none")
        elif isinstance(parts[0], AbstractPart):
            yield from _together([part.explain(name, scene, settings) for part in parts])
    yield from whole.explain("", scene, settings)


def _together(explained: list[tuple[PlanEntry, ...]]) -> Iterator[PlanEntry]:
    """What several parts in one place say, as one entry."""
    for entries in zip(*explained, strict=True):
        said = Counter(entry.reason for entry in entries)
        reason = ", ".join(f"{number} x {reason}" if number > 1 else reason for reason, number in said.items())
        yield entries[0]._replace(included=any(entry.included for entry in entries), reason=reason)


def _devices() -> PlanEntry:
    if shares() > 1:
        return PlanEntry("devices", True, f"rays are spread over {shares()}")
    idle = jax.default_backend() == "cpu" and cores() > 1
    return PlanEntry(
        "devices", False, f"one, of {cores()} cores: call jvr.use_all_cores() before anything is computed" if idle else "one"
    )
