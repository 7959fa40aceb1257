"""Derivatives of a picture of arrays at hand: both walks of a replay in parts, side by side.

Within a compiled function a picture and its derivative are part of that one program, which keeps little more than one core busy.
`jax.grad` of a function that is not compiled comes here: the picture is made in parts, as one without a derivative is, and so is the
walk back.
"""

import functools
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jvr.march.adjoint import resumed_march
from jvr.march.march import Marched, MarchOptions, Noted, integrate
from jvr.march.rules import is_zero, wanted_and_fixed
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.parallel import in_threads, is_traced, program, workers
from jvr.rendering.parts import block_shape, dealt, dealt_blocks, in_parts, joined, pixels_of
from jvr.rendering.settings import Settings
from jvr.rendering.trace import Pixels, Seen, aim, compiled_seen, develop


class _Done(NamedTuple):
    """What a part of the picture leaves for its replay."""

    blocks: Int[Array, "blocks"]
    gathered: Marched
    noted: Noted


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def reversible(settings: Settings, scene: Scene, camera: AbstractCamera) -> tuple[Pixels, Int[Array, "height width"]]:
    """The pixels of a picture and the samples taken for each, differentiable in reverse mode as by `jvr.Replay()`. Where
    light is prepared for the whole picture (`prepares_light`) its derivative would be missing."""
    return _picture(settings, scene, camera, for_replay=False)[0]


def _picture(settings: Settings, scene: Scene, camera: AbstractCamera, *, for_replay: bool):
    height, width = camera.height, camera.width
    where = compiled_seen(scene, settings)
    part = functools.partial(_march, scene, camera, settings, for_replay, where)
    if is_traced((scene, camera)):
        # Inside of `vmap`, whose arrays belong to this thread.
        most = max(settings.tile // math.prod(block_shape(height, width)), 1)
        pieces = [part(jnp.asarray(blocks)) for blocks in dealt_blocks(height, width, most)]
    else:
        pieces = in_parts(part, height, width, settings.tile)
    return joined(height, width, [made for made, _ in pieces]), (where, [done for _, done in pieces])


def _forward_rule(settings: Settings, scene: Any, camera: Any):
    wanted, fixed = wanted_and_fixed((scene, camera))
    picture, left = _picture(settings, *eqx.combine(wanted, fixed), for_replay=True)
    return picture, (wanted, fixed, *left)


def _backward_rule(settings: Settings, residuals: Any, cotangent: tuple[Pixels, Any]) -> Any:
    wanted, fixed, where, done = residuals
    camera = eqx.combine(wanted, fixed)[1]
    pixels = tuple(None if is_zero(x) else x for x in cotangent[0])
    shares = dealt(camera.height, camera.width, len(done), pixels)
    one = lambda k: _replay(settings, wanted, fixed, where, done[k], shares[k])
    if is_traced((residuals, pixels)):
        return functools.reduce(_added, map(one, range(len(done))))
    total = None
    # A few at a time: each may be as large as the volume.
    for begin in range(0, len(done), workers()):
        found = in_threads(one, range(len(done))[begin : begin + workers()])
        total = functools.reduce(_added, found if total is None else [total, *found])
    return total


reversible.defvjp(_forward_rule, _backward_rule, symbolic_zeros=True)


@functools.partial(program, static_argnums=(2, 3))
def _march(scene: Scene, camera: AbstractCamera, settings: Settings, for_replay: bool, where: Seen, blocks: Int[Array, "blocks"]):
    """Some blocks of the picture, the samples taken for each pixel, and `for_replay` what that needs."""
    aimed, t_in = aim(scene, camera, settings, pixels_of(blocks, camera.height, camera.width), where)
    gathered, noted = integrate(MarchOptions(settings.termination, True), *aimed, for_replay=for_replay)
    done = None if noted is None else _Done(blocks, gathered, noted)
    return (develop(scene, gathered, aimed.rays, t_in), gathered.steps), done


@functools.partial(program, static_argnums=0)
def _replay(settings: Settings, wanted: Any, fixed: Any, where: Seen, done: _Done, cotangent: tuple[Any, ...]) -> Any:
    """The gradient in what is `wanted` of the scene and the camera; a `None` among the cotangents of `Pixels` is a zero."""

    def again(wanted: Any) -> tuple[Any, ...]:
        scene, camera = eqx.combine(wanted, fixed)
        aimed, t_in = aim(scene, camera, settings, pixels_of(done.blocks, camera.height, camera.width), where)
        gathered: Any = resumed_march(MarchOptions(settings.termination, True), (done.gathered, done.noted), *aimed)
        made = develop(scene, gathered, aimed.rays, t_in)
        return tuple(None if c is None else x for x, c in zip(made, cotangent, strict=True))

    return jax.vjp(again, wanted)[1](cotangent)[0]


_added = jax.jit(lambda a, b: jax.tree.map(jnp.add, a, b))
