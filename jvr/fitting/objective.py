"""The objective of a fit: its value for solvers that use gradients, its residuals for those that take a whole Jacobian.

Both go through the rays in chunks, so that a matrix of all rays is never held.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.execution.devices import everywhere, over_rays, shares
from jvr.execution.tiles import dealt_blocks, picture_of, pixels_of
from jvr.fitting.kinds import adjoint_of
from jvr.fitting.observations import Observations, observed_medium, prepare_in_fit, rays_inside
from jvr.fitting.problem import Problem, exposed, predict, prior
from jvr.fitting.unknowns import ExposedModel
from jvr.march.differentiation import AbstractAdjoint, Replay
from jvr.march.march import Marched, MarchOptions
from jvr.march.medium import Medium
from jvr.march.steps import Rays
from jvr.model.camera import AbstractCamera
from jvr.rendering.medium import Prepared, medium
from jvr.rendering.trace import camera_rays, near_volume
from jvr.types import Image, Scalar, Triple


@eqx.filter_jit
def value(problem: Problem, unconstrained: Float[Array, "unknowns"], tiles: Observations, total: Scalar) -> Scalar:
    """Mean loss over all pixels plus priors, in unconstrained space. `tiles` has a leading axis of chunks."""
    model = problem.unknowns.model_from_unconstrained(problem.model, unconstrained)
    prepared = prepare_in_fit(model.scene, problem.settings, problem.skips)
    shared, stored = problem.apart()

    def share(shared: tuple[Problem, ExposedModel, Prepared], rays: tuple[Array | None, Observations]) -> Array:
        problem, model, prepared = shared
        stored, tiles = rays

        def add_tile(sum_: Scalar, tile: Observations) -> tuple[Scalar, None]:
            r = residual(problem.reassembled(stored), model, tile, prepared)
            return sum_ + sum(jnp.sum(tile.weight * problem.loss.value(c)) for c in r), None

        return jax.lax.scan(add_tile, jnp.zeros((), unconstrained.dtype), tiles)[0][None]

    loss = jnp.sum(over_rays(share, (shared, model, prepared), (stored, tiles)))
    return loss / total + prior(problem, model)


@eqx.filter_jit
def residuals(problem: Problem, unconstrained: Float[Array, "unknowns"], tiles: Observations, total: Scalar) -> Array:
    """The whole residual vector, scaled to a squared length of the mean squared error; priors have no residuals."""
    model = problem.unknowns.model_from_unconstrained(problem.model, unconstrained)
    adjoint, prepared = adjoint_of(problem), prepare_in_fit(model.scene, problem.settings, problem.skips)
    shared, stored = problem.apart()

    def share(shared: tuple[Problem, ExposedModel, Prepared, Scalar], rays: tuple[Array | None, Observations]) -> Array:
        problem, model, prepared, total = shared
        stored, tiles = rays

        def of_tile(tile: Observations) -> Array:
            scale = jnp.sqrt(tile.weight / total)
            return jnp.stack([scale * c for c in residual(problem.reassembled(stored), model, tile, prepared, adjoint)])

        return jax.lax.map(of_tile, tiles)

    return jnp.ravel(everywhere(over_rays(share, (shared, model, prepared, total), (stored, tiles))))


def residual(
    problem: Problem, model: ExposedModel, tile: Observations, prepared: Prepared, adjoint: AbstractAdjoint = Replay()
) -> Triple:
    """Rendered minus target in each channel, differentiable in the mode of `adjoint`."""
    through = observed_medium(tile, problem.samples, prepared) if problem.marches else None
    rays = rays_inside(model.scene, model.views, tile.rays)
    colours, _ = seen(problem, model, rays, through, prepared, adjoint)
    return tuple(c - tile.target[:, i] for i, c in enumerate(colours))


def seen(
    problem: Problem, model: ExposedModel, rays: Rays, medium: Medium | None, prepared: Prepared, adjoint: AbstractAdjoint
) -> tuple[Triple, Marched | None]:
    """Colours of rays as the targets have them, and what a march through `medium` gathered for that, where the integrator is one."""
    if medium is None:
        prepared = prepared._replace(settings=eqx.tree_at(lambda s: s.adjoint, prepared.settings, adjoint))
        rgb = problem.integrator.radiance(prepared, rays).rgb
        return exposed(model, (rgb[:, 0], rgb[:, 1], rgb[:, 2])), None
    gathered = adjoint.march(MarchOptions(problem.settings.termination, distance=False), medium, rays, prepared.dt)
    return predict(model, gathered, rays), gathered


def check_derivatives(problem: Problem, tiles: Observations, *, forwards: bool) -> None:
    """**Raises** `ValueError` where the radiance of an integrator has no derivative in the mode that a solver takes it in."""
    if problem.marches:
        return
    # Whatever the loss: it is the radiance that may have none.
    problem, total = problem.least_squares(), jnp.ones(())
    unconstrained = problem.unknowns.unconstrained_from_model(problem.model)
    function = lambda x: residuals(problem, x, tiles, total) if forwards else value(problem, x, tiles, total)
    jax.eval_shape(function, unconstrained)
    differentiated = (lambda x: jax.jvp(function, (x,), (x,))) if forwards else jax.grad(function)
    try:
        jax.eval_shape(differentiated, unconstrained)
    # Whatever JAX says of what it cannot differentiate: what is wrong with the function itself has been raised before.
    except Exception as error:
        name, mode = type(problem.integrator).__name__, "forward" if forwards else "reverse"
        reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise ValueError(f"a fit takes derivatives of {name} in {mode} mode, which has none: {reason}") from error


@eqx.filter_jit
def image_value(
    problem: Problem, unconstrained: Float[Array, "unknowns"], cameras: Sequence[AbstractCamera], images: Sequence[Array]
) -> Scalar:
    """`value` for a loss over whole images: the mean over images plus priors."""
    model = problem.unknowns.model_from_unconstrained(problem.model, unconstrained)
    losses, prepared = [], prepare_in_fit(model.scene, problem.settings, problem.skips)
    for camera, target in zip(cameras, images, strict=True):
        rendered = _rendered(problem, model, camera, prepared)
        losses.append(problem.loss.image(rendered, target))
    return jnp.mean(jnp.stack(losses)) + prior(problem, model)


def _rendered(problem: Problem, model: ExposedModel, camera: AbstractCamera, prepared: Prepared) -> Image:
    """A whole image, colours as the targets have them."""
    height, width = camera.height, camera.width

    def share(
        shared: tuple[Problem, ExposedModel, AbstractCamera, Prepared], blocks: Int[Array, "blocks"]
    ) -> Float[Array, "rays 3"]:
        problem, model, camera, prepared = shared
        _, near = near_volume(model.scene, camera)
        rays, _ = camera_rays(prepared.scene, near, pixels_of(blocks, height, width))
        through = medium(prepared) if problem.marches else None
        return jnp.stack(seen(problem, model, rays, through, prepared, Replay())[0], axis=-1)

    shared = (problem.apart()[0], model, camera, prepared)
    rays = everywhere(over_rays(share, shared, dealt_blocks(height, width, shares())))
    return picture_of(rays, height, width, shares())
