"""Losses over residuals and priors over the scene: what a fit minimises."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTable
from jvr.types import Scalar


class AbstractLoss(eqx.Module):
    """A loss `rho(r)` over each component of the residual, rendered minus target."""

    @abc.abstractmethod
    def value(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """`rho(r)`."""

    @abc.abstractmethod
    def weight(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """`rho'(r) / (2 r)`: the weight with which `r^2` has the gradient of `rho` (iteratively reweighted least squares)."""


class SquaredError(AbstractLoss):
    """The squared error, `r^2`."""

    def value(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.square(r)

    def weight(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.ones_like(r)


class Huber(AbstractLoss):
    """The Huber loss: `r^2` up to `delta`, `2 delta |r| - delta^2` beyond (Huber 1964): outliers pull with a bounded force."""

    delta: float = eqx.field(static=True, default=0.05)

    def value(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        size = jnp.abs(r)
        return jnp.where(size <= self.delta, jnp.square(r), self.delta * (2 * size - self.delta))

    def weight(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.delta / jnp.maximum(jnp.abs(r), self.delta)


class AbsoluteError(AbstractLoss):
    """The absolute error, `sqrt(r^2 + epsilon^2) - epsilon`: `|r|` with its corner rounded, so that it has a derivative at 0."""

    epsilon: float = eqx.field(static=True, default=1e-3)

    def value(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        # The same number without the difference of two nearly equal ones.
        return jnp.square(r) / (jnp.sqrt(jnp.square(r) + self.epsilon**2) + self.epsilon)

    def weight(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        return 0.5 / jnp.sqrt(jnp.square(r) + self.epsilon**2)


class DSSIM(eqx.Module):
    """Structural dissimilarity, `(1 - SSIM) / 2` of whole images, with a uniform window of `window` pixels (Wang et al. 2004). For
    solvers that use gradients alone: structural similarity is not a sum over pixels, so it has no Gauss-Newton matrix."""

    window: int = eqx.field(static=True, default=7)

    def image(self, rendered: Float[Array, "height width 3"], target: Float[Array, "height width 3"]) -> Scalar:
        """The loss of one image, radiance 0 ... 1."""
        c1, c2 = 0.01**2, 0.03**2
        mean = self._mean
        mx, my = mean(rendered), mean(target)
        vx, vy = mean(rendered**2) - mx**2, mean(target**2) - my**2
        cov = mean(rendered * target) - mx * my
        ssim = (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
        return jnp.mean((1 - ssim) / 2)

    def _mean(self, image: Float[Array, "height width 3"]) -> Float[Array, "rows columns 3"]:
        """Mean over every window that lies inside the image, by differences of running sums along each axis."""
        for axis in (0, 1):
            n = min(self.window, image.shape[axis])
            taps = [jnp.take(image, jnp.arange(i, image.shape[axis] - n + 1 + i), axis=axis) for i in range(n)]
            image = jnp.sum(jnp.stack(taps), axis=0) / n
        return image


class AbstractPrior(eqx.Module):
    """A smooth penalty on a scene, added to the mean loss over all pixels."""

    @abc.abstractmethod
    def value(self, scene: Scene) -> Scalar:
        """The penalty; convex in the entries or the voxels that it is about."""


class ColourSmoothness(AbstractPrior):
    """Smoothness of a table's colours: `strength * mean((rgb_i+1 - rgb_i)^2)` over its entries."""

    strength: float = eqx.field(static=True)

    def value(self, scene: Scene) -> Scalar:
        return self.strength * jnp.mean(jnp.square(jnp.diff(_table(scene).rgb, axis=0)))


class ExtinctionSmoothness(AbstractPrior):
    """Smoothness of a table's extinction: `strength * mean((d_i+1 - d_i)^2)`, with `d` the extinction over one voxel, so that the unit of
    the world does not matter."""

    strength: float = eqx.field(static=True)

    def value(self, scene: Scene) -> Scalar:
        depth = _table(scene).sigma_t * jnp.min(scene.volume.spacing)
        return self.strength * jnp.mean(jnp.square(jnp.diff(depth, axis=0)))


class Sparsity(AbstractPrior):
    """Sparsity of a table's extinction: `strength * mean(d)`, with `d` the extinction over one voxel: what the images do not ask for
    becomes transparent."""

    strength: float = eqx.field(static=True)

    def value(self, scene: Scene) -> Scalar:
        return self.strength * jnp.mean(_table(scene).sigma_t) * jnp.min(scene.volume.spacing)


def _table(scene: Scene) -> AbstractTable:
    if not isinstance(scene.transfer, AbstractTable):
        raise ValueError(f"this prior is over the entries of a table; {type(scene.transfer).__name__} has none")
    return scene.transfer
