"""Which arrays of a scene are unknown, and how each lives in unconstrained space while it is fitted."""

import inspect
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.fitting.bijectors import AbstractBijector, Motion, bijector_of
from jvr.fitting.views import Views
from jvr.model.camera import AbstractCamera
from jvr.model.parameters import is_by_channel, is_ordered, parameter, range_at
from jvr.model.ranges import NOT_NEGATIVE, Entries, Interval, Range
from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTable
from jvr.types import Scalar

# An extinction may plausibly be so much over one voxel at least.
LEAST_DEPTH = 0.1


class ExposedModel(eqx.Module):
    """A scene, the factor between its radiance and the target images' (`None` where they are in the same unit), and the cameras of these
    (`None` where they are known)."""

    scene: Scene
    exposure: Scalar | None = parameter(NOT_NEGATIVE, doc="factor between radiance and the images")
    views: Views | None = None


class Shared(NamedTuple):
    """Arrays of several cameras that have one value; see `shared`."""

    arrays: tuple[Any, ...]


def shared(arrays: Iterable[Any]) -> Shared:
    """One unknown in the place of several: arrays of cameras that are to have one value, for `unknowns` of `jvr.fit`, such as
    `jvr.shared([c.fov_y for c in cameras])`. They must start at the same value. Poses may start apart: shared, all cameras move as one.

    **Raises** `ValueError` where there is none, `TypeError` for what is no sequence.
    """
    if isinstance(arrays, str) or not isinstance(arrays, Iterable):
        raise TypeError(f"shared takes a sequence of arrays, such as [c.fov_y for c in cameras], not {type(arrays).__name__}")
    found = tuple(arrays)
    if not found:
        raise ValueError("shared takes at least one array, such as [c.fov_y for c in cameras]")
    return Shared(found)


