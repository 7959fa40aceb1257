"""Radiance transfer: how much of the light from each direction reaches a point through the medium around it (Lindemann and Ropinski 2010,
sections 4 and 4.1). Here is what of it a scene chooses; `jvr.effects.radiance_transfer_nodes` projects it on spherical harmonics at the
nodes of a coarse grid, `jvr.effects.projected_radiance_transfer` is the result, and `jvr.effects.radiance_transfer_grid` interpolates it
between nodes.
"""

import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jvr.effects.projected_radiance_transfer import ProjectedRadianceTransfer
from jvr.march.medium import AbstractVisibility, LightPath, Medium
from jvr.model.dipole import Dipole
from jvr.model.effects import AbstractBleeding, AbstractRadianceTransfer, stale_message
from jvr.model.grids import node_shape
from jvr.model.harmonics.basis import count
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import AbstractPart, Knob, multiples
from jvr.model.ranges import AT_LEAST_ONE, POSITIVE, TRANSMITTANCE, Interval
from jvr.model.transfer import AbstractTransfer
from jvr.model.volume import Volume
from jvr.types import Scalar

# How far above a node of a surface rays begin, in distances between nodes: from below a cell of the grid, up its diagonal, into the open.
LIFT = 1.75

ORDER = Interval(0.0, 10.0)
SHARE = Interval(0.0, 1.0, "(]")


class TransferBleeding(AbstractBleeding):
    """Colour bleeding of the transfer function's colours, which rays pick up of what they pass: materials may be exchanged without a new
    projection."""

    reads_material: ClassVar[bool] = False


class MaterialBleeding(AbstractBleeding):
    """Colour bleeding of what the material reflects towards the origin of a ray, times the transfer function's colour where that tints
    it: a new material needs a new projection."""

    reads_material: ClassVar[bool] = True


