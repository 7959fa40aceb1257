"""Shadow rays: the transmittance between a point and a light, marched."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.effects.shadow_volume import ShadowVolume
from jvr.march.adjoint import replay_march
from jvr.march.fields import VoxelField
from jvr.march.march import Marched, MarchOptions, march
from jvr.march.medium import AbstractVisibility, LightPath, Medium
from jvr.march.steps import Point, Rays, Transmittances
from jvr.model.clipping import Clipping, Line, interval_inside
from jvr.model.effects import AbstractShadows
from jvr.model.geometry import AbstractGeometry
from jvr.model.light import AbstractDeltaLight
from jvr.model.parameters import assign, choice
from jvr.model.parts import AbstractPart, Knob, multiples
from jvr.model.ranges import POSITIVE, TRANSMITTANCE
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.numerics import smaller
from jvr.types import Channels, Scalar, Triple


class ShadowRays(AbstractShadows):
    """Shadow rays: one from every sample to every light, the reference that all other methods approximate.

    The transmittance is `exp(-tau)` with the optical depth `tau` of the same transfer function, in each of its channels, by the midpoint
    rule from the sample to the light or to where the volume (or its clipping box) ends.

    **Arguments:** `step`: length of a segment in voxels of the smallest spacing; `termination`: a shadow ray ends once its transmittance is
    at most this, which bounds the error. Empty bricks are skipped, and points without extinction get no ray in pictures.

    Differentiable in transfer function, voxels, lights and pose. Detached: number of segments and termination. Costs about as many samples
    for each sample of the picture as the light's way through the volume has steps.
    """

    step: float = choice(POSITIVE, doc="length of a step", unit="voxels of the smallest spacing", hint="1 is a good start")
    termination: float = choice(TRANSMITTANCE, doc="transmittance at which a shadow ray ends, 0 for never")

    def __init__(self, step: float | int = 1.0, *, termination: float | int = 1e-3):
        assign(self, step=step, termination=termination)

    def visibility(self, scene: Scene, path: LightPath) -> AbstractVisibility:
        options = MarchOptions(self.termination, distance=False)
        medium = path(scene.transfer.takes_gradient)
        dt = self.step * jnp.min(scene.volume.spacing)
        return RayVisibility(scene.clipping, scene.shadow_casters, medium, dt, options, scene.light_blocker)

    def knobs(self, scene: Scene) -> tuple[Knob, ...]:
        return (multiples("step", self.step, (4, 2, 1, 1 / 2), 1 / 4),)

    def coarser(self, scene: Scene) -> tuple[AbstractPart, ...]:
        return ShadowRays(2 * self.step, termination=self.termination), ShadowVolume(1.0), ShadowVolume()


class RayVisibility(AbstractVisibility):
    """Visibility by shadow rays to each light through `medium`, which emits nothing; or `None` for lights that nothing shades. `reach`: how
    far from a point the medium shades it, all of its way to the light where that is `None`; geometry always does."""

    clipping: Clipping
    lights: tuple[AbstractDeltaLight | None, ...]
    medium: Medium
    dt: Scalar
    options: MarchOptions = eqx.field(static=True)
    geometry: AbstractGeometry | None = None
    reach: Scalar | None = None

    def transmittances(self, points: Point, wanted: Bool[Array, "rays"], *, reverse: bool) -> Transmittances:
        return Transmittances(tuple(() if light is None else self._one(light, points, wanted, reverse) for light in self.lights))

    @property
    def stats(self) -> None:
        return None

    @property
    def volume(self) -> Volume:
        """What shadow rays go through."""
        assert isinstance(self.medium.field, VoxelField)
        return self.medium.field.volume

    def _one(self, light: AbstractDeltaLight, points: Point, wanted: Bool[Array, "rays"], reverse: bool) -> Channels:
        rays, blocked = self._rays(light, points, wanted)
        through = replay_march if reverse else march
        gathered: Marched = through(self.options, self.medium, rays, self.dt)
        clear = tuple(jnp.exp(-tau) for tau in gathered.tau)
        return clear if blocked is None else tuple(jnp.where(blocked, 0.0, T) for T in clear)

    def _rays(
        self, light: AbstractDeltaLight, points: Point, wanted: Bool[Array, "rays"]
    ) -> tuple[Rays, Bool[Array, "rays"] | None]:
        """From the points to a light; without length where they are not wanted, or geometry is in the way, and where that is."""
        ways = ways_to(light, self.volume, self.clipping, points.p)
        length = ways.end if self.reach is None else smaller(ways.end, self.reach)
        blocked = None if self.geometry is None else self.geometry.hit(ways.world, 0.0, 0.0, None).distance < ways.distance
        reaches = wanted & (length > 0) if blocked is None else wanted & (length > 0) & ~blocked
        keep = lambda v: tuple(jnp.where(reaches, c, 0.0) for c in v)
        return Rays(keep(points.p), keep(ways.along), jnp.where(reaches, length, 0.0)), blocked


class Ways(NamedTuple):
    """The straight ways from points to a light: where they begin and their unit directions in the world, those in grid coordinates per
    world length, the distances between which each is inside of the medium, and that of the light."""

    world: Line
    along: Triple
    begin: Float[Array, "points"]
    end: Float[Array, "points"]
    distance: Float[Array, "points"]


def ways_to(light: AbstractDeltaLight, volume: Volume, clipping: Clipping, p: Triple) -> Ways:
    """The ways from grid positions to a light that casts shadows."""
    x = volume.world_from_point(p)
    # No light that casts shadows depends on where the eye is.
    w_i, distance, _ = jax.vmap(lambda x: light.sample(x, x))(x)
    along = volume.grid_from_world(w_i, direction=True)
    begin, end = interval_inside(volume, clipping, (x, w_i), (p, along))
    return Ways((x, w_i), along, begin, smaller(end, distance), distance)