class Unknowns(eqx.Module):
    """The unknown arrays of a model, by their index in its list of leaves: for each the name that users read, what its class declares
    (`jvr.model.parameters`) and a bijector. `twins`: further leaves that have the same value."""

    indices: tuple[int, ...] = eqx.field(static=True)
    twins: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    ranges: tuple[Range, ...] = eqx.field(static=True)
    by_channel: tuple[bool, ...] = eqx.field(static=True)
    ordered: tuple[bool, ...] = eqx.field(static=True)
    bijectors: tuple[AbstractBijector, ...]

    def among(self, model: ExposedModel, select: Callable[[ExposedModel], Any]) -> frozenset[int]:
        """Which of the unknown arrays, counted from 0, are leaves of the parts that `select` picks out of the model; what these parts
        compute of leaves is none of them."""
        selected = _among_leaves(model, select)
        return frozenset(i for i, index in enumerate(self.indices) if index in selected)

    def values(self, model: ExposedModel) -> list[Float[Array, "..."]]:
        """The unknown arrays, each with its own shape."""
        leaves = jax.tree.leaves(model)
        return [leaves[i] for i in self.indices]

    def insert(self, model: ExposedModel, values: list[Float[Array, "..."]]) -> ExposedModel:
        """The model with other values in place of its unknown arrays."""
        leaves, structure = jax.tree.flatten(model)
        for i, twins, value in zip(self.indices, self.twins, values, strict=True):
            for index in (i, *twins):
                leaves[index] = value.reshape(leaves[index].shape).astype(leaves[index].dtype)
        return jax.tree.unflatten(structure, leaves)

    def seen_from(self, model: ExposedModel) -> dict[int, list[tuple[str, int]]]:
        """Which of the unknown arrays, counted from 0, belong to cameras: to which field of which views."""
        paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(model)]
        places = [
            [_field_of_view(paths[index]) for index in (i, *twins)] for i, twins in zip(self.indices, self.twins, strict=True)
        ]
        return {i: [place for place in found if place] for i, found in enumerate(places) if any(found)}

    def views(self, model: ExposedModel) -> frozenset[int]:
        """The views whose cameras have an unknown."""
        return frozenset(view for places in self.seen_from(model).values() for _, view in places)

    def split(self, vector: Float[Array, "unknowns"], model: ExposedModel) -> list[Float[Array, "..."]]:
        """A flat vector of all unknowns as one array for each."""
        shapes = [value.shape for value in self.values(model)]
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
        return [part.reshape(shape) for part, shape in zip(jnp.split(vector, ends[:-1]), shapes, strict=True)]

    def unconstrained_from_model(self, model: ExposedModel) -> Float[Array, "unknowns"]:
        """The flat vector in unconstrained space that stands for the model's values."""
        pairs = zip(self.bijectors, self.values(model), strict=True)
        return jnp.concatenate([jnp.ravel(bijector.inverse(value)) for bijector, value in pairs])

    def values_from_unconstrained(self, unconstrained: Float[Array, "unknowns"], model: ExposedModel) -> Float[Array, "unknowns"]:
        """The flat vector of values for a flat vector in unconstrained space."""
        pairs = zip(self.bijectors, self.split(unconstrained, model), strict=True)
        return jnp.concatenate([jnp.ravel(bijector.forward(part)) for bijector, part in pairs])

    def limits(
        self, model: ExposedModel, unconstrained: Float[np.ndarray, "unknowns"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The least and the largest unconstrained number of each unknown, and how far it may move from `unconstrained` in one step."""
        parts = [np.atleast_1d(np.asarray(part, np.float64)) for part in self.split(jnp.asarray(unconstrained), model)]
        limits = [(*t.bounds(part), t.trust_radius(part)) for t, part in zip(self.bijectors, parts, strict=True)]
        lower, upper, trust_radius = (np.concatenate([np.ravel(a) for a in arrays]) for arrays in zip(*limits, strict=True))
        return lower, upper, trust_radius

    def plausible(self, model: ExposedModel, values: Float[np.ndarray, "unknowns"]) -> Float[np.ndarray, "unknowns"]:
        """How large each value may be, as far as it and its declaration say: the width of its range, else its own size, of an extinction at
        least a tenth over one voxel, of anything without a unit that we know at least 1. Of a pose: a radian, the radius of the volume."""
        sizes, voxel = np.abs(values), float(jnp.min(model.scene.volume.spacing))
        ends = np.cumsum([value.size for value in self.values(model)])
        for part, declared, bijector in zip(np.split(sizes, ends[:-1]), self.ranges, self.bijectors, strict=True):
            known = isinstance(declared, Interval)
            if isinstance(bijector, Motion):
                part[:] = bijector.forward(jnp.full(part.shape, np.rad2deg(1.0)))
            elif known and np.isfinite(declared.high - declared.low):
                part[:] = declared.high - declared.low
            else:
                np.maximum(part, LEAST_DEPTH / voxel if known and declared.per_length else 1.0, out=part)
        return sizes

    def model_from_unconstrained(self, model: ExposedModel, unconstrained: Float[Array, "unknowns"]) -> ExposedModel:
        """The model whose unknowns are those of `unconstrained`."""
        return self.insert(model, self.split(self.values_from_unconstrained(unconstrained, model), model))


def choose_unknowns(
    model: ExposedModel, select: Callable[[ExposedModel], Any], transforms: Any = None, bounds: Interval | None = None
) -> Unknowns:
    """Finds the arrays that `select` returns among the model's own, and a bijector for each.

    `select` is called on abstract arrays: it may look at structure and shapes, not at values.

    Without `transforms` (a tuple, one for each array, `None` where the default is wanted) each array keeps to the range that its class
    declares (`jvr.model.parameters`): for a solver that keeps `bounds` as the values themselves, else by a smooth map.

    **Raises** `ValueError` where an array is not one of the scene's, not floating point, named twice or outside of its range, or the
    number of transforms differs.
    """
    indices, twins = _indices(model, select)
    leaves = jax.tree_util.tree_leaves_with_path(model)
    names = tuple(_name(leaves[i][0]) for i in indices)
    for name, index in zip(names, indices, strict=True):
        if not eqx.is_inexact_array(leaves[index][1]):
            kind = jnp.asarray(leaves[index][1]).dtype
            raise ValueError(
                f"{name} holds integers ({kind}), which have no derivative: convert them to floating point first, as "
                "dataclasses.replace(volume, values=volume.values.astype(float)) does"
            )
    given = (None,) * len(indices) if transforms is None else tuple(transforms)
    if len(given) != len(indices):
        raise ValueError(
            f"there are {len(given)} transforms for {len(indices)} unknown arrays ({', '.join(names)}): give one for each"
        )
    voxel = jnp.min(model.scene.volume.spacing)

    names = tuple(
        _together(model, leaves, i, others) if others else name for i, others, name in zip(indices, twins, names, strict=True)
    )

    def default(name: str, index: int, declared: Range) -> AbstractBijector:
        if _is_motion(leaves[index][0]):
            return Motion(model.scene.volume.radius)
        _check_start(name, leaves[index][1], declared)
        if bounds is not None and {index} == _among_leaves(model, lambda m: m.scene.volume.values):
            declared = _range_of_voxels(model, indices) or declared
        return bijector_of(declared, leaves[index][1], voxel, bounds)

    ranges = tuple(range_at(model, leaves[i][0]) for i in indices)
    by_channel, ordered = (tuple(told(model, leaves[i][0]) for i in indices) for told in (is_by_channel, is_ordered))
    chosen = tuple(t or default(*known) for t, known in zip(given, zip(names, indices, ranges, strict=True), strict=True))
    return Unknowns(indices, twins, names, ranges, by_channel, ordered, chosen)


def _among_leaves(model: ExposedModel, select: Callable[[ExposedModel], Any]) -> set[int | None]:
    """Where leaves that `select` picks out are in the model's list."""
    return {index for group in _leaf_indices(model, select) for index in group}


def _range_of_voxels(model: ExposedModel, indices: tuple[int, ...]) -> Interval | None:
    """What stored voxels may be: beyond the ends of a table all look as they do there, and no picture would pull one back. `None` where
    there are no ends, or where what maps them to voxels is unknown itself."""
    transfer, volume = model.scene.transfer, model.scene.volume
    if not isinstance(transfer, AbstractTable):
        return None
    of_table: Any = lambda m: tuple(m.scene.transfer.entries.values())
    placed = _among_leaves(model, lambda m: (m.scene.transfer, m.scene.volume.slope, m.scene.volume.intercept))
    if set(indices) & (placed - _among_leaves(model, of_table)):
        return None
    low, high = sorted(float((end - volume.intercept) / volume.slope) for end in transfer.ends)
    return Interval(low, high)


def takes_cameras(unknowns: Any) -> bool:
    """Whether a function `unknowns` is one of a scene and cameras."""
    try:
        given = inspect.signature(unknowns).parameters.values()
    except (TypeError, ValueError):
        return False
    places = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    # One that has a default is the function's own, as the index of a loop.
    return sum(one.kind in places and one.default is one.empty for one in given) == 2


def selected(unknowns: Any, scene: Scene, cameras: tuple[AbstractCamera, ...] = ()) -> Any:
    """What the function `unknowns` picks out of a scene, or of a scene and cameras.

    **Raises** `TypeError` where it is no function, `ValueError` where it asks for what the scene, or a camera, has not.
    """
    if not callable(unknowns):
        raise TypeError(
            f"unknowns must be a function that picks arrays out of a scene, such as lambda s: s.transfer.rgb, not {unknowns!r:.60}"
        )
    with_cameras = takes_cameras(unknowns)
    try:
        found = unknowns(scene, cameras) if with_cameras else unknowns(scene)
    except (AttributeError, LookupError) as error:
        names = [name for name, leaf in leaves_by_name(scene).items() if jnp.issubdtype(leaf.dtype, jnp.floating)]
        if not with_cameras:
            raise ValueError(f"unknowns ask for what the scene has not ({error}): its arrays are {', '.join(names)}") from error
        of_cameras = sorted({name for camera in cameras for name in leaves_by_name(camera)})
        raise ValueError(
            f"unknowns ask for what the scene and its {len(cameras)} cameras have not ({error}): arrays of these are "
            f"{', '.join(of_cameras)}, of the scene {', '.join(names)}"
        ) from error
    _refuse_none(found)
    return found


def _refuse_none(found: Any) -> None:
    """A part that is not there would be left out of the fit without a word. Objects may hold nothing in some of their fields."""
    if found is None:
        raise ValueError(
            "unknowns returned None: give the scene the part that is to be fitted, such as background=(0, 0, 0), or leave it out"
        )
    if type(found) in (tuple, list, dict):
        for part in found.values() if isinstance(found, dict) else found:
            _refuse_none(part)


def leaves_by_name(scene: Scene | AbstractCamera) -> dict[str, Array]:
    """The arrays of a scene, of a part of it or a camera in its place, by the names that users read, such as `transfer.rgb`."""
    return {_name(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(scene)}


def _check_start(name: str, value: Array, declared: Range) -> None:
    """A start outside of its range would be moved into it, and the fit would begin from other pictures than the user's."""
    outside = [] if not isinstance(declared, Interval | Entries) else np.asarray(value)[~declared.closed.holds(np.asarray(value))]
    if np.size(outside):
        raise ValueError(
            f"{name} starts at {np.ravel(outside)[0]:g}, outside of {declared}, where a fit keeps it: start inside, or give transforms= "
            "with jvr.Bounded(low, high), jvr.Softplus(scale) or jvr.Identity() in its place"
        )


def _leaf_indices(model: ExposedModel, select: Callable[[ExposedModel], Any]) -> list[tuple[int | None, ...]]:
    """Where in the model's list of leaves each selected array is, `None` for one that is no leaf; several in one for those that are shared.

    In an abstract model every leaf is an object of its own, also where two fields hold one and the same array.
    """
    leaves, structure = jax.tree.flatten(model)
    indices: list[tuple[int | None, ...]] = []

    def note_indices(*abstract: Any) -> None:
        index = {id(leaf): i for i, leaf in enumerate(abstract)}
        found = jax.tree.leaves(select(jax.tree.unflatten(structure, abstract)), is_leaf=is_shared)
        indices.extend(tuple(index.get(id(x)) for x in jax.tree.leaves(array)) for array in found)

    jax.eval_shape(note_indices, *leaves)
    return indices


def is_shared(value: Any) -> bool:
    return isinstance(value, Shared)


def _indices(model: ExposedModel, select: Callable[[ExposedModel], Any]) -> tuple[tuple[int, ...], tuple[tuple[int, ...], ...]]:
    """Where in the model's list of leaves the unknown arrays are, and those that share their values."""
    indices = _leaf_indices(model, select)
    if not indices:
        raise ValueError("unknowns returned no array: name at least one, for example lambda s: s.transfer.rgb")
    found = [tuple(index for index in group if index is not None) for group in indices]
    flat = sum(found, ())
    if len(flat) < sum(map(len, indices)):
        of_cameras = "" if model.views is None else " and of the cameras"
        raise ValueError(
            f"unknowns must return arrays of the scene itself{of_cameras}, for example lambda s: (s.transfer.rgb, s.transfer.sigma_t)"
        )
    if len(set(flat)) < len(flat):
        raise ValueError("unknowns returned an array twice: name each once")
    return tuple(group[0] for group in found), tuple(group[1:] for group in found)


def _together(model: ExposedModel, leaves: Any, index: int, twins: Sequence[int]) -> str:
    """The name of a value that cameras share.

    **Raises** `ValueError` for what is no array of cameras, of different fields, or starts at different values.
    """
    paths, values = zip(*(leaves[i] for i in (index, *twins)), strict=True)
    names, places = [_name(path) for path in paths], [_field_of_view(path) for path in paths]
    fields = {place[0] for place in places if place}
    if None in places or len(fields) != 1:
        raise ValueError(
            f"shared takes one array of each of several cameras, such as [c.fov_y for c in cameras], not {', '.join(names)}"
        )
    starts = [np.asarray(value).tolist() for value in values]
    if any(start != starts[0] for start in starts) and not _is_motion(paths[0]):
        other = next(i for i, start in enumerate(starts) if start != starts[0])
        raise ValueError(
            f"{names[0]} and {names[other]} are shared and start at {starts[0]} and {starts[other]}: give all cameras one of them"
        )
    assert model.views is not None
    field = names[0].partition("].")[2]
    return f"shared(cameras.{field})" if len(paths) == len(model.views.cameras) else f"shared({', '.join(names)})"


def _is_motion(path: Any) -> bool:
    place = _field_of_view(path)
    return place is not None and place[0] == "motions"


def _field_of_view(path: Any) -> tuple[str, int] | None:
    """`fov_y` or the like, or `motions`, and the number of the view, of a leaf of `ExposedModel.views`; `None` of any other."""
    if getattr(path[0], "name", None) != "views":
        return None
    return path[-1].name if path[1].name == "cameras" else "motions", path[2].idx


def _name(path: Any) -> str:
    name = jax.tree_util.keystr(path).removeprefix(".scene").removeprefix(".views").lstrip(".")
    return re.sub(r"^motions(\[\d+\])$", r"cameras\1.world_from_camera", name)
