"""Interfaces of the effects, so that a scene can hold them and no module of theirs is imported where it does not."""

import abc
import dataclasses
import warnings
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
from jax.core import Tracer
from jaxtyping import Array, Float, UInt32
from numpy import ndarray

from jvr.model.kept import content, is_same_content
from jvr.model.parts import AbstractPart, PlanEntry, asks_gradient, spelling
from jvr.names import Renamed
from jvr.types import Channels, Scalar, Triple


class AbstractBSDF(AbstractPart):
    """How light that arrives at a point is sent on to the eye: by surfaces and by the medium, of lights and of the environment."""

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        asked = {"lights": self.shows_lights, "environment": self.shows_environment, "gradient": asks_gradient(self)}
        return (PlanEntry(name, True, spelling(self), tuple(what for what, is_asked in asked.items() if is_asked)),)


class AbstractShading(AbstractBSDF):
    """Local shading: how a surface reflects light."""

    ambient_share, surface_share = Renamed("ambient_reflectance"), Renamed("surface_weight")
    gloss = Renamed("specular_lobe")

    @property
    def needs_gradient(self) -> bool:
        return True

    @property
    def shows_lights(self) -> bool:
        return True

    def without(self, scene: Any) -> Any:
        return scene.replaced(shading=None)

    @abc.abstractmethod
    def ambient_reflectance(self) -> Scalar:
        """Reflected fraction of ambient radiance."""

    @abc.abstractmethod
    def surface_weight(self, magnitude: Scalar) -> Scalar:
        """How far a point whose gradient has this length is a surface, 0 ... 1; the rest reflects light as if it faced it."""

    @abc.abstractmethod
    def reflect(self, weight: Scalar, normal: Triple, w_o: Triple, w_i: Triple) -> tuple[Scalar, Scalar | None]:
        """Radiance towards `w_o` per irradiance from `w_i`: what the colour of the medium is multiplied with, and what is added to that
        in the colour of the light (`None` for nothing)."""


class AbstractScattering(AbstractBSDF):
    """Single scattering: how the medium scatters light."""

    share = Renamed("medium_weight")

    @property
    @abc.abstractmethod
    def needs_gradient(self) -> bool:
        """Whether `medium_weight` asks for the length of the gradient."""

    @property
    def shows_lights(self) -> bool:
        return True

    def without(self, scene: Any) -> Any:
        return scene.replaced(scattering=None)

    @abc.abstractmethod
    def medium_weight(self, magnitude: Scalar) -> Scalar:
        """How far a point whose gradient has this length is a medium and not a surface, 0 ... 1."""

    @abc.abstractmethod
    def scatter(self, w_o: Triple, w_i: Triple) -> Channels:
        """Scattered radiance per unit of optical depth and irradiance from `w_i`, `albedo p(cos theta)`; one or three channels."""

    @abc.abstractmethod
    def scatter_ambient(self) -> Channels:
        """The same per unit of a radiance that comes from everywhere."""


class AbstractSurfaces(AbstractPart):
    """Surfaces that rays meet on their way through a volume."""

    # How many of them a ray passes at most; what is behind the last is not looked for.
    most: eqx.AbstractVar[int]

    @property
    def ends_rays(self) -> bool:
        return True

    @property
    @abc.abstractmethod
    def is_opaque(self) -> bool:
        """Whether each of them ends a ray."""

    def without(self, scene: Any) -> Any:
        return scene.replaced(surfaces=None)

    @abc.abstractmethod
    def prepare(self, scene: Any, bricks: Any) -> Any:
        """What rays need to know to find them, made once for a picture, a pytree; `bricks`: bounds of the volume's bricks, or `None` where
        none are to be skipped."""

    @abc.abstractmethod
    def start(self, prepared: Any, rays: Any) -> Any:
        """The beginning of rays, as `jvr.march.first_hit.Reached`."""

    @abc.abstractmethod
    def next_hit(self, prepared: Any, rays: Any, reached: Any) -> Any:
        """Where rays meet one next, as `jvr.march.first_hit.Hits`; differentiable."""

    @abc.abstractmethod
    def leaving(self, prepared: Any, rays: Any, hits: Any, crosses: Any) -> Any:
        """The beginning of rays that start at `hits` of others: on the side that these came from, or where a ray `crosses`, on that
        behind."""

    @abc.abstractmethod
    def shown(self, medium: Any, rays: Any, hits: Any) -> tuple[Triple, Float[Array, "rays"]]:
        """Radiance towards the eye of what rays meet in a medium, under the light that reaches it, and how opaque it is; 0 where they meet
        nothing."""

    @abc.abstractmethod
    def shadowed(self, prepared: Any, scene: Any, visible: Any) -> Any:
        """What reaches points of a scene's lights past the surfaces, as `AbstractPart.visibility`, where `visible` says what does of all
        light without them."""

    @abc.abstractmethod
    def apart(self, medium: Any, rays: Any, hits: Any) -> "SurfaceLayers":
        """What `shown` is made of; anything finite where rays meet nothing."""


