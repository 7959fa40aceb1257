"""One of two devices works for some seconds longer than the other, which waits for it: PATIENCE SECONDS."""

import sys
import time

import jax
import jax.numpy as jnp

import jvr
from jvr.execution import devices

devices.PATIENCE, longer = int(sys.argv[1]), float(sys.argv[2])
# Where one core is all there is, two devices share it.
devices.cores = lambda: 2
jvr.use_all_cores()
mesh = jax.make_mesh((2,), ("rays",), axis_types=(jax.sharding.AxisType.Auto,))


def together(count):
    thousand = lambda _, x: jax.lax.fori_loop(0, 1000, lambda _, x: jnp.sin(x), x)
    work = lambda count: jax.lax.fori_loop(0, count, thousand, jnp.float32(1))
    own = lambda count: jax.lax.psum(work(jnp.where(jax.lax.axis_index("rays") == 0, count, 1)), "rays")
    everywhere = jax.sharding.PartitionSpec()
    return jax.shard_map(own, mesh=mesh, in_specs=everywhere, out_specs=everywhere, check_vma=False)(count)


def seconds(count):
    began = time.perf_counter()
    jax.block_until_ready(run(count))
    return time.perf_counter() - began


run = jax.jit(together)
seconds(1)
count = 1000
while (took := seconds(count)) < 0.2:
    count *= 2
print(seconds(int(count * longer / took)))
