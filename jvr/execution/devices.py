"""Rays over devices: the cores of a processor, accelerators and hosts are one mechanism.

The operations of a march are too small to be shared between cores, so that one device keeps little more than one of them busy. A
processor can be as many devices as it has cores (`use_all_cores`); rays are then sharded over them within the one compiled program.
"""

import functools
import os
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

Rays = TypeVar("Rays")
Shared = TypeVar("Shared")
Result = TypeVar("Result")

# The axis of the mesh.
AXIS = "rays"
# Seconds that devices of a processor wait for the last one at the end of a program, after a warning. The compiler's own choice, 40,
# ends the process where one of two cores is busy with something else for so long.
PATIENCE = 86_400
# What becomes of an operation on it tells whether operations are traced now.
_ZERO = np.float32(0)


def use_all_cores() -> None:
    """Makes each core of the processor a device of JAX, over which pictures, derivatives and fits are then spread.

    To be called before JAX computes anything, as `jax.config.update("jax_num_cpu_devices", ...)`, which it calls; without it a processor
    is one device. **Warns** where JAX has begun with another number of devices: the call then has no effect.
    """
    number = cores()
    patient = f"--xla_cpu_collective_call_terminate_timeout_seconds={PATIENCE}"
    flags = os.environ.get("XLA_FLAGS", "")
    if patient.split("=")[0] not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {patient}".strip()
    try:
        jax.config.update("jax_num_cpu_devices", number)
    except RuntimeError:
        if len(jax.local_devices(backend="cpu")) != number:
            warnings.warn(
                f"JAX has begun with {len(jax.local_devices(backend='cpu'))} of {number} cores: call jvr.use_all_cores() before "
                "anything is computed, in a notebook after a restart of the kernel",
                RuntimeWarning,
                stacklevel=2,
            )


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def mesh() -> Mesh | None:
    """The devices that rays are spread over, or `None` where that is one: nobody gave JAX more, or somebody spreads over them already
    (`shard_map`, `pmap`, a mesh in use, a default device)."""
    if jax.config.jax_default_device is not None or is_spread():  # pyright: ignore[reportAttributeAccessIssue]
        return None
    devices = jax.devices()
    return Mesh(np.array(devices), (AXIS,)) if len(devices) > 1 else None


def is_spread() -> bool:
    """Whether whatever is computed now is a share of what somebody spreads over devices."""
    return not jax.sharding.get_abstract_mesh().empty


def shares() -> int:
    """How many parts of equal size rays are spread in."""
    among = mesh()
    return 1 if among is None else among.size


def sharing_memory() -> int:
    """Over how many of these parts a batch of rays is divided that fits in the caches: cores of a processor share them, and accelerators
    have each their own."""
    return shares() if jax.default_backend() == "cpu" else 1


def over_rays(function: Callable[[Shared, Rays], Result], shared: Shared, rays: Rays) -> Result:
    """`function(shared, rays)`, each device with its own share of the rays.

    `rays`, and what `function` returns, are arrays with a leading axis of rays, a multiple of `shares()` of them; neighbours stay on one
    device. `shared` is the same on all, and its cotangents are summed over them. To be called within a compiled program.
    """
    among = mesh()
    if among is None:
        return function(shared, rays)
    arrays, rest = eqx.partition(shared, eqx.is_array)
    one = lambda arrays, rays: function(eqx.combine(arrays, rest), rays)
    each, own = PartitionSpec(), PartitionSpec(AXIS)
    # Marches are loops with state of their own on each device, which the check of replication does not follow.
    return jax.shard_map(one, mesh=among, in_specs=(each, own), out_specs=own, check_vma=False)(arrays, rays)


def everywhere(tree: Result) -> Result:
    """Arrays that `over_rays` made, whole on every device: what leaves a program, so that every host has it."""
    among = mesh()
    if among is None:
        return tree
    return jax.tree.map(lambda x: jax.lax.with_sharding_constraint(x, NamedSharding(among, PartitionSpec())), tree)


def spread(array: Array) -> Array:
    """A concrete array on every device that rays are spread over: cores of a processor share one copy of it, where a program that is
    given an array of one device makes one for each core in each call."""
    among = mesh()
    if among is None or isinstance(array, Tracer) or not isinstance(array, jax.Array) or len(array.sharding.device_set) > 1:
        return array
    local = [device for device in among.devices.flat if device.process_index == jax.process_index()]
    held = np.asarray(array) if local[0].platform == "cpu" else array
    # Within somebody's trace a copy would be a part of it.
    with jax.ensure_compile_time_eval():
        copies = [jax.device_put(held, device, may_alias=True) for device in local]
    return jax.make_array_from_single_device_arrays(array.shape, NamedSharding(among, PartitionSpec()), copies)


def once(function: Callable[..., Result], *arguments: Any) -> Result:
    """What a function makes of concrete arrays, by one device and then `spread`: where all of them compute the same, each has a copy. Of
    traced arrays it is a part of their program."""
    if mesh() is None or is_traced(arguments):
        return function(*arguments)
    return jax.tree.map(spread, function(*jax.tree.map(_of_one_device, arguments)))


def _of_one_device(array: Any) -> Any:
    """The copy of an array that the first device has, where all have one."""
    has_all = isinstance(array, jax.Array) and array.sharding.is_fully_replicated
    return array.addressable_data(0) if has_all else array


def on_devices(rays: Array | np.ndarray) -> Array:
    """A concrete array with a leading axis of rays, each device with the share that `over_rays` gives it."""
    among = mesh()
    if among is None:
        return jnp.asarray(rays)
    shared = NamedSharding(among, PartitionSpec(AXIS))
    if not among.is_multi_process:
        return jax.device_put(rays, shared)
    # All processes hold the same rays; JAX would send them around to see whether that is so.
    held = np.asarray(rays)
    return jax.make_array_from_callback(held.shape, shared, lambda place: held[place])


def is_traced(tree: Any = ()) -> bool:
    """Whether any array of `tree` is being traced, or whatever is computed now."""
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(tree)) or isinstance(jax.lax.neg(_ZERO), Tracer)


def program(function: Callable[..., Result], static_argnums: int | tuple[int, ...] = ()) -> Callable[..., Result]:
    """`jax.jit` of a function that is a program of its own where its arguments are concrete, and a part of another one elsewhere.

    On processors it then works with vectors as wide as they have, where the compiler's own choice is half of that.
    """
    inside, own = jax.jit(function, static_argnums=static_argnums), None

    @functools.wraps(function)
    def call(*arguments: Any) -> Result:
        nonlocal own
        if jax.default_backend() != "cpu" or is_traced(arguments):
            return inside(*arguments)
        own = own or jax.jit(function, static_argnums=static_argnums, compiler_options=_widest())
        return own(*arguments)

    return call


@functools.cache
def _widest() -> dict[str, Any]:
    """The compiler's option, where it knows it."""
    options = {"xla_cpu_prefer_vector_width": 512}
    try:
        jax.jit(lambda x: x, compiler_options=options).lower(jnp.float32(0)).compile()
    except jax.errors.JaxRuntimeError:
        return {}
    return options
