"""A fit without its observations, and what its model looks like in the targets' own radiance."""

from typing import Any

import equinox as eqx
from jaxtyping import Array

from jvr.fitting.losses import AbstractPrior, SquaredError
from jvr.fitting.observations import Samples
from jvr.fitting.unknowns import ExposedModel, Unknowns
from jvr.march.march import Marched
from jvr.march.steps import Rays
from jvr.rendering.integrator import AbstractRayIntegrator
from jvr.rendering.settings import Settings
from jvr.rendering.trace import composite
from jvr.types import Scalar, Triple


class Problem(eqx.Module):
    """A fit without its observations: what is unknown, how it is rendered, what is made small."""

    model: ExposedModel
    unknowns: Unknowns
    settings: Settings
    loss: Any  # AbstractLoss, or DSSIM for solvers that use gradients alone
    priors: tuple[AbstractPrior, ...]
    samples: Samples | None
    skips: bool = eqx.field(static=True, default=False)  # empty bricks, in what has no derivative there

    @property
    def integrator(self) -> AbstractRayIntegrator:
        """What finds the radiance of its rays."""
        assert isinstance(self.settings.sampling, AbstractRayIntegrator)
        return self.settings.sampling

    @property
    def marches(self) -> bool:
        """Whether what its rays bring is what a march gathers and one background behind it, so that their samples may be kept, and the
        Jacobian of a table comes out of one replay."""
        return self.integrator.marches and not self.model.scene.ends_rays

    def with_samples(self, samples: Samples) -> "Problem":
        return Problem(self.model, self.unknowns, self.settings, self.loss, self.priors, samples, self.skips)

    def apart(self) -> "tuple[Problem, Array | None]":
        """What all devices share of it, and the kept samples, of which each has those of its own rays."""
        if self.samples is None:
            return self, None
        stored = lambda problem: problem.samples.stored
        return eqx.tree_at(stored, self, None), self.samples.stored

    def reassembled(self, stored: Array | None) -> "Problem":
        """What `apart` undoes on one device."""
        if stored is None:
            return self
        return eqx.tree_at(lambda problem: problem.samples.stored, self, stored, is_leaf=lambda x: x is None)

    def least_squares(self) -> "Problem":
        """The same unknowns and data, the squared error alone."""
        return Problem(self.model, self.unknowns, self.settings, SquaredError(), (), self.samples, self.skips)


def predict(model: ExposedModel, gathered: Marched, rays: Rays) -> Triple:
    """Colours as the target images have them."""
    return exposed(model, composite(model.scene, gathered, rays)[0])


def exposed(model: ExposedModel, rgb: Triple) -> Triple:
    """Radiance as the target images have it."""
    return rgb if model.exposure is None else tuple(model.exposure * c for c in rgb)


def read_after_march(model: ExposedModel) -> Any:
    """The arrays that `predict` reads and rays do not."""
    return model.scene.background, model.exposure


def prior(problem: Problem, model: ExposedModel) -> Scalar | float:
    """The sum of all priors."""
    return sum((p.value(model.scene) for p in problem.priors), 0.0)
