"""A picture, its gradient and a fit as one of several processes, which `test_execution.py` runs: NUMBER RANK ADDRESS FILE."""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scenes import perspective, small

import jvr
from jvr.execution.devices import shares

number, rank, address, file = int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:]
if number > 1:
    jax.config.update("jax_num_cpu_devices", 2)
    jax.distributed.initialize(address, number, rank)
    assert shares() == 2 * number

scene, camera = small(), perspective(small().volume, 15, 13)
into = lambda scene: (scene.transfer, scene.volume.values)
loss = lambda arrays: jnp.mean(jnp.sin(3 * jvr.render(eqx.tree_at(into, scene, arrays), camera).rgb))
picture, gradient = jvr.render(scene, camera), jax.grad(loss)(into(scene))
colours = lambda scene: scene.transfer.rgb
start = eqx.tree_at(colours, scene, jnp.full_like(colours(scene), 0.5))
# Noise, since standard errors of a perfect fit would be those of rounding.
target = np.asarray(picture.rgb) + 0.02 * np.random.default_rng(0).normal(size=picture.rgb.shape)
fitted = jvr.fit(start, [camera], [target], unknowns=colours, max_steps=4, progress=False)
arrays = {"rgb": picture.rgb, "depth": picture.depth, "steps": picture.stats.steps}
arrays |= {"of_colours": gradient[0].rgb, "of_extinctions": gradient[0].sigma_t, "of_voxels": gradient[1]}
np.savez(file, fitted=fitted.scene.transfer.rgb, errors=fitted.standard_errors, **arrays)
