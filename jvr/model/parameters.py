"""Parameters: what may be said of a field of a public class, declared once beside it.

    class Ring(AbstractLight):
        position: Vector = parameter(doc="x, y, z", unit="mm")
        radius: Scalar = parameter(POSITIVE, doc="of the ring", unit="mm")
        segments: int = choice(Interval(low=3), doc="points on the ring")

        def __init__(self, position: ArrayLike, radius: ArrayLike = 1.0, segments: int = 16):
            assign(self, position=position, radius=radius, segments=segments)

From it come the constructor's check (`assign`), what a fit keeps an array to (`range_at`), the table of the class in a
configuration (`jvr.io.config.schema.parts`), how it is saved and loaded, and the reference (`jvr.io.reference`).
"""

import abc
import dataclasses
import functools
import inspect
import math
import types
import typing
from collections.abc import Callable
from typing import Any, ClassVar, ParamSpec, TypeAlias, TypeVar

import equinox as eqx
import jax

from jvr.model.checks import colours, float_array, known, radiances
from jvr.model.ranges import ANY, Interval, Range

# Lengths of the axes of an array; a name stands for any length that is the same wherever a class says it.
Shape: TypeAlias = tuple[int | str, ...]

# One number, or one for each of red, green and blue.
GREY_OR_RGB: tuple[Shape, ...] = ((), (3,))
# Three numbers.
TRIPLE: tuple[Shape, ...] = ((3,),)
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
TAKE = {"": float_array, "colour": colours, "radiance": radiances}


class AbstractByScalar(eqx.Module):
    """A coefficient that depends on the scalar or on the length of its gradient, in the place of a number: its `values` are in that
    number's range."""

    values: eqx.AbstractVar[Any]
    # Whether it asks for the gradient.
    needs_gradient: ClassVar[bool]

    @abc.abstractmethod
    def at_sample(self, s: Any, magnitude: Any) -> Any:
        """The number at a sample: the scalar `s`, with a gradient of length `magnitude`."""


@dataclasses.dataclass(frozen=True)
class Parameter:
    """What is declared of a field.

    - `within`: the values that it takes.
    - `doc`: what it is, in a few words that errors and the reference show; `unit`: of its numbers; `hint`: a value to begin with.
    - `shapes`: of its array; `None`: as the annotation says.
    - `by_scalar`: whether a `jvr.ByValue` or a `jvr.ByGradient` may stand in its place. The field is then annotated `Any`: it holds the one
      or the other, while methods along a ray see numbers alone (`jvr.model.by_value.at_sample`), which no annotation of one field says to
      a type checker.
    - `by_channel`: whether, where the last axis is colour, each of its channels acts on that channel of a picture alone, as those of light
      do. A fit then takes one forward derivative for all three.
    - `ordered`: whether entries along the first axis follow each other by value, so that what lies between two of them is meant to be
      between theirs. What images do not determine is continued along it.
    - `least`: entries that a named axis has at least.
    - `most`: the largest number that a file may ask for, where a constructor takes larger ones: a slip of the pen must not take all memory.
    """

    within: Range
    doc: str
    unit: str = ""
    hint: str = ""
    shapes: tuple[Shape, ...] | None = None
    by_scalar: bool = False
    by_channel: bool = False
    ordered: bool = False
    least: int = 1
    most: float | int = math.inf

    @property
    def about(self) -> str:
        return self.doc + (f", in {self.unit}" if self.unit else "") + (f"; {self.hint}" if self.hint else "")


def parameter(
    within: Range = ANY,
    *,
    doc: str,
    unit: str = "",
    hint: str = "",
    shapes: tuple[Shape, ...] | None = None,
    by_scalar: bool = False,
    by_channel: bool = False,
    ordered: bool = False,
    least: int = 1,
) -> Any:
    """A field that is an array, or another part of a scene; see `Parameter`."""
    return eqx.field(metadata={"parameter": Parameter(within, doc, unit, hint, shapes, by_scalar, by_channel, ordered, least)})


def choice(within: Range = ANY, *, doc: str, unit: str = "", hint: str = "", most: float | int = math.inf, **default: Any) -> Any:
    """A static field: a number, truth value or word that a program is compiled for; see `Parameter`. `default`: of classes without a
    constructor of their own."""
    return eqx.field(static=True, metadata={"parameter": Parameter(within, doc, unit, hint, most=most)}, **default)


