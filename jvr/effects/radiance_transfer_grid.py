"""Radiance transfer at every sample: projected at nodes, multiplied with the light there, interpolated."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.effects.environment_lighting import EnvironmentLighting, albedo_of
from jvr.effects.grid import Grid
from jvr.effects.nodes import AbstractProjection, seen_around
from jvr.effects.projected_radiance_transfer import ProjectedRadianceTransfer
from jvr.effects.radiance_transfer import RadianceTransfer
from jvr.effects.radiance_transfer_nodes import project_nodes
from jvr.execution.devices import over_rays, shares
from jvr.march.medium import AbstractVisibility, Medium
from jvr.march.steps import Point, Transmittances
from jvr.model.clipping import Clipping
from jvr.model.grids import Shape, nodes_for_each_voxel
from jvr.model.harmonics.algebra import product_matrix
from jvr.model.harmonics.basis import band_of, basis
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.numerics import direction_and_length, divide_or_zero

# Weight of the environment lighting beside that which a surface faces.
DARK = 0.005


class RadianceTransferVisibility(AbstractVisibility):
    """What arrives of the environment: the fraction of it in each colour, or the coefficients of what arrives, all colours of the first,
    then of the next; beside them, where surfaces shadow themselves, how much of one there is."""

    grid: Grid
    scale: tuple[float, float, float] = eqx.field(static=True)

    def transmittances(self, points: Point, wanted: Bool[Array, "rays"], *, reverse: bool) -> Transmittances:
        at = tuple(c * f for c, f in zip(points.p, self.scale, strict=True))
        return Transmittances(environment=self.grid.interpolate(at, wanted))

    @property
    def stats(self) -> None:
        return None


def radiance_transfer_visibility(scene: Scene, medium: Medium) -> RadianceTransferVisibility:
    """How much of the environment reaches each sample of a scene. `medium`: what rays pass."""
    radiance_transfer, environment = radiance_transfer_of(scene), scene.environment_light
    assert environment is not None
    assert scene.material is not None
    material = scene.material
    projected = radiance_transfer.projected
    if projected is None:
        projected = finished(scene, *RadianceTransferProjection.of(scene, medium).all_nodes())
    elif radiance_transfer.scattering is not None and not projected.scattered:
        projected = scattered(scene, projected)
    coefficients, light = projected.coefficients, environment.coefficients
    if radiance_transfer.exact:
        order = material.projected(scene.material_order).order
        incident = _over_nodes(lambda light, nodes: _products(nodes, light, order), light, coefficients)
    else:
        incident = _over_nodes(
            lambda light, nodes: _fractions(nodes[0], nodes[1], light), light, (projected.facing, coefficients)
        )
    if material.needs_gradient:
        incident = jnp.concatenate([incident, projected.solid[..., None]], axis=-1)
    x, y, z = coefficients.shape[:3]
    return RadianceTransferVisibility(Grid.of(incident), nodes_for_each_voxel(scene.volume, (x, y, z)))


def radiance_transfer_of(scene: Scene) -> RadianceTransfer:
    """The radiance transfer of a scene that has one."""
    assert isinstance(scene.radiance_transfer, RadianceTransfer)
    return scene.radiance_transfer


def projected_of(scene: Scene) -> ProjectedRadianceTransfer:
    """The radiance transfer of a scene that it has been computed for."""
    projected = radiance_transfer_of(scene).projected
    assert projected is not None
    return projected


class RadianceTransferProjection(AbstractProjection):
    """All that the nodes of a scene are projected with. `albedo`: what a material reflects of light of one from everywhere, where rays
    pick that up; `surfaces`: whether the material has a normal."""

    radiance_transfer: RadianceTransfer
    volume: Volume
    clipping: Clipping
    medium: Medium
    albedo: EnvironmentLighting | None
    surfaces: bool = eqx.field(static=True)

    @classmethod
    def of(cls, scene: Scene, medium: Medium) -> "RadianceTransferProjection":
        """`medium`: what the scene's rays of light pass."""
        radiance_transfer = radiance_transfer_of(scene)
        radiance_transfer.check_memory(scene.volume, scene.transfer)
        assert scene.material is not None
        return cls(
            radiance_transfer=radiance_transfer,
            volume=scene.volume,
            clipping=scene.clipping,
            medium=seen_around(scene, medium),
            albedo=albedo_of(scene),
            surfaces=scene.material.needs_gradient,
        )

    @property
    def shape(self) -> Shape:
        return self.radiance_transfer.shape(self.volume)

    def project(self, p: Float[Array, "nodes 3"]) -> tuple[Float[Array, "nodes channels bands"], Float[Array, "nodes 4"]]:
        """The radiance transfer at grid positions."""
        return project_nodes(self.radiance_transfer, self.volume, self.clipping, self.medium, self.albedo, self.surfaces, p)


