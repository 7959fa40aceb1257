"""Which arrays of a scene are unknown, and how each lives on the real line while it is fitted."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.model.scene import Scene
from jvr.numerics import normalise
from jvr.types import Scalar

# How near to the end of its range a start value may lie: at the end itself a transform has no slope and the fit cannot leave.
MARGIN = 1e-3


class AbstractTransform(eqx.Module):
    """A smooth map from the real line onto the values that an unknown may take."""

    @abc.abstractmethod
    def forward(self, real: Float[Array, "..."]) -> Float[Array, "..."]:
        """The value."""

    @abc.abstractmethod
    def inverse(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """The real number that gives `value`, or the nearest value that has one."""

    @property
    @abc.abstractmethod
    def reach(self) -> float:
        """How far a linearisation of `forward` is good for, on the real line."""


class Identity(AbstractTransform):
    """Any real value."""

    def forward(self, real: Float[Array, "..."]) -> Float[Array, "..."]:
        return real

    def inverse(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        return value

    @property
    def reach(self) -> float:
        return np.inf


# Within this distance the curved transforms change their slope by less than an order of magnitude.
REACH = 2.0


class Softplus(AbstractTransform):
    """Positive values, `scale * log(1 + exp(x))`; `scale` is a typical value, in the unknown's own unit."""

    scale: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=1.0)

    def forward(self, real: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.scale * jax.nn.softplus(real)

    def inverse(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        ratio = jnp.maximum(value / self.scale, MARGIN)
        return ratio + jnp.log(-jnp.expm1(-ratio))

    @property
    def reach(self) -> float:
        return REACH


class Sigmoid(AbstractTransform):
    """Values between `low` and `high`."""

    low: float = eqx.field(static=True, default=0.0)
    high: float = eqx.field(static=True, default=1.0)

    def forward(self, real: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.low + (self.high - self.low) * jax.nn.sigmoid(real)

    def inverse(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        share = jnp.clip((value - self.low) / (self.high - self.low), MARGIN, 1 - MARGIN)
        return jnp.log(share) - jnp.log1p(-share)

    @property
    def reach(self) -> float:
        return REACH


class Direction(AbstractTransform):
    """Unit vectors: what has no length to be found."""

    def forward(self, real: Float[Array, "3"]) -> Float[Array, "3"]:
        return normalise(real)

    def inverse(self, value: Float[Array, "3"]) -> Float[Array, "3"]:
        return normalise(value)

    @property
    def reach(self) -> float:
        # About 30 degrees.
        return 0.5


class Ordered(AbstractTransform):
    """Strictly increasing values with both ends free: the first as it is, then softplus of every gap over the mean gap."""

    scale: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=1.0)

    def forward(self, real: Float[Array, "n"]) -> Float[Array, "n"]:
        gaps = self.scale * jax.nn.softplus(real[1:])
        return jnp.concatenate([self.scale * real[:1], self.scale * real[0] + jnp.cumsum(gaps)])

    def inverse(self, value: Float[Array, "n"]) -> Float[Array, "n"]:
        gaps = Softplus(self.scale).inverse(jnp.diff(value))
        return jnp.concatenate([value[:1] / self.scale, gaps])

    @property
    def reach(self) -> float:
        return REACH


class Exposed(eqx.Module):
    """A scene and the factor between its radiance and the target images' (`None` where they are in the same unit)."""

    scene: Scene
    exposure: Scalar | None


class Unknowns(eqx.Module):
    """The unknown arrays of a model, by their place in its list of leaves, with a transform for each."""

    places: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    transforms: tuple[AbstractTransform, ...]

    def values(self, model: Exposed) -> list[Float[Array, "..."]]:
        """The unknown arrays, each with its own shape."""
        leaves = jax.tree.leaves(model)
        return [leaves[i] for i in self.places]

    def insert(self, model: Exposed, values: list[Float[Array, "..."]]) -> Exposed:
        """The model with other values in place of its unknown arrays."""
        leaves, structure = jax.tree.flatten(model)
        for i, value in zip(self.places, values, strict=True):
            leaves[i] = value.reshape(leaves[i].shape).astype(leaves[i].dtype)
        return jax.tree.unflatten(structure, leaves)

    def split(self, vector: Float[Array, "unknowns"], model: Exposed) -> list[Float[Array, "..."]]:
        """A flat vector of all unknowns as one array for each."""
        shapes = [value.shape for value in self.values(model)]
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
        return [part.reshape(shape) for part, shape in zip(jnp.split(vector, ends[:-1]), shapes, strict=True)]

    def real_from_model(self, model: Exposed) -> Float[Array, "unknowns"]:
        """The flat vector on the real line that stands for the model's values."""
        pairs = zip(self.transforms, self.values(model), strict=True)
        return jnp.concatenate([jnp.ravel(transform.inverse(value)) for transform, value in pairs])

    def values_from_real(self, real: Float[Array, "unknowns"], model: Exposed) -> Float[Array, "unknowns"]:
        """The flat vector of values for a flat vector on the real line."""
        pairs = zip(self.transforms, self.split(real, model), strict=True)
        return jnp.concatenate([jnp.ravel(transform.forward(part)) for transform, part in pairs])

    def reach(self, model: Exposed) -> Float[np.ndarray, "unknowns"]:
        """How far each unknown may move in one step on the real line."""
        return np.concatenate([np.full(v.size, t.reach) for t, v in zip(self.transforms, self.values(model), strict=True)])

    def model_from_real(self, model: Exposed, real: Float[Array, "unknowns"]) -> Exposed:
        """The model whose unknowns are those of `real`."""
        return self.insert(model, self.split(self.values_from_real(real, model), model))


def choose_unknowns(model: Exposed, select: Callable[[Exposed], Any], transforms: Any = None) -> Unknowns:
    """Finds the arrays that `select` returns among the model's own, and a transform for each.

    `select` is called on abstract arrays: it may look at structure and shapes, not at values.

    Without `transforms` (a tuple, one for each array, `None` where the default is wanted), colours, albedo, weights and shares of light
    that a material reflects get `Sigmoid()`, asymmetries `Sigmoid(-1, 1)`, roughness and indices of refraction `Sigmoid` between their
    bounds, extinction, heights, widths, coefficients of dipoles and what lights and surfaces have of strength `Softplus`, positions
    of a table `Ordered`, directions `Direction`, anything else (such as the coefficients of an environment) `Identity`.

    **Raises** `ValueError` where an array is not one of the scene's, not floating point or named twice, or the number of transforms
    differs.
    """
    places = _places(model, select)
    named = [(_name(path), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(model)]
    for name, array in (named[i] for i in places):
        if not eqx.is_inexact_array(array):
            raise ValueError(
                f"{name.removeprefix('scene.')} has integer voxels, which cannot be fitted: convert them to floating point first"
            )
    names = tuple(named[i][0] for i in places)
    given = (None,) * len(places) if transforms is None else tuple(transforms)
    if len(given) != len(places):
        raise ValueError(
            f"there are {len(given)} transforms for {len(places)} unknown arrays ({', '.join(names)}): give one for each"
        )
    chosen = tuple(t or _default_transform(*named[i], model) for t, i in zip(given, places, strict=True))
    return Unknowns(places, names, chosen)


def _places(model: Exposed, select: Callable[[Exposed], Any]) -> tuple[int, ...]:
    """Where in the model's list of leaves the selected arrays are.

    In an abstract model every leaf is an object of its own, also where two fields hold one and the same array.
    """
    leaves, structure = jax.tree.flatten(model)
    places: list[int | None] = []

    def note_places(*abstract: Any) -> None:
        place = {id(leaf): i for i, leaf in enumerate(abstract)}
        places.extend(place.get(id(array)) for array in jax.tree.leaves(select(jax.tree.unflatten(structure, abstract))))

    jax.eval_shape(note_places, *leaves)
    if not places:
        raise ValueError("unknowns returned no array: name at least one, for example lambda s: s.transfer.rgb")
    found = tuple(place for place in places if place is not None)
    if len(found) < len(places):
        raise ValueError(
            "unknowns must return arrays of the scene itself, for example lambda s: (s.transfer.rgb, s.transfer.sigma_t)"
        )
    if len(set(found)) < len(found):
        raise ValueError("unknowns returned an array twice: name each once")
    return found


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path).lstrip(".")


def _default_transform(name: str, value: Array, model: Exposed) -> AbstractTransform:
    field = name.rsplit(".", 1)[-1]
    of_material = name.startswith("scene.material")
    if field in ("rgb", "background") or (of_material and field in ("diffuse", "specular")):
        return Sigmoid()
    if field in ("sigma_t", "height"):
        return Softplus(1.0 / jnp.min(model.scene.volume.spacing))
    if field in ("exposure", "ambient", "diffuse", "specular", "threshold"):
        return Softplus()
    if field in ("irradiance", "intensity", "radiance", "shininess", "exponent", "sigma_a", "sigma_s_prime"):
        return Softplus(jnp.maximum(jnp.mean(value), 1e-3))
    if field in ("g", "g1", "g2", "k"):
        return Sigmoid(-1.0, 1.0)
    if field in ("albedo", "weight", "reflectance", "base", "metallic", "reflectance_at_normal"):
        return Sigmoid()
    if field == "roughness":
        return Sigmoid(1e-3, 1.0)
    if field == "eta":
        return Sigmoid(1.0, 3.0)
    if field == "direction":
        return Direction()
    if field == "width":
        return Softplus(jnp.mean(value))
    if field == "positions":
        return Ordered(jnp.mean(jnp.diff(value)))
    return Identity()