class SurfaceLayers(NamedTuple):
    """What is known of surfaces that rays meet: the normal, to the smaller values, the scalar, the length of its gradient, radiance towards
    the eye in the colour of the surface and in that of the light, and how much of the ambient light reaches it."""

    normal: Triple
    value: Float[Array, "rays"]
    gradient_length: Float[Array, "rays"]
    diffuse: Triple
    specular: Triple
    occlusion: Channels


class AbstractSpecular(AbstractPart):
    """How surfaces send rays on: mirrored, straight, or bent."""

    # How many times in a row a ray is sent on.
    order: eqx.AbstractVar[int]

    @property
    @abc.abstractmethod
    def bends(self) -> bool:
        """Whether what passes a surface changes its direction."""

    def without(self, scene: Any) -> Any:
        return scene.replaced(specular=None)

    @abc.abstractmethod
    def check(self, surfaces: Any) -> None:
        """**Raises** `ValueError` for surfaces that it does not go with."""

    @abc.abstractmethod
    def deflected(self, volume: Any, medium: Any, rays: Any, hits: Any) -> tuple[Float[Array, "rays"], Triple, Triple]:
        """Of rays that hit a surface in a medium, the fraction of what they bring that is mirrored, 0 where they do not, and where they
        look to in the world: mirrored, and behind the surface."""


class AbstractShadows(AbstractPart):
    """A shadow algorithm: a way to find the transmittance between lights and points."""

    prepared = Renamed("visibility")

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        casting = sum(light is not None for light in scene.shadow_casters)
        return (PlanEntry(name, True, f"{spelling(self)} for {casting} light{'s' * (casting != 1)}", ("light march",)),)

    def without(self, scene: Any) -> Any:
        return scene.replaced(shadows=None)

    @abc.abstractmethod
    def visibility(self, scene: Any, path: Any) -> Any:
        """That of the scene's lights, as `AbstractPart.visibility`."""


class AbstractMaterial(AbstractBSDF):
    """A material: how a point sends light from all directions to the eye."""

    @property
    def shows_environment(self) -> bool:
        return True

    @property
    @abc.abstractmethod
    def needs_gradient(self) -> bool:
        """Whether what is reflected depends on a normal."""

    @abc.abstractmethod
    def projected(self, order: int) -> Any:
        """The same as a `jvr.HarmonicMaterial`, of this order unless it has been projected before."""


class AbstractBleeding(eqx.Module):
    """Colour bleeding: what rays of a radiance transfer pick up on their way."""

    # Whether that is what the material of the scene reflects, so that another one needs a new projection.
    reads_material: ClassVar[bool]