def finished(
    scene: Scene, coefficients: Float[Array, "nodes channels bands"], around: Float[Array, "nodes 4"]
) -> ProjectedRadianceTransfer:
    """What was projected, scattered and with its colour differences apart where the scene asks for that."""
    radiance_transfer = radiance_transfer_of(scene)
    shape = radiance_transfer.shape(scene.volume)
    cache_key = jnp.asarray(radiance_transfer.cache_key(scene))
    grid, around = coefficients.reshape(*shape, *coefficients.shape[1:]), around.reshape(*shape, 4)
    projected = ProjectedRadianceTransfer(grid, None, around[..., 0], around[..., 1:], scene.transfer, cache_key)
    projected = projected if radiance_transfer.scattering is None else scattered(scene, projected)
    return projected if radiance_transfer.chromaticity is None else projected.separated(radiance_transfer.chromaticity)


def scattered(scene: Scene, projected: ProjectedRadianceTransfer) -> ProjectedRadianceTransfer:
    """The radiance transfer after the scattering pass."""
    from jvr.effects.diffusion import scatter

    radiance_transfer = radiance_transfer_of(scene)
    assert radiance_transfer.scattering is not None
    there = projected.solid > 0
    coefficients = scatter(
        radiance_transfer.scattering, radiance_transfer.neighbourhood, scene.volume, projected.coefficients, there
    )
    return dataclasses.replace(projected, luminance=coefficients, chroma=None, scattered=True)


def _over_nodes(
    function: Callable[[Array, Any], Array], light: Float[Array, "others 3"], grids: Any
) -> Float[Array, "x y z products"]:
    """`function` of the light and what nodes hold, each device with its own share of them."""
    x, y, z = jax.tree.leaves(grids)[0].shape[:3]
    fill = -(x * y * z) % shares()

    def flat(grid: Array) -> Array:
        rows = grid.reshape(x * y * z, *grid.shape[3:])
        return jnp.pad(rows, ((0, fill), *[(0, 0)] * (rows.ndim - 1))) if fill else rows

    return over_rays(function, light, jax.tree.map(flat, grids))[: x * y * z].reshape(x, y, z, -1)


def _fractions(
    facing: Float[Array, "nodes 3"], coefficients: Float[Array, "nodes channels bands"], light: Float[Array, "others 3"]
) -> Float[Array, "nodes 3"]:
    """The fraction of each colour of the light that arrives, of all that a diffuse surface would reflect that faces where the node does; 0
    where there is no light."""
    matrix = product_matrix(light, math.isqrt(coefficients.shape[-1]) - 1, 2)
    flat = [coefficients[:, c].T for c in range(coefficients.shape[1])]
    normal, length = direction_and_length(tuple(facing.T))
    # A cosine over pi: band l of its coefficients is A_l / pi Y_lm(n). Without a direction all count alike.
    kernel = [1.0, *(length * k for k in (2 / 3, 1 / 4))]
    functions = [y * kernel[band] for y, band in zip(basis(2, normal), band_of(2), strict=True)]
    full = jnp.pad(light, ((0, max(9 - light.shape[0], 0)), (0, 0)))[:9]
    fractions = []
    for colour in range(3):
        # Numbers of a node far from each other and those of all nodes side by side: one loop for all that follows.
        incident = matrix[..., colour] @ flat[colour % len(flat)]
        own, whole = (sum(y * v[i] for i, y in enumerate(functions)) for v in (incident, full[:, colour]))
        # Where a surface faces no light the fraction is that of all light.
        own, whole = (jnp.maximum(v, 0.0) + DARK * jnp.maximum(r[0], 0.0) for v, r in ((own, incident), (whole, full[:, colour])))
        fractions.append(divide_or_zero(own, whole))
    return jnp.stack(fractions, axis=-1)


def _products(
    coefficients: Float[Array, "nodes channels bands"], light: Float[Array, "others 3"], order: int
) -> Float[Array, "nodes products"]:
    """Coefficients of light times radiance transfer up to an order, all colours of each."""
    matrix = product_matrix(light, math.isqrt(coefficients.shape[-1]) - 1, order)
    kinds = "ncb,obc->noc" if coefficients.shape[1] == 3 else "ncb,obh->noh"
    products = jnp.einsum(kinds, coefficients, matrix)
    return products.reshape(products.shape[0], -1)