class RadianceTransfer(AbstractRadianceTransfer):
    """Shadows, colour bleeding and scattering of environment lighting (`Scene(environment=...)`).

    Opacities `o` of a node's width of medium, at a node and one node further in all directions, give a surface where the material has a
    normal: with their change `m` by Sobel's weights it is one by the weight `max(o) m^2 / (m^2 + surface^2)`, `solid`. Then rays begin
    above it, `1.75 solid` nodes along the normal, so that nodes below and above a surface know the same light; what the medium up to
    there takes is found at each sample (`jvr.effects.self_shadow`). They are sent into the part of the sphere that is not below it: with
    `alpha = pi / 2 (1 - solid)`, directions within `pi / 2 + alpha` of the normal are drawn with density `1 / (2 pi (1 + sin alpha))`,
    `rays` of them on a spiral of equal areas, and what they carry is projected on harmonics. The others count as their mean.

    **Arguments:**

    - `order`: of the harmonics, 0 to 10.
    - `rays`: for each node.
    - `resolution`: nodes for each voxel along an axis, above 0 and at most 1. Nodes near which nothing is visible are left out.
    - `bleeding`: `None` (rays carry visibility), `TransferBleeding()` or `MaterialBleeding()` (front-to-back colour, and what remains of
      white light behind it).
    - `scattering`: `jvr.Dipole(...)` or `None`: each node gets the mean of what its neighbours receive, weighted with the dipole's diffuse
      reflectance; `neighbourhood`: its radius, as a fraction of the volume's longest side.
    - `exact`: the triple product of material, light and radiance transfer at each sample. Without it, nodes know which fraction of the
      light arrives of all that a diffuse surface reflects that faces where the medium there does (with a material without normal: of all
      light), and the sample multiplies that with its own product of material and light. Both are the same where nothing else is in the way.
    - `chromaticity`: `None`, or the order to keep colour differences at, where rays carry colour; luminance keeps `order`.
    - `step`, `growth`: first step in voxels, and the ratio of a step to the one before; `termination`: a ray ends once its transmittance
      is at most this.
    - `surface`: see above.
    - `memory`: bytes that the coefficients may take.

    Differentiable in transfer function, voxels, material and scattering while it is not projected; then each picture does it anew.
    `jvr.precompute(scene)` does it once and keeps the result, which is then a constant: camera and light may change; what it was made of
    may not, unless it is `pinned()`. **Raises** `ValueError` for numbers outside their ranges.
    """

    order: int = choice(ORDER, doc="order of the harmonics")
    rays: int = choice(AT_LEAST_ONE, doc="rays for each node")
    resolution: float = choice(SHARE, doc="nodes for each voxel along an axis")
    bleeding: AbstractBleeding | None = parameter(doc="jvr.TransferBleeding(), jvr.MaterialBleeding() or None")
    scattering: Dipole | None = parameter(doc='a jvr.Dipole, such as jvr.Dipole.preset("skin1"), or None')
    neighbourhood: float = choice(SHARE, doc="radius as a share of the longest side")
    exact: bool = choice(doc="whether samples take the triple product")
    chromaticity: int | None = choice(ORDER, doc="order of colour differences")
    step: float = choice(POSITIVE, doc="first step", unit="voxels")
    growth: float = choice(AT_LEAST_ONE, doc="ratio of a step to the one before")
    termination: float = choice(TRANSMITTANCE, doc="transmittance at which a ray ends, 0 for never")
    surface: float = choice(POSITIVE, doc="change of transparency between nodes")
    memory: float = choice(POSITIVE, doc="that coefficients may take", unit="bytes")
    projected: ProjectedRadianceTransfer | None = parameter(doc="what has been computed beforehand")

    def __init__(
        self,
        order: int = 3,
        rays: int = 64,
        resolution: float | int = 1 / 3,
        *,
        bleeding: AbstractBleeding | None = None,
        scattering: Dipole | None = None,
        neighbourhood: float | int = 0.1,
        exact: bool = False,
        chromaticity: int | None = None,
        step: float | int = 1.0,
        growth: float | int = 1.1,
        termination: float | int = 0.05,
        surface: float | int = 0.1,
        memory: float | int = 2e9,
    ):
        assign(self, order=order, rays=rays, resolution=resolution, bleeding=bleeding, scattering=scattering)
        assign(self, neighbourhood=neighbourhood, exact=exact, chromaticity=chromaticity, step=step, growth=growth)
        assign(self, termination=termination, surface=surface, memory=memory)
        if chromaticity is not None and (bleeding is None or chromaticity > order):
            raise ValueError("chromaticity must be None or an order up to that of the luminance, and needs bleeding")
        self.projected = None

    @property
    def stale_message(self) -> str:
        what = ("transfer function", "volume", "clipping box", *(["material"] if self.rays_need_gradient else []), "dipole")
        return stale_message("radiance transfer", "radiance_transfer", ", ".join(what) + " or presence of surfaces")

    def knobs(self, scene: Any) -> tuple[Knob, ...]:
        product = (Knob("exact", (False, True), True),) if self.exact else ()
        # Of what has been computed beforehand nothing can be saved but the exact product.
        if self.is_frozen:
            return product
        return (
            Knob("order", tuple(dict.fromkeys((max(self.order - 1, 0), self.order))), min(self.order + 2, 10)),
            multiples("rays", self.rays, (1 / 4, 1 / 2, 1), 4, least=1),
            multiples("resolution", self.resolution, (1 / 2, 1), 2, most=1.0),
            *product,
        )

    def turned(self, knob: str, value: Any) -> "RadianceTransfer":
        choices = {knob: value}
        if self.chromaticity is not None and knob == "order":
            choices["chromaticity"] = min(self.chromaticity, value)
        return self.rebuilt(**choices)

    def coarser(self, scene: Any) -> tuple[AbstractPart, ...]:
        # The exact product first: what it costs hides the rest.
        return (self.turned("exact", False),) if self.exact else super().coarser(scene)

    # What computes and what reads it is imported for scenes alone that are drawn or computed beforehand.

    def visibility(self, scene: Any, path: LightPath) -> AbstractVisibility:
        from jvr.effects.radiance_transfer_grid import radiance_transfer_visibility

        return radiance_transfer_visibility(scene, self._medium(scene, path))

    def projection(self, scene: Any, path: LightPath) -> Any:
        from jvr.effects.radiance_transfer_grid import RadianceTransferProjection

        return RadianceTransferProjection.of(scene, self._medium(scene, path))

    def finished(self, scene: Any, projection: Any, *nodes: Any) -> ProjectedRadianceTransfer:
        from jvr.effects.radiance_transfer_grid import finished

        return finished(scene, *nodes)

    def _medium(self, scene: Any, path: LightPath) -> Medium:
        return path(scene.transfer.takes_gradient or self.rays_need_gradient)

    @property
    def rays_need_gradient(self) -> bool:
        return self.bleeding is not None and self.bleeding.reads_material

    def transfer_function(self, scene: Any) -> AbstractTransfer:
        return scene.transfer if self.projected is None else self.projected.transfer

    @property
    def is_final(self) -> bool:
        return self.projected is not None and (self.scattering is None or self.projected.scattered)

    def shape(self, volume: Volume) -> tuple[int, int, int]:
        """Nodes along each axis."""
        return node_shape(volume, self.resolution)

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

    def sources(self, scene: Any) -> Any:
        volume = scene.volume
        parts = [volume.values, volume.gaps, volume.slope, volume.intercept, volume.world_from_grid, volume.interpolation]
        parts += [
            scene.transfer,
            scene.clipping,
            scene.normals if self.rays_need_gradient or scene.transfer.takes_gradient else None,
        ]
        parts.append(scene.material if self.rays_need_gradient else None)
        # Above a surface rays begin in front of it.
        parts.append(np.array([scene.material is not None and scene.material.needs_gradient]))
        # Where there are surfaces, nodes away from the visible medium are projected, too.
        parts.append(np.array([scene.surfaces is not None]))
        is_scattered = self.scattering is not None and (self.projected is None or self.projected.scattered)
        return parts, self.scattering if is_scattered else None

    def boundaries(self, shape: tuple[int, int, int]) -> np.ndarray:
        """Ends of the steps of a ray, as fractions of the volume's diameter."""
        across = max(math.sqrt(sum((n - 1) ** 2 for n in shape)), 1.0)
        ends = [0.0]
        while ends[-1] < across:
            ends.append(ends[-1] + self.step * self.growth ** (len(ends) - 1))
        return np.minimum(np.array(ends), across) / across
