"""Transmittance from the light, swept once through the volume and interpolated: shadow volumes and opacity shadow maps."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jvr.effects.grid import Grid
from jvr.effects.light_space import AbstractLightSpace, depth_nodes, light_space
from jvr.march.medium import AbstractVisibility, LightPath
from jvr.march.steps import Point, Transmittances
from jvr.model.effects import AbstractShadows
from jvr.model.parameters import assign, choice
from jvr.model.parts import Knob, multiples
from jvr.model.ranges import AT_LEAST_ONE, Interval
from jvr.model.scene import Scene
from jvr.numerics import transformed
from jvr.types import Affine, Channels, Triple


def texels() -> Any:
    """The declaration of the size of a map."""
    return choice(Interval(low=2.0), doc="rays along each axis of the map")


def knobs_of_layers(texels: int, layers: int) -> tuple[Knob, ...]:
    """What can be turned of a map with layers."""
    halves = (1 / 2, 1, 2)
    return multiples("texels", texels, halves, 3, least=2), multiples("layers", layers, halves, 3, least=1)


class ShadowVolume(AbstractShadows):
    """A volume of transmittance, swept away from the light (Behrens and Ratering 1998, in the light's own coordinates).

    **Arguments:** `resolution`: nodes of the shadow volume for each voxel of the volume's diagonal, above 0. Between nodes
    transmittance is interpolated trilinearly; along the light's rays extinction is sampled every two voxels or less, whatever the
    resolution. Shadows of what is smaller than a node are blurred; the error falls with the square of the resolution in smooth scenes.

    For directional and point (spot) lights. Differentiable in transfer function, voxels, lights and pose. Memory: 4 bytes for each node
    and channel of extinction.
    """

    resolution: float = choice(Interval(0.0, 4.0, "(]"), doc="nodes for each voxel along an axis", hint="1/3 is a good start")

    def __init__(self, resolution: float | int = 1 / 3):
        assign(self, resolution=resolution)

    def visibility(self, scene: Scene, path: LightPath) -> AbstractVisibility:
        diagonal = math.sqrt(sum((n - 1) ** 2 for n in scene.volume.shape))
        nodes = max(2, math.ceil(self.resolution * diagonal))
        return depth_visibility(scene, path, nodes + 1, nodes, math.ceil(0.5 / self.resolution))

    def knobs(self, scene: Scene) -> tuple[Knob, ...]:
        return (multiples("resolution", self.resolution, (1 / 4, 1 / 2, 1, 2), 4, most=4.0),)


class OpacityShadowMap(AbstractShadows):
    """An opacity shadow map: rays with the transmittance at equally distant layers (Kim and Neumann 2001), linear in between.

    **Arguments:** `texels`: rays along each axis of the map; `layers`: of optical depth along each. Detail across the light is kept by the
    texels; between two layers transmittance is a straight line.

    For directional and point (spot) lights. Differentiable as `ShadowVolume`. Memory: `4 texels^2 layers` bytes for each channel of
    extinction.
    """

    texels: int = texels()
    layers: int = choice(AT_LEAST_ONE, doc="layers along each ray of the map")

    def __init__(self, texels: int = 128, layers: int = 32):
        assign(self, texels=texels, layers=layers)

    def visibility(self, scene: Scene, path: LightPath) -> AbstractVisibility:
        return depth_visibility(scene, path, self.texels, self.layers, samples_a_layer(scene, self.layers))

    def knobs(self, scene: Scene) -> tuple[Knob, ...]:
        return knobs_of_layers(self.texels, self.layers)


class ClearGrid(eqx.Module):
    """Transmittance between one light and nodes of its coordinates, equally distant in each."""

    space: AbstractLightSpace
    grid: Grid

    def transmittance(self, x: Triple, inside: Bool[Array, "points"]) -> Channels:
        """At a batch of world positions, trilinear. (Not optical depth: behind an opaque surface that is so large that between two nodes
        it would be opaque as well.)"""
        u, v, w = self.space.coordinates(x)
        at = tuple(c * n for c, n in zip((w, (u + 1) / 2, (v + 1) / 2), self.grid.cells, strict=True))
        return self.grid.interpolate(at, inside)


class DepthVisibility(AbstractVisibility):
    """Visibility by optical depth from each light, or `None` for those that nothing shades."""

    world_from_grid: Affine
    grids: tuple[ClearGrid | None, ...]

    def transmittances(self, points: Point, wanted: Bool[Array, "rays"], *, reverse: bool) -> Transmittances:
        x = transformed(self.world_from_grid, points.p)
        return Transmittances(tuple(() if grid is None else grid.transmittance(x, wanted) for grid in self.grids))

    @property
    def stats(self) -> None:
        return None


def depth_visibility(scene: Scene, path: LightPath, texels: int, layers: int, samples: int) -> DepthVisibility:
    """A grid of `texels^2 (layers + 1)` nodes for each light that casts shadows."""
    grids, medium = [], path(scene.transfer.takes_gradient)
    for light in scene.shadow_casters:
        space = None if light is None else light_space(light, scene.volume)
        if space is None:
            grids.append(None)
            continue
        clear = jnp.exp(-depth_nodes(space, scene, medium, texels, layers, samples))
        grids.append(ClearGrid(space, Grid.of(clear)))
    return DepthVisibility(scene.volume.world_from_grid, tuple(grids))


def samples_a_layer(scene: Scene, layers: int) -> int:
    """As many samples in a layer of a map as make about one for each voxel of the volume's diagonal."""
    return max(1, round(math.sqrt(sum((n - 1) ** 2 for n in scene.volume.shape)) / layers))
