"""What an evaluation of a fit of voxels costs, with its gradient, in pictures of the same views."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

import jvr
from benchmarks.timing import median, ratio, seconds


def voxel_step(size: int = 64, views: int = 8, repeats: int = 5) -> dict[str, float]:
    """Seconds of the objective and its gradient in all voxels, with and without the prior, over those of plain pictures of the views, in
    turns."""
    from experiments.tomography import VARIATION, VOXELS, beams

    of, settings = beams(size, views), jvr.Settings(1.0, termination=0.0)
    cameras = jax.tree.map(lambda *leaves: jnp.stack(leaves), *of.cameras)
    targets, values, prior = (
        jnp.stack([jnp.asarray(image) for image in of.images]),
        VOXELS(of.start),
        jvr.TotalVariation(VARIATION),
    )
    placed = lambda values: eqx.tree_at(VOXELS, of.start, values)

    def loss(values: Any, strength: float) -> Any:
        one = lambda pair: jnp.mean(jnp.square(jvr.render(placed(values), pair[0], settings).rgb - pair[1]))
        return jnp.mean(jax.lax.map(one, (cameras, targets))) + (prior.value(placed(values)) if strength else 0.0)

    draw = jax.jit(lambda values: jax.lax.map(lambda camera: jvr.render(placed(values), camera, settings).rgb, cameras))
    step = jax.jit(jax.value_and_grad(loss), static_argnums=1)
    with_prior, without = (lambda: step(values, VARIATION)), (lambda: step(values, 0.0))
    times = seconds({"gradient": without, "with_prior": with_prior, "pictures": lambda: draw(values)}, repeats)
    return {
        "pictures_seconds": median(times, "pictures"),
        "gradient_over_pictures": ratio(times, "gradient", "pictures"),
        "with_prior_over_pictures": ratio(times, "with_prior", "pictures"),
    }
