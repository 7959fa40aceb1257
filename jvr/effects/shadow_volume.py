"""Optical depth from the light, swept once through the volume and interpolated: shadow volumes and opacity shadow maps."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.effects.light_space import AbstractLightSpace, bilinear, depth_nodes, light_space
from jvr.march.march import AbstractVisibility, Medium
from jvr.march.steps import Point
from jvr.model.effects import AbstractShadows
from jvr.model.light import AbstractLight
from jvr.model.scene import Scene
from jvr.numerics import read_run, transformed
from jvr.types import Affine, Channels, Scalar, Triple


class ShadowVolume(AbstractShadows):
    """A volume of optical depth, swept away from the light (Behrens and Ratering 1998, in the light's own coordinates).

    **Arguments:** `resolution`: nodes of the shadow volume for each voxel along an axis, above 0. Between nodes optical depth is
    interpolated trilinearly; along the light's rays extinction is sampled about once a voxel, whatever the resolution. Shadows of what
    is smaller than a node are blurred; the error falls with the square of the resolution in smooth scenes.

    For directional and point (spot) lights. Differentiable in transfer function, voxels, lights and pose. Memory: 4 bytes for each node
    and channel of extinction.
    """

    resolution: float = eqx.field(static=True)

    def __init__(self, resolution: float | int = 1 / 3):
        if not isinstance(resolution, int | float) or not 0 < resolution <= 4:
            raise ValueError(
                f"resolution must be above 0 and at most 4 nodes for each voxel, not {resolution!r}; 1/3 is a good start"
            )
        self.resolution = float(resolution)

    def prepared(self, scene: Scene, lights: tuple[AbstractLight, ...], medium: Medium, spacing: Scalar) -> AbstractVisibility:
        diagonal = math.sqrt(sum((n - 1) ** 2 for n in scene.volume.shape))
        nodes = max(2, math.ceil(self.resolution * diagonal))
        return depth_visibility(scene, lights, medium, nodes + 1, nodes, math.ceil(1 / self.resolution))


class OpacityShadowMap(AbstractShadows):
    """A map of rays with the optical depth at equally distant layers (Kim and Neumann 2001), linear in between.

    **Arguments:** `texels`: rays along each axis of the map; `layers`: of optical depth along each. Detail across the light is kept by the
    texels; between two layers the medium counts as homogeneous.

    For directional and point (spot) lights. Differentiable as `ShadowVolume`. Memory: `4 texels^2 (layers + 1)` bytes for each channel of
    extinction.
    """

    texels: int = eqx.field(static=True)
    layers: int = eqx.field(static=True)

    def __init__(self, texels: int = 128, layers: int = 32):
        check_size(texels, "texels", 2)
        check_size(layers, "layers", 1)
        self.texels, self.layers = texels, layers

    def prepared(self, scene: Scene, lights: tuple[AbstractLight, ...], medium: Medium, spacing: Scalar) -> AbstractVisibility:
        return depth_visibility(scene, lights, medium, self.texels, self.layers, samples_a_layer(scene, self.layers))


class DepthGrid(eqx.Module):
    """Optical depth from one light at nodes of its coordinates, equally distant in each."""

    space: AbstractLightSpace
    nodes: Float[Array, "u v nodes channels"]

    def transmittance(self, x: Triple) -> Channels:
        """At a world position, interpolated trilinearly in optical depth."""
        texels, _, nodes, channels = self.nodes.shape
        u, v, w = self.space.place(x)
        at = jnp.clip(w * (nodes - 1), 0, nodes - 1)
        low = jnp.clip(jnp.floor(at), 0, nodes - 2)
        rows, tau = self.nodes.reshape(-1, channels), [jnp.zeros_like(u)] * channels
        for texel, weight in bilinear(texels, u, v):
            below, above = read_run(rows, texel * nodes + low.astype(jnp.int32), 2)
            tau = [t + weight * (below[c] + (at - low) * (above[c] - below[c])) for c, t in enumerate(tau)]
        return tuple(jnp.exp(-t) for t in tau)


class DepthVisibility(AbstractVisibility):
    """Optical depth from each light, or `None` for those that nothing shades."""

    world_from_grid: Affine
    grids: tuple[DepthGrid | None, ...]

    def transmittances(self, points: Point, wanted: Bool[Array, "rays"], *, reverse: bool) -> tuple[Channels, ...]:
        x = transformed(self.world_from_grid, points.p)
        return tuple(() if grid is None else jax.vmap(grid.transmittance)(x) for grid in self.grids)

    @property
    def stats(self) -> None:
        return None


def depth_visibility(
    scene: Scene, lights: tuple[AbstractLight, ...], medium: Medium, texels: int, layers: int, samples: int
) -> DepthVisibility:
    """A grid of `texels^2 (layers + 1)` nodes for each light that casts shadows."""
    grids = []
    for light in lights:
        space = light_space(light, scene.volume) if light.casts_shadows else None
        grids.append(None if space is None else DepthGrid(space, depth_nodes(space, scene, medium, texels, layers, samples)))
    return DepthVisibility(scene.volume.world_from_grid, tuple(grids))


def samples_a_layer(scene: Scene, layers: int) -> int:
    """As many samples in a layer of a map as make about one for each voxel of the volume's diagonal."""
    return max(1, round(math.sqrt(sum((n - 1) ** 2 for n in scene.volume.shape)) / layers))


def check_size(value: int, name: str, least: int) -> None:
    """**Raises** `ValueError` unless `value` is a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{name} must be a whole number of at least {least}, not {value!r}")