def arguments(**fields: Any) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Declares arguments of a function as the fields of a class are, by `parameter` and `choice`; of arrays other than numbers with their
    shapes. Each call checks them, as `assign` does, and passes them on as they came: an array of single precision has no room for all
    digits of a position.

        @arguments(radius=parameter(POSITIVE, doc="of the circle", unit="mm"), count=choice(AT_LEAST_ONE, doc="cameras"))
        def ring(radius: ArrayLike, count: int) -> tuple[AbstractCamera, ...]: ...
    """

    def declare(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        signature = inspect.signature(function)
        for name, field in fields.items():
            field.name, field.type = name, signature.parameters[name].annotation

        @functools.wraps(function)
        def checked(*args: Arguments.args, **keywords: Arguments.kwargs) -> Result:
            given, lengths = signature.bind(*args, **keywords), {}
            for name, value in given.arguments.items():
                if name in fields:
                    _checked(fields[name], value, lengths)
            return function(*args, **keywords)

        vars(checked)["declared"] = fields
        return checked

    return declare


def declared(thing: Any) -> dict[str, dataclasses.Field]:
    """The fields of a class, or the arguments of a function, that are declared parameters, by name."""
    fields = dataclasses.fields(thing) if isinstance(thing, type) else getattr(thing, "declared", {}).values()
    return {f.name: f for f in fields if "parameter" in f.metadata}


def range_at(tree: Any, path: tuple[Any, ...]) -> Range:
    """The range of the leaf of `tree` at a path of `jax.tree_util`: the innermost declared along it that limits anything, such as that of
    an asymmetry for the values of a `jvr.ByValue` in its place, and any number where none does."""
    return next((about.within for about in _declared_at(tree, path) if about.within != ANY), ANY)


def is_by_channel(tree: Any, path: tuple[Any, ...]) -> bool:
    """Whether each colour channel of the leaf of `tree` at a path acts on that channel of a picture alone."""
    return next((about.by_channel for about in _declared_at(tree, path)), False)


def is_ordered(tree: Any, path: tuple[Any, ...]) -> bool:
    """Whether entries of the leaf of `tree` at a path follow each other along its first axis."""
    return next((about.ordered for about in _declared_at(tree, path)), False)


def _declared_at(tree: Any, path: tuple[Any, ...]) -> list[Parameter]:
    """What the fields along a path declare, the innermost first."""
    found: list[Parameter] = []
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            field = declared(type(tree)).get(key.name)
            found = found if field is None else [field.metadata["parameter"], *found]
            tree = getattr(tree, key.name)
        else:
            tree = tree[key.key if isinstance(key, jax.tree_util.DictKey) else key.idx]
    return found


def assign(part: eqx.Module, **values: Any) -> None:
    """Sets fields of an object under construction, each to a value that its declaration allows.

    Arrays and numbers are converted; shapes, types and the lengths that fields share are always checked, values wherever they are known
    (not while tracing). **Raises** `ValueError` or `TypeError` that say what is wrong and what would be right.
    """
    fields, lengths = declared(type(part)), {}
    for name, value in values.items():
        setattr(part, name, _checked(fields[name], value, lengths))


def _checked(field: dataclasses.Field, value: Any, lengths: dict[str, int]) -> Any:
    about: Parameter = field.metadata["parameter"]
    if value is None and type(None) in alternatives(field.type):
        return None
    if field.metadata.get("static"):
        return _chosen(field, value)
    classes = parts_of(field.type)
    if classes and (typing.get_origin(field.type) is tuple or (isinstance(value, tuple | list) and takes_rows(field.type))):
        return _parts(field, value, classes, lengths)
    # A field may take an array in the place of a part.
    if classes and (isinstance(value, eqx.Module) or not takes_array(field.type)):
        if not isinstance(value, classes):
            found = repr(value) if isinstance(value, str) else type(value).__name__
            raise TypeError(f"{field.name} must be {about.doc}, not {found}")
        return value
    if about.by_scalar and isinstance(value, AbstractByScalar):
        require_within(value.values, field.name, about)
        return value
    return array_of(value, field.name, about, shapes_of(field), lengths)


def takes_array(annotation: Any) -> bool:
    """Whether an annotation names an array, alone or beside parts of a scene."""
    return any(hasattr(kind, "dim_str") for kind in alternatives(annotation))


def _parts(field: dataclasses.Field, value: Any, classes: tuple[type, ...], lengths: dict[str, int]) -> tuple[Any, ...]:
    """Other parts in a row; their number is that of a named axis."""
    about, parts = field.metadata["parameter"], tuple(value)
    wrong = [type(part).__name__ for part in parts if not isinstance(part, classes)]
    if wrong:
        raise TypeError(f"{field.name} must be {about.doc}, not {wrong[0]}")
    for axis in (about.shapes or ((),))[0]:
        _note_length(axis, len(parts), field.name, about, lengths)
    return parts


def _note_length(axis: int | str, n: int, name: str, about: Parameter, lengths: dict[str, int]) -> None:
    """Notes the length of a named axis. **Raises** `ValueError` where it is too short, or another than that of fields before."""
    if not isinstance(axis, str):
        return
    if n < about.least:
        wanted = f"have at least {about.least} entries, not {n}" if about.least > 1 else "not be empty"
        raise ValueError(f"{name} must {wanted}")
    if lengths.setdefault(axis, n) != n:
        raise ValueError(f"{name} has {n} entries; it must have {lengths[axis]}")


def array_of(
    value: Any, name: str, about: Parameter, shapes: tuple[Shape, ...] = ((),), lengths: dict[str, int] | None = None
) -> Any:
    """`value` as an array that the declaration allows; `lengths` of named axes are those found before, and get new ones."""
    lengths = {} if lengths is None else lengths
    light = about.within.light if isinstance(about.within, Interval) else ""
    known_shapes = tuple(tuple(lengths.get(n) if isinstance(n, str) else n for n in shape) for shape in shapes)
    array = TAKE[light](value, name, *known_shapes)
    for axis, n in zip(next(shape for shape in shapes if len(shape) == array.ndim), array.shape, strict=True):
        _note_length(axis, n, name, about, lengths)
    if not light:
        require_within(array, name, about)
    return array


def require_within(values: Any, name: str, about: Parameter) -> None:
    """**Raises** `ValueError` where values are known and not all in the range."""
    numbers = known(values)
    if numbers is None:
        return
    inside = about.within.holds(numbers)
    if not inside.all():
        hint = f" ({about.about})" if about.doc else ""
        wrong = f", not {numbers[~inside].flat[0]:g}" if inside.shape == numbers.shape else ""
        raise ValueError(f"{name} {about.within.problem}{hint}{wrong}")


def _chosen(field: dataclasses.Field, value: Any) -> Any:
    """A static choice of the type and in the range that its field says."""
    about, kinds = field.metadata["parameter"], alternatives(field.type)
    words = [word for kind in kinds for word in typing.get_args(kind)]
    if value in words if words else isinstance(value, bool) and bool in kinds:
        return value
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and float in kinds and about.within.holds(value):
        return float(value)
    if is_number and isinstance(value, int) and int in kinds and about.within.holds(value):
        return value
    wanted = " or ".join(map(repr, words)) if words else "True or False" if bool in kinds else about.within.words
    wanted = f"a whole number {about.within.whole_words}" if int in kinds and float not in kinds else wanted
    of_other_type = bool in kinds or not (is_number or words)
    raise (TypeError if of_other_type else ValueError)(f"{field.name} must be {wanted} ({about.about}), not {value!r}")


def alternatives(annotation: Any) -> tuple[Any, ...]:
    """The types that an annotation names: those of a union, or it alone."""
    is_union = typing.get_origin(annotation) in (typing.Union, types.UnionType)
    return typing.get_args(annotation) if is_union else (annotation,)


def parts_of(annotation: Any) -> tuple[type, ...]:
    """The classes of other parts of a scene that an annotation names, one or a row of them."""
    is_row = typing.get_origin(annotation) is tuple
    kinds = alternatives(typing.get_args(annotation)[0] if is_row else annotation)
    return tuple(kind for kind in kinds if isinstance(kind, type) and issubclass(kind, eqx.Module))


def takes_rows(annotation: Any) -> bool:
    """Whether one of the types that an annotation names is a row of parts."""
    return any(typing.get_origin(kind) is tuple for kind in alternatives(annotation))


def shapes_of(field: dataclasses.Field) -> tuple[Shape, ...]:
    """The shapes of an array that a field takes: those declared, or that of its annotation."""
    shapes = field.metadata["parameter"].shapes
    if shapes is not None:
        return shapes
    axes = next((kind.dim_str for kind in alternatives(field.type) if hasattr(kind, "dim_str")), "")
    return (tuple(int(n) if n.isdigit() else n for n in axes.split()),)
