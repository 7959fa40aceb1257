"""The pages of the reference, from the docstrings of the public names of `jvr`, which are Markdown."""

import enum
import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx

from jvr.io.reference import kinds_of, markdown, parameters_of
from jvr.io.reference import public as public_names
from jvr.names import NAMES

# Parts of the package, with the titles of their pages.
PARTS = {
    "model": "Scenes and cameras",
    "effects": "Effects",
    "march": "Marching",
    "rendering": "Pictures",
    "integrators": "Integrators",
    "fitting": "Fits",
    "io": "Files",
    "others": "Everything else",
}
# Modules that are public as a whole, by the names that users call them by.
MODULES = {"presets": "jvr.model.presets", "sh": "jvr.model.harmonics"}


def write(folder: Path) -> None:
    """The pages as files; what is as it was is left alone, and so not built again."""
    folder.mkdir(exist_ok=True)
    for part, text in pages().items():
        path = folder / f"{part}.md"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def pages() -> dict[str, str]:
    """The text of each page."""
    sections: dict[str, list[str]] = {part: [f"# {title}"] for part, title in PARTS.items()}
    for module in sorted([*NAMES, *MODULES.values()]):
        part = module.split(".")[1]
        sections[part if part in PARTS else "others"].append(section(module))
    return {part: "\n\n".join(texts) + "\n" for part, texts in sections.items()}


def section(module: str) -> str:
    """What a module gives to users."""
    title = module.split(".")[-1].replace("_", " ").capitalize().replace("Brdf", "BRDF").replace("Merl", "MERL")
    entries = (entry(name, thing) for name, thing in public().items() if home(name) == module)
    return "\n\n".join([f"## {title}", text_of(importlib.import_module(module)), *entries])


def public() -> dict[str, Any]:
    """Every public class and function by the name that users call it by."""
    found = {f"jvr.{name}": thing for name, thing in public_names().items()}
    for name, module in MODULES.items():
        functions = inspect.getmembers(importlib.import_module(module), inspect.isfunction)
        found |= {
            f"jvr.{name}.{f}": thing for f, thing in functions if not f.startswith("_") and thing.__module__.startswith(module)
        }
    return found


def home(name: str) -> str:
    """The module of a public name, as `jvr.names` says."""
    _, first, *rest = name.split(".")
    return MODULES[first] if rest else next(module for module, names in NAMES.items() if first in names)


def entry(name: str, thing: Any) -> str:
    """A class with its methods, or a function."""
    if not inspect.isclass(thing):
        return directive("function", name + signature(thing), whole_text_of(thing))
    if issubclass(thing, enum.Enum):
        return directive("class", name, f"{text_of(thing)} One of {', '.join(f'`{value}`' for value in thing.__members__)}.")
    body = [whole_text_of(thing) if issubclass(thing, eqx.Module) else text_of(thing)]
    for method, kind, function in methods(thing):
        found = text_of(function) if kind == "property" else whole_text_of(getattr(thing, method))
        body.append(directive(kind, method + ("" if kind == "property" else signature(function)), found))
    return directive("class", name + signature(thing), "\n\n".join(body), ":::::")


def whole_text_of(thing: Any) -> str:
    """What the text of a class or function says, what configurations call it, and a table of the parameters that it declares."""
    kinds = (f'In a configuration `kind = "{kind}"`.' for kind in kinds_of(thing))
    return "\n\n".join(part for part in (text_of(thing), *kinds, markdown(parameters_of(thing))) if part)


def directive(kind: str, head: str, body: str, fence: str = "::::") -> str:
    return f"{fence}{{py:{kind}}} {head}\n{body}\n{fence}"


def text_of(thing: Any) -> str:
    return inspect.getdoc(thing) or ""


def methods(cls: type) -> Iterator[tuple[str, str, Any]]:
    """What is public in a class and not a contract of its base, in the order of the file: name, kind, function."""
    for name, member in vars(cls).items():
        function = getattr(member, "fget", None) or getattr(member, "__func__", member)
        kind = type(member).__name__ if isinstance(member, property | classmethod | staticmethod) else "method"
        promised = any(name in vars(base) for base in cls.__mro__[1:])
        if not name.startswith("_") and not promised and inspect.isfunction(function) and function.__doc__:
            yield name, kind, function


def signature(function: Any) -> str:
    """Names and defaults; what they are the text says."""
    found = inspect.signature(function)
    parameters = [
        p.replace(annotation=p.empty, default=p.default if p.default is p.empty else Shown(p.default))
        for p in found.parameters.values()
        if p.name not in ("self", "cls")
    ]
    return str(found.replace(parameters=parameters, return_annotation=found.empty))


class Shown:
    """A default as it is written in Python, on one line."""

    def __init__(self, value: Any):
        self.value = value

    def __repr__(self) -> str:
        if isinstance(self.value, float):
            return f"{self.value:.6g}"
        if self.value is not None and self.value == default_of(type(self.value)):
            return f"{type(self.value).__name__}()"
        return re.sub(r",? \)", ")", re.sub(r"\s+", " ", repr(self.value)).replace("( ", "("))


def default_of(kind: type) -> Any:
    """What the class makes without arguments, or `None`."""
    try:
        return kind() if kind.__module__.startswith("jvr") else None
    except TypeError:
        return None
