"""Which arrays of a scene are unknown, and how each lives in unconstrained space while it is fitted."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.fitting.bijectors import AbstractBijector, bijector_of
from jvr.model.parameters import is_by_channel, is_ordered, parameter, range_at
from jvr.model.ranges import NOT_NEGATIVE, Entries, Interval, Range
from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTable
from jvr.types import Scalar

# An extinction may plausibly be so much over one voxel at least.
LEAST_DEPTH = 0.1


class ExposedModel(eqx.Module):
    """A scene and the factor between its radiance and the target images' (`None` where they are in the same unit)."""

    scene: Scene
    exposure: Scalar | None = parameter(NOT_NEGATIVE, doc="factor between radiance and the images")


class Unknowns(eqx.Module):
    """The unknown arrays of a model, by their index in its list of leaves: for each the name that users read, what its class declares
    (`jvr.model.parameters`) and a bijector."""

    indices: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    ranges: tuple[Range, ...] = eqx.field(static=True)
    by_channel: tuple[bool, ...] = eqx.field(static=True)
    ordered: tuple[bool, ...] = eqx.field(static=True)
    bijectors: tuple[AbstractBijector, ...]

    def among(self, model: ExposedModel, select: Callable[[ExposedModel], Any]) -> frozenset[int]:
        """Which of the unknown arrays, counted from 0, are leaves of the parts that `select` picks out of the model; what these parts
        compute of leaves is none of them."""
        selected = set(_leaf_indices(model, select))
        return frozenset(i for i, index in enumerate(self.indices) if index in selected)

    def values(self, model: ExposedModel) -> list[Float[Array, "..."]]:
        """The unknown arrays, each with its own shape."""
        leaves = jax.tree.leaves(model)
        return [leaves[i] for i in self.indices]

    def insert(self, model: ExposedModel, values: list[Float[Array, "..."]]) -> ExposedModel:
        """The model with other values in place of its unknown arrays."""
        leaves, structure = jax.tree.flatten(model)
        for i, value in zip(self.indices, values, strict=True):
            leaves[i] = value.reshape(leaves[i].shape).astype(leaves[i].dtype)
        return jax.tree.unflatten(structure, leaves)

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
        least a tenth over one voxel, of anything without a unit that we know at least 1."""
        sizes, voxel = np.abs(values), float(jnp.min(model.scene.volume.spacing))
        ends = np.cumsum([value.size for value in self.values(model)])
        for part, declared in zip(np.split(sizes, ends[:-1]), self.ranges, strict=True):
            known = isinstance(declared, Interval)
            if known and np.isfinite(declared.high - declared.low):
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
    indices = _indices(model, select)
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

    def default(name: str, index: int, declared: Range) -> AbstractBijector:
        _check_start(name, leaves[index][1], declared)
        if bounds is not None and [index] == _leaf_indices(model, lambda m: m.scene.volume.values):
            declared = _range_of_voxels(model, indices) or declared
        return bijector_of(declared, leaves[index][1], voxel, bounds)

    ranges = tuple(range_at(model, leaves[i][0]) for i in indices)
    by_channel, ordered = (tuple(told(model, leaves[i][0]) for i in indices) for told in (is_by_channel, is_ordered))
    chosen = tuple(t or default(*known) for t, known in zip(given, zip(names, indices, ranges, strict=True), strict=True))
    return Unknowns(indices, names, ranges, by_channel, ordered, chosen)


def _range_of_voxels(model: ExposedModel, indices: tuple[int, ...]) -> Interval | None:
    """What stored voxels may be: beyond the ends of a table all look as they do there, and no picture would pull one back. `None` where
    there are no ends, or where what maps them to voxels is unknown itself."""
    transfer, volume = model.scene.transfer, model.scene.volume
    if not isinstance(transfer, AbstractTable):
        return None
    of_table: Any = lambda m: (m.scene.transfer.rgb, m.scene.transfer.sigma_t)
    entries = _leaf_indices(model, of_table)
    placed = _leaf_indices(model, lambda m: (m.scene.transfer, m.scene.volume.slope, m.scene.volume.intercept))
    if set(indices) & (set(placed) - set(entries)):
        return None
    low, high = sorted(float((end - volume.intercept) / volume.slope) for end in transfer.ends)
    return Interval(low, high)


def selected(unknowns: Any, scene: Scene) -> Any:
    """What the function `unknowns` picks out of a scene.

    **Raises** `TypeError` where it is no function, `ValueError` where it asks for what the scene has not.
    """
    if not callable(unknowns):
        raise TypeError(
            f"unknowns must be a function that picks arrays out of a scene, such as lambda s: s.transfer.rgb, not {unknowns!r:.60}"
        )
    try:
        found = unknowns(scene)
    except (AttributeError, LookupError) as error:
        names = [name for name, leaf in leaves_by_name(scene).items() if jnp.issubdtype(leaf.dtype, jnp.floating)]
        raise ValueError(f"unknowns ask for what the scene has not ({error}): its arrays are {', '.join(names)}") from error
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


def leaves_by_name(scene: Scene) -> dict[str, Array]:
    """The arrays of a scene, or of a part of it in its place, by the names that users read, such as `transfer.rgb`."""
    return {_name(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(scene)}


def _check_start(name: str, value: Array, declared: Range) -> None:
    """A start outside of its range would be moved into it, and the fit would begin from other pictures than the user's."""
    outside = [] if not isinstance(declared, Interval | Entries) else np.asarray(value)[~declared.closed.holds(np.asarray(value))]
    if np.size(outside):
        raise ValueError(
            f"{name} starts at {np.ravel(outside)[0]:g}, outside of {declared}, where a fit keeps it: start inside, or give transforms= "
            "with jvr.Bounded(low, high), jvr.Softplus(scale) or jvr.Identity() in its place"
        )


def _leaf_indices(model: ExposedModel, select: Callable[[ExposedModel], Any]) -> list[int | None]:
    """Where in the model's list of leaves each selected array is, `None` for one that is no leaf.

    In an abstract model every leaf is an object of its own, also where two fields hold one and the same array.
    """
    leaves, structure = jax.tree.flatten(model)
    indices: list[int | None] = []

    def note_indices(*abstract: Any) -> None:
        index = {id(leaf): i for i, leaf in enumerate(abstract)}
        indices.extend(index.get(id(array)) for array in jax.tree.leaves(select(jax.tree.unflatten(structure, abstract))))

    jax.eval_shape(note_indices, *leaves)
    return indices


def _indices(model: ExposedModel, select: Callable[[ExposedModel], Any]) -> tuple[int, ...]:
    """Where in the model's list of leaves the unknown arrays are."""
    indices = _leaf_indices(model, select)
    if not indices:
        raise ValueError("unknowns returned no array: name at least one, for example lambda s: s.transfer.rgb")
    found = tuple(index for index in indices if index is not None)
    if len(found) < len(indices):
        raise ValueError(
            "unknowns must return arrays of the scene itself, for example lambda s: (s.transfer.rgb, s.transfer.sigma_t)"
        )
    if len(set(found)) < len(found):
        raise ValueError("unknowns returned an array twice: name each once")
    return found


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path).removeprefix(".scene").lstrip(".")