class AbstractPrecomputable(AbstractPart):
    """A part that is computed at the nodes of a grid, in each picture or once beforehand (`jvr.precompute`).

    What was computed beforehand is a constant. It knows by checksums what of a scene it was made of, and a scene of other numbers is
    refused until it is made anew or `pinned()`.
    """

    # What has been computed beforehand, or `None`: a module whose first leaf is an array that every picture reads, with the `cache_key` of
    # what it was made of, and whether it is `pinned`.
    projected: eqx.AbstractVar[Any]
    # What it needs of the others, for plans.
    needs: ClassVar[tuple[str, ...]]

    @property
    def is_frozen(self) -> bool:
        """Whether it has been computed beforehand, so that it does not follow the scene."""
        return self.projected is not None

    @property
    def is_final(self) -> bool:
        """Whether a picture has nothing left to do but to read it."""
        return self.is_frozen and not self.reads_transfer

    @property
    def reads_transfer(self) -> bool:
        """Whether each picture sees what was computed beforehand by the transfer function of its scene."""
        return False

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        made = "computed beforehand" if self.is_frozen else "computed in each picture: jvr.precompute"
        return (PlanEntry(name, True, f"{spelling(self)}, {made}", self.needs),)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        yield from self.stale(scene)

    def turned(self, knob: str, value: Any) -> Any:
        return self.rebuilt(**{knob: value})

    def rebuilt(self, **choices: Any) -> Any:
        """The same with other choices, and with what was computed beforehand."""
        same = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "projected"}
        changed = type(self)(**(same | choices))
        return changed if self.projected is None else changed.with_projected(self.projected)

    @abc.abstractmethod
    def projection(self, scene: Any, path: Any) -> Any:
        """All that is needed to compute it, a pytree: `active()`, a mask of nodes that are worth it; `nodes(index)`, what some of them are;
        `all_nodes()`, what all are. `path`: as of `visibility`."""

    @abc.abstractmethod
    def finished(self, scene: Any, projection: Any, *nodes: Any) -> Any:
        """What `with_projected` takes, from what all nodes of the scene's projection are."""

    @abc.abstractmethod
    def sources(self, scene: Any) -> Any:
        """The parts of a scene that it is computed from."""

    @property
    @abc.abstractmethod
    def stale_message(self) -> str:
        """What to say where it was computed for another scene."""

    def with_projected(self, projected: Any) -> Any:
        """The same, computed beforehand."""
        return eqx.tree_at(lambda part: part.projected, self, projected, is_leaf=lambda x: x is None)

    def pinned(self) -> Any:
        """The same, to be taken as it is whatever becomes of the scene that it was computed for."""
        return self if self.projected is None else self.with_projected(dataclasses.replace(self.projected, pinned=True))

    def cache_key(self, scene: Any) -> UInt32[Array | ndarray, "parts 2"]:
        """Checksums of all that it depends on."""
        return content(self.sources(scene))

    def stale(self, scene: Any) -> tuple[str, ...]:
        """What has to be computed again for a scene of concrete arrays, in a sentence; empty where nothing has."""
        if self.projected is None or is_same_content(self.cache_key(scene), self.projected.cache_key):
            return ()
        return (self.stale_message,)

    def checked(self, scene: Any) -> Any:
        """The same, for a scene that it has not been computed for an error: a `ValueError`, or, where that is traced, when the program
        runs. Where it is `pinned` a warning, of concrete arrays."""
        if self.projected is None:
            return self
        fits, is_pinned = is_same_content(self.cache_key(scene), self.projected.cache_key), self.projected.pinned
        if isinstance(fits, Tracer):
            if is_pinned:
                return self
            first = lambda part: jax.tree.leaves(part.projected)[0]
            return eqx.tree_at(first, self, eqx.error_if(first(self), ~fits, self.stale_message))
        if not fits and not is_pinned:
            raise ValueError(self.stale_message)
        if not fits:
            warnings.warn(self.stale_message, RuntimeWarning, stacklevel=4)
        return self


def stale_message(name: str, field: str, sources: str) -> str:
    """What to say of a part, in a field of a scene, that was computed for others of its sources."""
    return (
        f"the {name} was computed for another {sources}: call jvr.precompute(scene) again, or, to see the scene "
        f"with that of the other one, replace {field} by {field}.pinned()"
    )


class AbstractRadianceTransfer(AbstractPrecomputable):
    """Radiance transfer: how the medium around a point changes the light of the environment that reaches it."""

    # Whether samples bring the light that reaches them, and not a fraction of all of it.
    exact: eqx.AbstractVar[bool]
    # What rays pick up on their way, or `None`.
    bleeding: eqx.AbstractVar[Any]
    # Highest order of its harmonics.
    order: eqx.AbstractVar[int]
    # What scatters light between nodes, or `None`.
    scattering: eqx.AbstractVar[Any]

    outdated, made_for = Renamed("stale"), Renamed("cache_key")

    needs: ClassVar[tuple[str, ...]] = ("environment", "light march")

    def without(self, scene: Any) -> Any:
        return scene.replaced(radiance_transfer=None)

    @property
    @abc.abstractmethod
    def rays_need_gradient(self) -> bool:
        """Whether its own rays ask for gradients of what they pass."""

    @abc.abstractmethod
    def visibility(self, scene: Any, path: Any) -> Any:
        """That of the scene's environment, as `AbstractPart.visibility`."""

    @abc.abstractmethod
    def transfer_function(self, scene: Any) -> Any:
        """The transfer function that it knows: that of the scene, or of the time when it was computed."""

    @abc.abstractmethod
    def lift(self, volume: Any) -> Scalar:
        """How far above a surface, in the world, it is known what arrives."""


class AbstractOcclusion(AbstractPart):
    """Occlusion: how much of the ambient light what is near a point takes away."""

    @property
    @abc.abstractmethod
    def of_surfaces(self) -> bool:
        """Whether it is that of isosurfaces, and not of the medium."""

    def without(self, scene: Any) -> Any:
        return scene.replaced(occlusion=None)

    @abc.abstractmethod
    def visibility(self, scene: Any, path: Any) -> Any:
        """That of the scene's ambient light, as `AbstractPart.visibility`."""


class AbstractNodeOcclusion(AbstractOcclusion, AbstractPrecomputable):
    """Occlusion by the medium, computed at the nodes of a grid."""

    needs: ClassVar[tuple[str, ...]] = ("ambient light", "short rays")

    @property
    def of_surfaces(self) -> bool:
        return False
