"""Materials: how much of the light from each direction a point sends to the eye, in spherical harmonics.

A material function `M(w_o, w_i)` includes the cosine of a surface; its integral over `w_i` is the fraction that is reflected. All are
isotropic: with the normal as polar axis and the eye in the half-plane of azimuth 0, `M` is even in the azimuth of `w_i`, so that only the
harmonics of `m >= 0` occur, with coefficients `rho_lm` that depend on the angle of the eye alone:

    M(w_o, w_i) = sum_l sum_{m=0..l} rho_lm(theta_o) Y_lm(w_i).
"""

import abc
import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.model.effects import AbstractMaterial
from jvr.model.harmonics.basis import basis
from jvr.model.parameters import assign, parameter
from jvr.model.ranges import INCREASING, NOT_NEGATIVE
from jvr.names import Renamed
from jvr.types import ArrayLike, Channels, Scalar, Triple

# The largest angle between the normal and the eye that materials are projected for.
GRAZING = math.pi / 2 - 1e-3

SymmetryAxis: TypeAlias = Literal["normal", "eye", "both"]


class Lobe(eqx.Module):
    """`rho_lm` of one part of a material, for each class of the scalar and for polar angles of the eye that are equally distant from
    0 to 90 degrees. `symmetry_axis`: what `M` is symmetric about: the `normal` or the `eye` (then there is one angle, and `m = 0` alone),
    or the plane of `both`."""

    coefficients: Float[Array, "classes polar l m channels"]
    symmetry_axis: SymmetryAxis = eqx.field(static=True)

    def in_plane(self) -> "Lobe":
        """The same with as many angles and `m` as a lobe symmetric about the plane of both has, so that it can stand beside one."""
        if self.symmetry_axis == "eye":
            raise ValueError("a phase function has no place beside surfaces in one material by value: split the scene")
        if self.symmetry_axis == "both":
            return self
        wide = jnp.pad(self.coefficients, ((0, 0),) * 3 + ((0, self.coefficients.shape[2] - 1), (0, 0)))
        return Lobe(wide, "both")


class HarmonicMaterial(AbstractMaterial):
    """A material as coefficients, made by `HarmonicMaterial.project`.

    `tinted` is multiplied with the colour of the transfer function, `plain` is unmodulated; each a `Lobe` or `None`. `positions`: scalars
    of the classes, `(classes,)`, linear in between and constant beyond. `threshold`: as of `jvr.Lambert`: where the gradient is weak, what
    is reflected depends less on direction, down to the mean over all directions. Coefficients are differentiable.
    """

    tinted: Lobe | None
    plain: Lobe | None
    positions: Float[Array, "classes"] = parameter(INCREASING, doc="of the classes, in the data's own units")
    threshold: Scalar = parameter(NOT_NEGATIVE, doc="length of a gradient", unit="data units per mm")

    def __init__(self, tinted: Lobe | None, plain: Lobe | None, positions: ArrayLike, threshold: ArrayLike = 0.0):
        self.tinted, self.plain = tinted, plain
        assign(self, positions=positions, threshold=threshold)

    @classmethod
    def project(
        cls, brdf: "AbstractBRDF", order: int = 3, *, directions: int = 16, nodes: int = 64, threshold: ArrayLike = 0.0
    ) -> "HarmonicMaterial":
        """Projects a material function on the harmonics of `w_i`, for `directions` angles of the eye.

        **Arguments:** `brdf`: such as `jvr.MicrofacetBRDF(...)`, `jvr.MerlBRDF.read(path)`, `jvr.PhaseBRDF(phase)`; `nodes`: of the
        quadrature, along the polar angle of each half of the sphere and along half of the azimuth; sharp lobes need more. Differentiable
        in the numbers of `brdf`. **Raises** `ValueError` for fewer than 2 directions or 4 nodes.
        """
        if directions < 2 or nodes < 4:
            raise ValueError(f"a material needs at least 2 directions and 4 nodes, not {directions} and {nodes}")
        empty = cls(None, None, np.zeros(1), threshold)
        # The last angle is just above the horizon, where in either precision the eye is above the surface.
        polar = np.array([0.0]) if brdf.symmetry_axis != "both" else np.minimum(np.linspace(0, math.pi / 2, directions), GRAZING)
        w_i, weights = half_sphere_nodes(nodes)
        functions = jnp.stack([row for i, row in enumerate(basis(order, tuple(w_i.T))) if _degree(i) >= 0], axis=1)

        def at(theta: Array) -> tuple[Channels, Channels]:
            w_o = (jnp.sin(theta), jnp.zeros_like(theta), jnp.cos(theta))
            values = brdf.evaluate(w_o, tuple(jnp.asarray(c, theta.dtype) for c in w_i.T))
            summed = lambda v: jnp.asarray(functions * weights[:, None], theta.dtype).T @ jnp.broadcast_to(v, weights.shape)
            return jax.tree.map(summed, values)

        parts = jax.vmap(at)(jnp.asarray(polar, empty.threshold.dtype))
        tinted, unmodulated = (_lobe(part, order, brdf.symmetry_axis) for part in parts)
        return cls(tinted, unmodulated, jnp.zeros(1, empty.threshold.dtype), empty.threshold)

    @property
    def order(self) -> int:
        """The highest order of its lobes."""
        return max([lobe.coefficients.shape[2] - 1 for lobe in (self.tinted, self.plain) if lobe is not None], default=0)

    @property
    def needs_gradient(self) -> bool:
        """Whether what is reflected depends on a normal."""
        return any(lobe is not None and lobe.symmetry_axis != "eye" for lobe in (self.tinted, self.plain))

    def projected(self, order: int) -> "HarmonicMaterial":
        return self


