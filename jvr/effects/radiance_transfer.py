"""Radiance transfer: how much of the light from each direction reaches a point through the medium around it (Lindemann and Ropinski 2010,
sections 4 and 4.1), projected on spherical harmonics at the nodes of a coarse grid and interpolated between them.
"""

import dataclasses
import itertools
import math
import warnings
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, UInt32

from jvr.effects.natural_light import NaturalLight
from jvr.effects.shading import share_of
from jvr.march.medium import Medium
from jvr.march.segments import classify_at
from jvr.march.steps import Point
from jvr.model.dipole import Dipole
from jvr.model.effects import AbstractRadianceTransfer
from jvr.model.harmonics.basis import basis, count
from jvr.model.kept import content
from jvr.model.light import perpendicular
from jvr.model.transfer import AbstractTransfer
from jvr.model.volume import ClippingBox, Volume
from jvr.numerics import direction_and_length, larger, one_minus_exp, ray_box, smaller
from jvr.types import Channels, Scalar, Triple

Numbers: TypeAlias = Float[Array, "..."]

# Nodes that are projected together in one program.
CHUNK = 256
# A change of transparency that is a smaller share of `RadianceTransfer.surface` is none: it moves the cone's rim by less than 1e-6.
FLAT = 1e-3
# Of such changes, those of a larger share than this have a direction.
DIRECTED = 0.1
# How far above a node of a surface rays begin, in distances between nodes: from below a cell of the grid, up its diagonal, into the open.
LIFT = 1.75
# Azimuth between one direction and the next, the golden angle.
GOLDEN = math.pi * (3 - math.sqrt(5))


class TransferBleeding(eqx.Module):
    """Rays pick up the transfer function's colour of what they pass: materials may be exchanged without a new projection."""


class MaterialBleeding(eqx.Module):
    """Rays pick up what the material reflects towards their origin, times the transfer function's colour where that tints it: a new
    material needs a new projection."""


class ProjectedTransfer(eqx.Module):
    """Radiance transfer as it was projected, for the transfer function of that time.

    - `luminance`: `(x, y, z, 1, bands)` for a transfer without colour, else `(x, y, z, 3, bands)`, or the luma alone where
    - `chroma`: `(x, y, z, 2, fewer bands)` holds orange-blue and green-purple differences (YCoCg); else `None`.
    - `solid`: `(x, y, z)`, how much of an opaque surface there is, from above 0 to 1; 0 where nothing is near and nothing was projected.
    - `facing`: `(x, y, z, 3)`, the unit vector away from the medium, shorter where that has hardly a direction.
    - `transfer`: the transfer function of that time, which the shadow of surfaces on themselves is found with.
    - `made_for`: checksums of what it was made of (`jvr.model.kept.content`).
    - `scattered`: whether the scattering pass has been made.
    - `pinned`: whether it stays as it is although the scene is another.
    """

    luminance: Float[Array, "x y z channels bands"]
    chroma: Float[Array, "x y z 2 fewer"] | None
    solid: Float[Array, "x y z"]
    facing: Float[Array, "x y z 3"]
    transfer: AbstractTransfer
    made_for: UInt32[Array, "parts 2"]
    scattered: bool = eqx.field(static=True, default=False)
    pinned: bool = eqx.field(static=True, default=False)

    @property
    def coefficients(self) -> Float[Array, "x y z channels bands"]:
        """Coefficients of each colour, or of all of them in one channel."""
        if self.chroma is None:
            return self.luminance
        luma = self.luminance[..., 0, :]
        missing = luma.shape[-1] - self.chroma.shape[-1]
        orange, green = jnp.moveaxis(jnp.pad(self.chroma, ((0, 0),) * 4 + ((0, missing),)), 3, 0)
        return jnp.stack([luma + orange - green, luma + green, luma - orange - green], axis=3)

    @property
    def nbytes(self) -> int:
        """Memory of the coefficients."""
        return sum(x.size * x.dtype.itemsize for x in (self.luminance, self.chroma, self.solid, self.facing) if x is not None)


