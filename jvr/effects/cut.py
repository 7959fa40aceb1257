"""Cut faces: normals of the surfaces where clipping boxes and planes cut the medium open.

Inside of what is cut the gradient is that of noise, and within a voxel of the cut it is made of voxels that are not there. A layer behind
each face is therefore shaded with the normal of the face. That a cut is lit as a surface and what lies behind it by its gradient
is after Weiskopf, Engel and Ertl, "Interactive clipping techniques for texture-based volume visualization and volume shading" (IEEE TVCG
9(3), 2003, pages 298-312); how deep the layer is, and how one goes over into the other, is not taken from there.
"""

import equinox as eqx
import jax.numpy as jnp

from jvr.model.clipping import AbstractClipping
from jvr.numerics import direction_and_length
from jvr.types import Scalar, Triple


class CutFaces(eqx.Module):
    """The cut faces of a clipping. `layer`: a point up to this world length behind a face belongs to it, one that is twice as deep
    does not, with a smooth cubic in between."""

    parts: tuple[AbstractClipping, ...]
    layer: Scalar

    def normal(self, x: Triple, normal: Triple) -> tuple[Triple, Scalar]:
        """The unit normal of a point in the world, and the fraction of it that is a cut. `normal`: that of its gradient, as long as the
        fraction of the point that is a surface.
        Differentiable; detached: which of two opposite faces is nearer."""

        def weight(depth: Scalar) -> Scalar:
            near = jnp.clip(2 - depth / self.layer, 0.0, 1.0)
            return near * near * (3 - 2 * near)

        (outward, fraction), *others = [part.outward(x, weight) for part in self.parts]
        for more, of_part in others:
            outward = tuple(o + m for o, m in zip(outward, more, strict=True))
            fraction = jnp.maximum(fraction, of_part)
        mixed, _ = direction_and_length(tuple(o + (1 - fraction) * n for o, n in zip(outward, normal, strict=True)))
        return mixed, fraction