class AbstractBRDF(AbstractMaterial):
    """A material function in closed form or as measured. In a scene it is projected anew in each picture, so that its numbers can be
    fitted; `jvr.HarmonicMaterial.project` does it once."""

    # What it is symmetric about, see `Lobe`.
    symmetry_axis: ClassVar[SymmetryAxis]

    about = Renamed("symmetry_axis")

    @abc.abstractmethod
    def evaluate(self, w_o: Triple, w_i: Triple) -> tuple[Channels, Channels]:
        """`M` in a frame whose z is the normal, per solid angle of `w_i`: the part that the colour of the medium is multiplied with and
        the part in the light's own colour, each of no, one or three components. Elementwise; unit directions away from the point."""

    @property
    def needs_gradient(self) -> bool:
        return self.symmetry_axis != "eye"

    def projected(self, order: int) -> HarmonicMaterial:
        return HarmonicMaterial.project(self, order)


class MaterialByValue(AbstractMaterial):
    """A material for each class of the transfer function: that of `positions[i]` is `materials[i]`, linear in between.

    **Arguments:** `positions`: `(n,)`, strictly increasing, in the data's units; `materials`: `n` BRDFs or `jvr.HarmonicMaterial`s of one
    order and number of directions; the threshold is that of the first. **Raises** `ValueError` for other numbers of them, and in
    `projected` for orders or directions that differ; `TypeError` for anything else, such as another `MaterialByValue`.
    """

    positions: Float[Array, "n"] = parameter(INCREASING, doc="in the data's own units")
    materials: tuple[AbstractMaterial, ...] = parameter(shapes=(("n",),), doc="BRDFs or jvr.HarmonicMaterials")

    def __init__(self, positions: ArrayLike, materials: Sequence[AbstractMaterial]):
        assign(self, positions=positions, materials=materials)
        single = [
            isinstance(m, AbstractBRDF) or (isinstance(m, HarmonicMaterial) and m.positions.size == 1) for m in self.materials
        ]
        if not all(single):
            raise TypeError("materials must be BRDFs or jvr.HarmonicMaterials of one class, one for each position")

    @property
    def needs_gradient(self) -> bool:
        return any(m.needs_gradient for m in self.materials)

    def projected(self, order: int) -> HarmonicMaterial:
        parts = [m.projected(order) for m in self.materials]
        tinted, unmodulated = (_side_by_side([getattr(p, name) for p in parts]) for name in ("tinted", "plain"))
        return HarmonicMaterial(tinted, unmodulated, self.positions, parts[0].threshold)


def half_sphere_nodes(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions `(n, 3)` of azimuth 0 to 180 degrees and weights that integrate an even function of the azimuth over the sphere:
    Gauss-Legendre in the polar angle of each half, so that a lobe near the pole or the horizon is resolved, equal steps of azimuth."""
    x, weight = np.polynomial.legendre.leggauss(nodes)
    quarter, weight = (x + 1) * math.pi / 4, weight * math.pi / 4
    polar, weight = np.concatenate([quarter, quarter + math.pi / 2]), np.concatenate([weight, weight])
    azimuth = (np.arange(nodes) + 0.5) * math.pi / nodes
    sine = np.sin(polar)[:, None]
    z = np.broadcast_to(np.cos(polar)[:, None], (polar.size, nodes))
    directions = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), z], axis=-1).reshape(-1, 3)
    return directions, np.repeat(weight * np.sin(polar), nodes) * 2 * math.pi / nodes


def _degree(index: int) -> int:
    """The `m` of a coefficient's index."""
    band = math.isqrt(index)
    return index - band * (band + 1)


def _lobe(values: Channels, order: int, symmetry_axis: SymmetryAxis) -> Lobe | None:
    """Coefficients `(polar, those of m >= 0)` of each channel as a `Lobe`."""
    if not values:
        return None
    stacked = jnp.stack(values, axis=-1)
    widest = order + 1 if symmetry_axis == "both" else 1
    square = jnp.zeros((stacked.shape[0], order + 1, widest, stacked.shape[2]), stacked.dtype)
    places = [(math.isqrt(i), _degree(i)) for i in range((order + 1) ** 2) if _degree(i) >= 0]
    for k, (band, m) in enumerate(places):
        if m < widest:
            square = square.at[:, band, m].set(stacked[:, k])
    return Lobe(square[None], symmetry_axis)


def _side_by_side(lobes: Sequence[Lobe | None]) -> Lobe | None:
    """The lobes of several classes as one; a missing one is zero."""
    there = [lobe for lobe in lobes if lobe is not None]
    if not there:
        return None
    if len({lobe.symmetry_axis for lobe in there}) > 1:
        there = [lobe.in_plane() for lobe in there]
    if len({lobe.coefficients.shape[2] for lobe in there}) > 1 or len({lobe.coefficients.shape[1] for lobe in there} - {1}) > 1:
        raise ValueError("materials side by side need one order and number of directions: project them alike")
    shape = np.broadcast_shapes(*[lobe.coefficients.shape for lobe in there])
    found: Any = iter(there)
    rows = [jnp.zeros(shape) if lobe is None else jnp.broadcast_to(next(found).coefficients, shape) for lobe in lobes]
    return Lobe(jnp.concatenate(rows), there[0].symmetry_axis)