class RadianceTransfer(AbstractRadianceTransfer):
    """Shadows, colour bleeding and scattering of light that comes from all around (`Scene(environment=...)`).

    Opacities `o` of a node's width of medium, at a node and one node further in all directions, give a surface where the material has a
    normal: with their change `m` by Sobel's weights it is one by the share `max(o) m^2 / (m^2 + surface^2)`, `solid`. Then rays begin
    above it, `1.75 solid` nodes along the normal, so that nodes below and above a surface know the same light; what the medium up to
    there takes is found at each sample (`jvr.effects.own_shadow`). They are sent into the part of the sphere that is not below it: with
    `alpha = pi / 2 (1 - solid)`, directions within `pi / 2 + alpha` of the normal are drawn with density `1 / (2 pi (1 + sin alpha))`,
    `rays` of them on a spiral of equal areas, and what they carry is projected on harmonics. The others count as their mean.

    **Arguments:**

    - `order`: of the harmonics, 0 to 10.
    - `rays`: for each node.
    - `resolution`: nodes for each voxel along an axis, above 0 and at most 1. Nodes near which nothing is visible are left out.
    - `bleeding`: `None` (rays carry visibility), `TransferBleeding()` or `MaterialBleeding()` (front-to-back colour, and what remains of
      white light behind it).
    - `scattering`: `jvr.Dipole(...)` or `None`: each node gets the mean of what its neighbours receive, weighted with the dipole's diffuse
      reflectance; `neighbourhood`: its radius, as a share of the volume's longest side.
    - `exact`: the triple product of material, light and transfer at each sample. Without it, nodes know which share of the light arrives
      of all that a matte surface reflects that faces where the medium there does (with a material without normal: of all light), and the
      sample multiplies that with its own product of material and light. Both are the same where nothing else is in the way.
    - `chromaticity`: `None`, or the order to keep colour differences at, where rays carry colour; luminance keeps `order`.
    - `step`, `growth`: first step in voxels, and the ratio of a step to the one before; `termination`: a ray ends once its transmittance
      is at most this.
    - `surface`: see above.
    - `memory`: bytes that the coefficients may take.

    Differentiable in transfer function, voxels, material and scattering while it is not projected; then each picture does it anew.
    `jvr.precompute(scene)` does it once and keeps the result, which is then a constant: camera and light may change; what it was made of
    may not, unless it is `pinned()`. **Raises** `ValueError` for numbers outside their ranges.
    """

    order: int = eqx.field(static=True)
    rays: int = eqx.field(static=True)
    resolution: float = eqx.field(static=True)
    bleeding: TransferBleeding | MaterialBleeding | None
    scattering: Any
    neighbourhood: float = eqx.field(static=True)
    exact: bool = eqx.field(static=True)
    chromaticity: int | None = eqx.field(static=True)
    step: float = eqx.field(static=True)
    growth: float = eqx.field(static=True)
    termination: float = eqx.field(static=True)
    surface: float = eqx.field(static=True)
    memory: float = eqx.field(static=True)
    projected: ProjectedTransfer | None

    def __init__(
        self,
        order: int = 3,
        rays: int = 64,
        resolution: float | int = 1 / 3,
        *,
        bleeding: TransferBleeding | MaterialBleeding | None = None,
        scattering: Any = None,
        neighbourhood: float | int = 0.1,
        exact: bool = False,
        chromaticity: int | None = None,
        step: float | int = 1.0,
        growth: float | int = 1.1,
        termination: float | int = 0.05,
        surface: float | int = 0.1,
        memory: float | int = 2e9,
    ):
        if not isinstance(bleeding, TransferBleeding | MaterialBleeding | None):
            raise TypeError(f"bleeding must be jvr.TransferBleeding(), jvr.MaterialBleeding() or None, not {bleeding!r}")
        if not isinstance(scattering, Dipole | None):
            raise TypeError(f'scattering must be a jvr.Dipole, such as jvr.Dipole.preset("skin1"), or None, not {scattering!r}')
        whole = lambda x: isinstance(x, int) and not isinstance(x, bool)
        wrong = {
            "order must be a whole number from 0 to 10": not whole(order) or not 0 <= order <= 10,
            "rays must be a whole number of at least 1": not whole(rays) or rays < 1,
            "memory must be a positive number of bytes": not memory > 0,
            "resolution must be above 0 and at most 1 nodes for each voxel": not 0 < resolution <= 1,
            "neighbourhood must be above 0 and at most 1 of the longest side": not 0 < neighbourhood <= 1,
            "step must be above 0 and growth at least 1": not (step > 0 and growth >= 1),
            "termination must be a transmittance in [0, 1)": not 0 <= termination < 1,
            "surface must be a positive change of transparency": not surface > 0,
            "chromaticity must be None or an order up to that of the luminance, and needs bleeding": chromaticity is not None
            and (bleeding is None or not 0 <= chromaticity <= order),
        }
        for message, is_wrong in wrong.items():
            if is_wrong:
                raise ValueError(f"{message}; see the docstring of RadianceTransfer for what the defaults are")
        self.order, self.rays, self.exact, self.chromaticity = order, rays, bool(exact), chromaticity
        self.resolution, self.neighbourhood, self.memory = float(resolution), float(neighbourhood), float(memory)
        self.step, self.growth = float(step), float(growth)
        self.termination, self.surface = float(termination), float(surface)
        self.bleeding, self.scattering, self.projected = bleeding, scattering, None

    def outdated(self, scene: Any) -> tuple[str, ...]:
        if self.projected is None or not np.any(self._differs(scene)):
            return ()
        return (self._stale,)

    def checked(self, scene: Any) -> "RadianceTransfer":
        if self.projected is None:
            return self
        differs, is_pinned = self._differs(scene), self.projected.pinned
        if isinstance(differs, Tracer):
            if is_pinned:
                return self
            proven = eqx.error_if(self.projected.luminance, differs, self._stale)
            return eqx.tree_at(lambda t: t.projected.luminance, self, proven)
        if differs and not is_pinned:
            raise ValueError(self._stale)
        if differs:
            warnings.warn(self._stale, RuntimeWarning, stacklevel=4)
        return self

    def pinned(self) -> "RadianceTransfer":
        return self if self.projected is None else self.with_projected(dataclasses.replace(self.projected, pinned=True))

    @property
    def _stale(self) -> str:
        what = ("transfer function", "volume", "clipping box", *(["material"] if self.needs_gradient else []), "or dipole")
        return (
            f"the radiance transfer was computed for another {', '.join(what)}: call jvr.precompute(scene) again, or, to see the scene "
            "with that of the other one, replace radiance_transfer by radiance_transfer.pinned()"
        )

    def _differs(self, scene: Any) -> Any:
        """Whether it was computed for another scene: a `bool`, or a traced one."""
        assert self.projected is not None
        now, then = self.made_for(scene), self.projected.made_for
        if now.shape != then.shape:
            return True
        if isinstance(now, Tracer) or isinstance(then, Tracer):
            return jnp.any(now != then)
        return bool(np.any(np.asarray(now) != np.asarray(then)))

    def coarser(self) -> tuple[AbstractRadianceTransfer, ...]:
        # Of what has been computed beforehand nothing can be saved but the exact product.
        if self.exact:
            return (_changed(self, exact=False),)
        return (
            ()
            if self.is_frozen
            else (_changed(self, resolution=self.resolution / 2), _changed(self, rays=max(self.rays // 2, 1)))
        )

    def with_projected(self, projected: ProjectedTransfer) -> "RadianceTransfer":
        """The same, computed beforehand."""
        return eqx.tree_at(lambda t: t.projected, self, projected, is_leaf=lambda x: x is None)

    @property
    def needs_gradient(self) -> bool:
        return isinstance(self.bleeding, MaterialBleeding)

    @property
    def is_frozen(self) -> bool:
        return self.projected is not None

    def transfer_function(self, scene: Any) -> AbstractTransfer:
        return scene.transfer if self.projected is None else self.projected.transfer

    @property
    def is_final(self) -> bool:
        return self.projected is not None and (self.scattering is None or self.projected.scattered)

    def shape(self, volume: Volume) -> tuple[int, int, int]:
        """Nodes along each axis."""
        x, y, z = (1 if n == 1 else max(2, math.ceil((n - 1) * self.resolution) + 1) for n in volume.shape)
        return x, y, z

    def node_width(self, volume: Volume) -> Scalar:
        """The least distance of two nodes, in the world."""
        return jnp.min(volume.spacing) / self.resolution

    def lift(self, volume: Volume) -> Scalar:
        return LIFT * self.node_width(volume)

    def check_memory(self, volume: Volume, transfer: AbstractTransfer) -> None:
        """**Raises** `ValueError` where the coefficients of all nodes would exceed `memory`."""
        extinctions = len(jax.eval_shape(transfer.evaluate, volume.intercept, volume.intercept).sigma_t)
        channels = extinctions if self.bleeding is None and self.scattering is None else 3
        needed = volume.slope.dtype.itemsize * math.prod(self.shape(volume)) * (channels * count(self.order) + 4)
        if needed > self.memory:
            fits = self.resolution * (self.memory / needed) ** (1 / 3)
            raise ValueError(
                f"radiance transfer would take {needed / 1e9:.2g} GB, more than memory={self.memory:.2g} bytes: "
                f"a resolution of {fits:.2f} fits, or raise memory"
            )

    def made_for(self, scene: Any) -> UInt32[Array | np.ndarray, "parts 2"]:
        """Checksums of all that a projection depends on."""
        volume = scene.volume
        parts = [volume.values, volume.gaps, volume.slope, volume.intercept, volume.world_from_grid, volume.interpolation]
        parts += [scene.transfer, scene.clipping, scene.normals if self.needs_gradient or scene.transfer.takes_gradient else None]
        parts.append(scene.material if self.needs_gradient else None)
        # Above a surface rays begin in front of it.
        parts.append(np.array([scene.material is not None and scene.material.needs_gradient]))
        is_scattered = self.scattering is not None and (self.projected is None or self.projected.scattered)
        return content((parts, self.scattering if is_scattered else None))

    def boundaries(self, shape: tuple[int, int, int]) -> np.ndarray:
        """Ends of the steps of a ray, as shares of the volume's diameter."""
        across = max(math.sqrt(sum((n - 1) ** 2 for n in shape)), 1.0)
        ends = [0.0]
        while ends[-1] < across:
            ends.append(ends[-1] + self.step * self.growth ** (len(ends) - 1))
        return np.minimum(np.array(ends), across) / across


def _changed(transfer: RadianceTransfer, **settings: Any) -> RadianceTransfer:
    """The same with other settings."""
    same = {f.name: getattr(transfer, f.name) for f in dataclasses.fields(transfer) if f.name != "projected"}
    changed = RadianceTransfer(**(same | settings))
    return changed if transfer.projected is None else changed.with_projected(transfer.projected)


class Cone(NamedTuple):
    """The part of the sphere that rays of a node are sent into: unit axis in the world, and `sin alpha`."""

    axis: Triple
    sine: Numbers


def node_positions(volume: Volume, shape: tuple[int, int, int]) -> np.ndarray:
    """Grid positions of the nodes, `(nodes, 3)`: equally distant, the first and the last at the border."""
    axes = [np.linspace(0, n - 1, m) if n > 1 else np.zeros(1) for n, m in zip(volume.shape, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


def project_nodes(
    transfer: RadianceTransfer,
    volume: Volume,
    clipping: ClippingBox | None,
    medium: Medium,
    albedo: NaturalLight | None,
    surfaces: bool,
    p: Float[Array, "nodes 3"],
) -> tuple[Float[Array, "nodes channels bands"], Float[Array, "nodes 4"]]:
    """Coefficients of the radiance transfer at grid positions, and beside each other `solid` and `facing` of `ProjectedTransfer`.

    **Arguments:** `medium`: what rays pass; `albedo`: where they pick up the material's colour, that under light of one from everywhere;
    `surfaces`: whether the material has a normal, so that light from below it does not count.
    """
    nodes = tuple(p.T.astype(volume.slope.dtype))
    around = _surroundings(transfer, volume, medium, nodes)
    strength = around.solid * around.strength if surfaces else jnp.zeros_like(around.strength)
    cone = Cone(around.axis, jnp.sin(0.5 * math.pi * (1 - strength)))
    directions = _spread(cone, transfer.rays)
    wide = lambda c: jnp.broadcast_to(c[:, None], (c.shape[0], transfer.rays)).ravel()
    along = tuple(d.ravel() for d in directions)
    lift = volume.grid_from_world(tuple(strength * transfer.lift(volume) * c for c in around.axis), direction=True)
    origins = tuple(c + d for c, d in zip(nodes, lift, strict=True))
    rays = _rays(volume, clipping, tuple(map(wide, origins)), along)
    carried = _carried(transfer, volume, medium, albedo, rays)
    functions = jnp.stack(basis(transfer.order, directions), axis=-1)
    # Each sample counts by the inverse of its density, 2 pi (1 + sin alpha). Directions without rays count as the mean of those with: no
    # light of theirs is reflected, and a step at the horizon would ring. What is the same from everywhere has no error of the quadrature.
    weight = 2 * math.pi * (1 + cone.sine) / transfer.rays
    values = jnp.stack([c.reshape(p.shape[0], transfer.rays) for c in carried], axis=1)
    mean = jnp.mean(values, axis=-1)
    rest = jnp.einsum("ncr,nrb->ncb", values - mean[..., None], functions) * weight[:, None, None]
    coefficients = rest.at[..., 0].add(math.sqrt(4 * math.pi) * mean)
    # Not zero, which says that nothing was projected.
    solid = jnp.maximum(strength, jnp.finfo(strength.dtype).tiny)
    return coefficients, jnp.stack([solid, *(around.directed * c for c in around.axis)], axis=-1)


class Surroundings(NamedTuple):
    """Transparency of a node's width of medium at a node; how much of a surface there is, from 0 to 1, and the unit vector away from the
    medium."""

    solid: Numbers
    strength: Numbers
    directed: Numbers
    axis: Triple


def _surroundings(transfer: RadianceTransfer, volume: Volume, medium: Medium, p: Triple) -> Surroundings:
    """From the opacity of a node's width of medium at the node and one node further in all 26 directions, by Sobel's weights: both the
    nodes below a surface and those above it know where it faces."""
    width = transfer.node_width(volume)
    lower, upper = volume.domain
    sides = [(-1, 0, 1) if n > 1 else (0,) for n in volume.shape]
    offsets = np.array(list(itertools.product(*sides)), np.float32)
    weights = np.prod(np.where(offsets == 0, 2.0, 1.0), axis=1)
    step = 1 / transfer.resolution
    at = [jnp.clip(c[:, None] + step * o, low, high) for c, o, low, high in zip(p, offsets.T, lower, upper, strict=True)]
    flat = tuple(c.ravel() for c in at)
    sigma_t = classify_at(medium, _points(flat, flat), jnp.ones(flat[0].shape, bool))[0].sigma_t
    tau = (width * sum(sigma_t[1:], sigma_t[0]) / len(sigma_t)).reshape(p[0].shape[0], -1)
    # Not 1 less the transparency: thin media keep their digits.
    opacity = one_minus_exp(tau)
    differences = []
    for axis, n in enumerate(volume.shape):
        ahead, behind = (weights * (offsets[:, axis] == side) for side in (1, -1))
        if n == 1:
            differences.append(jnp.zeros_like(p[0]))
            continue
        span = jnp.clip(p[axis] + step, 0, n - 1) - jnp.clip(p[axis] - step, 0, n - 1)
        change = opacity @ jnp.asarray((behind - ahead) / ahead.sum(), opacity.dtype)
        differences.append(change / span)
    inverse = volume.axes_inverse
    gradient = tuple(sum((inverse[j, i] * differences[j] for j in range(3)), jnp.zeros_like(p[0])) for i in range(3))
    axis, length = direction_and_length(gradient)
    # Without a surface the axis only turns the spiral; inside of an opaque medium a gradient would be made of roundings.
    flat_there = length * width <= FLAT * transfer.surface
    axis = tuple(jnp.where(flat_there, fixed, c) for fixed, c in zip((0.0, 0.0, 1.0), axis, strict=True))
    strength = share_of(2 * length * width, jnp.asarray(transfer.surface, length.dtype))
    directed = share_of(2 * length * width, jnp.asarray(DIRECTED * transfer.surface, length.dtype))
    strength, directed = (jnp.where(flat_there, 0.0, x) for x in (strength, directed))
    return Surroundings(jnp.max(opacity, axis=1), strength, directed, axis)


def _spread(cone: Cone, rays: int) -> Triple:
    """Unit directions `(nodes, rays)`, on a spiral of equal areas about each cone's axis."""
    index = jnp.arange(rays, dtype=cone.sine.dtype)
    cosine = 1 - (1 + cone.sine[:, None]) * (index + 0.5) / rays
    sine = jnp.sqrt(jnp.maximum((1 - cosine) * (1 + cosine), 0.0))
    a, b = perpendicular(cone.axis)
    u, v = sine * jnp.cos(GOLDEN * index), sine * jnp.sin(GOLDEN * index)
    return tuple(u * a[i][:, None] + v * b[i][:, None] + cosine * cone.axis[i][:, None] for i in range(3))


class _Rays(NamedTuple):
    """Rays from nodes: grid position, direction in the world and in the grid, and the distances between which there is a medium."""

    p: Triple
    direction: Triple
    along: Triple
    t_in: Numbers
    t_out: Numbers


def _rays(volume: Volume, clipping: ClippingBox | None, p: Triple, direction: Triple) -> _Rays:
    along = volume.grid_from_world(direction, direction=True)
    t_in, t_out = ray_box(p, along, *volume.domain)
    if clipping is not None:
        near, far = ray_box(volume.world_from_point(p), direction, tuple(clipping.lower), tuple(clipping.upper))
        t_in, t_out = larger(t_in, near), smaller(t_out, far)
    t_in = larger(t_in, 0.0)
    hit = t_out > t_in
    return _Rays(p, direction, along, jnp.where(hit, t_in, 0.0), jnp.where(hit, t_out, 0.0))


def _carried(transfer: RadianceTransfer, volume: Volume, medium: Medium, albedo: NaturalLight | None, rays: _Rays) -> Channels:
    """What rays carry from far away to grid positions: transmittance, or with bleeding white light behind the colours of what they pass."""
    ends = jnp.asarray(transfer.boundaries(volume.shape), rays.t_out.dtype) * 2 * volume.radius
    opaque = -math.log(transfer.termination) if transfer.termination > 0 else math.inf
    lower, upper = volume.domain
    toward_origin = tuple(-d for d in rays.direction)

    def one_step(state: tuple[Channels, Channels], ends: tuple[Numbers, Numbers]) -> tuple[Channels, Channels]:
        tau, colour = state
        begin, end = (smaller(larger(rays.t_in, e), rays.t_out) for e in ends)
        middle = 0.5 * (begin + end)
        # By a rounding the middle may be outside, where nothing may be read.
        at = tuple(jnp.clip(c + middle * d, a, b) for c, d, a, b in zip(rays.p, rays.along, lower, upper, strict=True))
        inside = (end > begin) & (_least(tau) < opaque)
        medium_there, sample = classify_at(medium, _points(at, rays.along), inside)
        dtau = tuple(jnp.where(inside, sigma * (end - begin), 0.0) for sigma in medium_there.sigma_t)
        if colour:
            rgb = _colour(medium_there.rgb, sample, albedo, toward_origin)
            before = [jnp.exp(-t) for t in tau] * (3 // len(tau))
            thick = dtau * (3 // len(dtau))
            colour = tuple(c - T * jnp.expm1(-d) * e for c, T, d, e in zip(colour, before, thick, rgb, strict=True))
        return tuple(t + d for t, d in zip(tau, dtau, strict=True)), colour

    # Checkpointed: the way back computes a step again rather than keep all of its voxels.
    @jax.checkpoint
    def step(state: tuple[Channels, Channels], ends: tuple[Numbers, Numbers]) -> tuple[tuple[Channels, Channels], None]:
        alive = (ends[0] < rays.t_out) & (ends[1] > rays.t_in) & (_least(state[0]) < opaque)
        return jax.lax.cond(jnp.any(alive), lambda s: one_step(s, ends), lambda s: s, state), None

    zero = jnp.zeros_like(rays.t_out)
    channels = len(jax.eval_shape(lambda: classify_at(medium, _points(rays.p, rays.along), zero > 0)[0].sigma_t))
    state = ((zero,) * channels, () if transfer.bleeding is None else (zero,) * 3)
    (tau, colour), _ = jax.lax.scan(step, state, (ends[:-1], ends[1:]))
    clear = tuple(jnp.exp(-t) for t in tau)
    return tuple(c + T for c, T in zip(colour, clear * (3 // channels), strict=True)) if colour else clear


def _colour(rgb: Triple, sample: Any, albedo: NaturalLight | None, w_o: Triple) -> Triple:
    """What a ray picks up of a sample: the colour of the transfer function, or what the material reflects of light from everywhere."""
    if albedo is None:
        return rgb

    def one(s: Numbers, gradient: Triple, w_o: Triple) -> tuple[Triple, Triple]:
        normal, magnitude = direction_and_length(tuple(-g for g in gradient))
        return albedo.reflect(s, magnitude, normal, w_o, ())

    # A material without a normal asks for no gradient.
    gradient = sample.gradient or (jnp.zeros_like(sample.s),) * 3
    tinted, plain = jax.vmap(one)(sample.s, gradient, w_o)
    return tuple(c * a + b for c, a, b in zip(rgb, tinted, plain, strict=True))


def _least(tau: Channels) -> Numbers:
    """Optical depth of the clearest channel."""
    least = tau[0]
    for t in tau[1:]:
        least = jnp.minimum(least, t)
    return least


def _points(p: Triple, along: Triple) -> Point:
    return Point(p, along, *(jnp.zeros_like(p[0], jnp.int32),) * 2)
