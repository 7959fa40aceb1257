"""Numerical primitives: functions with a delicate limit, and their derivatives; reads and writes that the compiler does well."""

import math
from typing import TypeVar

import jax
import jax.numpy as jnp
from equinox.internal import unvmap_any
from jaxtyping import Array, Bool, Float, Int, Shaped

from jvr.types import Affine, Corner, Triple

Tree = TypeVar("Tree")


def two_sum(
    high: Float[Array, "..."], low: Float[Array, "..."], term: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Adds `term` to the unevaluated sum `high + low` (Knuth 1969, TAOCP 2, 4.2.2, theorem B).

    Only additions occur, so a compiler that contracts products into fused multiply-adds cannot spoil it.
    The rounding error has derivative zero; stopping it keeps that exact and forward mode cheap.
    """
    total = high + term
    shadow = total - high
    error = (high - (total - shadow)) + (term - shadow)
    return total, low + jax.lax.stop_gradient(error)


@jax.custom_jvp
def divide_or_zero(numerator: Float[Array, "*n"], denominator: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """`numerator / denominator`, and 0 where the denominator is 0.

    The derivative is `(dn - q dd) / d`: nothing is squared, so that it survives denominators whose square underflows, and where
    `q` is 1 it cancels exactly. It is 0 for denominators so small that it would overflow.
    """
    is_zero = denominator == 0
    return jnp.where(is_zero, 0.0, numerator / jnp.where(is_zero, 1.0, denominator))


@divide_or_zero.defjvp
def _divide_or_zero_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    (numerator, denominator), (dn, dd) = primals, tangents
    quotient = divide_or_zero(numerator, denominator)
    limits = jnp.finfo(denominator.dtype)
    negligible = jnp.abs(denominator) < limits.tiny / limits.eps
    inverse = jnp.where(negligible, 0.0, 1.0 / jnp.where(negligible, 1.0, denominator))
    return quotient, (dn - quotient * dd) * inverse


@jax.custom_jvp
def one_minus_exp(tau: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """`1 - exp(-tau)`, the opacity of an optical depth, with every digit for thin media.

    Its derivative `exp(-tau)` keeps every digit for opaque ones: JAX's own for `expm1` forms `(exp(-tau) - 1) + 1`, which in
    float32 is 0 from `tau = 17`.
    """
    return -jnp.expm1(-tau)


@one_minus_exp.defjvp
def _one_minus_exp_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (tau,), (tangent,) = primals, tangents
    return one_minus_exp(tau), jnp.exp(-tau) * tangent


@jax.custom_jvp
def attenuated(j: Float[Array, "*n"], sigma_t: Float[Array, "*n"], dt: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """What leaves a segment of constant emission and extinction, `j dt phi1(sigma_t dt)`, `phi1(d) = (1 - exp(-d)) / d`.

    Its derivative in `dt`, `j exp(-sigma_t dt)`, keeps its digits for opaque segments, and that in `sigma_t` for thin ones.
    """
    return j * dt * _phi1(sigma_t * dt)


@attenuated.defjvp
def _attenuated_jvp(primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    (j, sigma_t, dt), (dj, dsigma, ddt) = primals, tangents
    depth = sigma_t * dt
    through = dt * _phi1(depth)
    return j * through, through * dj + j * dt * (dt * _phi1_slope(depth)) * dsigma + j * jnp.exp(-depth) * ddt


def _phi1(depth: Float[Array, "*n"]) -> Float[Array, "*n"]:
    negligible = jnp.abs(depth) < jnp.finfo(depth.dtype).tiny
    return jnp.where(negligible, 1.0, one_minus_exp(depth) / jnp.where(negligible, 1.0, depth))


def _phi1_slope(depth: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """`(exp(-d) - phi1(d)) / d`; below 1, where that cancels, by its series, the sum of `(-1)^k k d^(k-1) / (k + 1)!`."""
    thin = jnp.abs(depth) < 1
    d = jnp.where(thin, depth, 0.0)
    series = jnp.zeros_like(d)
    for k in range(17, 0, -1):
        series = series * d + (-1) ** k * k / math.factorial(k + 1)
    thick = jnp.where(thin, 1.0, depth)
    return jnp.where(thin, series, (jnp.exp(-thick) - _phi1(thick)) / thick)


def mean_depth(tau: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Where the emission that leaves a homogeneous segment of optical depth `tau` comes from on average, as a fraction of its length:
    `1 / tau - 1 / (exp(tau) - 1)`, from 1/2 for a thin segment towards 0 for an opaque one.

    For thin ones by its series, `1/2 - tau/12 + tau^3/720 - tau^5/30240`, whose terms do not cancel; behind large ones `exp` overflows.
    """
    thin = tau < 0.5
    small, large = jnp.where(thin, tau, 0.0), jnp.where(thin, 1.0, tau)
    square = jnp.square(small)
    series = 0.5 - small * (1 / 12 - square * (1 / 720 - square / 30240))
    decay = jnp.exp(-large)
    return jnp.where(thin, series, 1 / large - decay / (1 - decay))


@jax.custom_jvp
def mean_transmittance(tau: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The mean of the transmittance along a homogeneous segment of optical depth `tau`: `phi1(tau) = (1 - exp(-tau)) / tau`, 1 at 0.

    Its derivative is `-phi1(tau) mean_depth(tau)`: that of the quotient cancels in thin segments.
    """
    is_clear = tau == 0
    return jnp.where(is_clear, 1.0, one_minus_exp(tau) / jnp.where(is_clear, 1.0, tau))


@mean_transmittance.defjvp
def _mean_transmittance_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (tau,), (tangent,) = primals, tangents
    mean = mean_transmittance(tau)
    return mean, -mean * mean_depth(tau) * tangent


def normalise(vector: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Unit vector; zero stays zero, with derivative zero. Scaled first, so that squares neither overflow nor underflow."""
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(vector), axis=-1, keepdims=True))
    is_zero = scale == 0
    scaled = jnp.where(is_zero, 1.0, vector / jnp.where(is_zero, 1.0, scale))
    return jnp.where(is_zero, 0.0, scaled / jnp.linalg.norm(scaled, axis=-1, keepdims=True))


def direction_and_length(vector: Triple) -> tuple[Triple, Float[Array, "..."]]:
    """Unit vector and length. One so short that its inverse would overflow counts as zero: it has no direction, length and derivatives
    zero. Scaled first, so that squares neither overflow nor underflow."""
    x, y, z = vector
    scale = jax.lax.stop_gradient(jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z)))
    limits = jnp.finfo(scale.dtype)
    is_zero = scale < limits.tiny / limits.eps
    inverse = jnp.where(is_zero, 0.0, 1.0 / jnp.where(is_zero, 1.0, scale))
    scaled = tuple(jnp.where(is_zero, 1.0, c * inverse) for c in vector)
    norm = jnp.sqrt(dot(scaled, scaled))
    return tuple(jnp.where(is_zero, 0.0, c / norm) for c in scaled), jnp.where(is_zero, 0.0, scale * norm)


def turned(matrix: Float[Array, "3 3"], x: Triple) -> Triple:
    """A matrix times a vector."""
    return tuple(sum((matrix[i, j] * x[j] for j in range(3)), jnp.zeros_like(x[i])) for i in range(3))


def inverse_of_axes(axes: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The inverse of a matrix whose columns are axes.

    Its rows are cross products of the axes, each scaled to unit length first: a ratio of 1 : 1000 of their lengths or a world in
    kilometres costs no digits, as a general inverse in single precision would.
    """
    lengths = jnp.linalg.norm(axes, axis=0)
    a, b, c = (axes / lengths).T
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
    return rows / (jnp.dot(a, rows[0]) * lengths[:, None])


def transformed(matrix: Affine, p: Triple) -> Triple:
    """A position under an affine transform."""
    return tuple(x + matrix[i, 3] for i, x in enumerate(turned(matrix[:3, :3], p)))


def dot(a: Triple, b: Triple) -> Float[Array, "..."]:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Triple, b: Triple) -> Triple:
    """Outer product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def perpendicular(axis: Triple) -> tuple[Triple, Triple]:
    """Two unit vectors that make an orthonormal basis with a unit vector (Duff et al. 2017, JCGT 6:1)."""
    x, y, z = axis
    # No branch, and no division by a small number.
    sign = jnp.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    return (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


def power_of_cosine(a: Triple, b: Triple, exponent: Float[Array, "..."]) -> Float[Array, "..."]:
    """`max(a . b, 0)^exponent` of unit vectors.

    As `(1 - |a - b|^2 / 2)^exponent`: near the peak the cosine has no digits left that a large exponent could magnify.
    """
    gap = 0.5 * sum(jnp.square(x - y) for x, y in zip(a, b, strict=True))
    # At a right angle the power is zero, and so is its derivative, or taken as such where the exponent is 1.
    positive = gap < 1
    return jnp.where(positive, jnp.exp(exponent * jnp.log1p(-jnp.where(positive, gap, 0.0))), 0.0)


def larger(a: Float[Array, "..."], b: Float[Array, "..."] | float) -> Float[Array, "..."]:
    """The larger of two numbers; where they are equal the derivative is that of `a`.

    `jnp.maximum` finds whose derivative it has by asking which of the two equals the result. Where the compiler computes a number anew
    for that, and rounds it otherwise, neither does, and the derivative is lost.
    """
    return jnp.where(a < b, b, a)


def smaller(a: Float[Array, "..."], b: Float[Array, "..."] | float) -> Float[Array, "..."]:
    """The smaller of two numbers; else as `larger`."""
    return jnp.where(a > b, b, a)


def clamp(
    x: Float[Array, "..."], low: Float[Array, ""] | float | int, high: Float[Array, ""] | float | int
) -> Float[Array, "..."]:
    """`x`, no less than `low` and no more than `high`. From one to the other, both included, the derivative is that of `x`.

    `jnp.clip` has half of it at the ends, where data often lie: background at the first entry of a table, labels at every entry.
    """
    low, high = (jnp.asarray(end, x.dtype) for end in (low, high))
    return _clamp(x, low, high)


@jax.custom_jvp
def _clamp(x: Float[Array, "..."], low: Float[Array, ""], high: Float[Array, ""]) -> Float[Array, "..."]:
    return jnp.clip(x, low, high)


@_clamp.defjvp
def _clamp_jvp(primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    (x, low, high), (dx, dlow, dhigh) = primals, tangents
    return _clamp(x, low, high), jnp.where(x < low, dlow, jnp.where(x > high, dhigh, dx))


def rounded_into(x: Float[Array, "..."], low: Float[Array, ""] | float, high: Float[Array, ""] | float) -> Float[Array, "..."]:
    """`x` between `low` and `high`, which it leaves by a rounding at most where it matters: the derivative is that of `x` everywhere."""
    return x + jax.lax.stop_gradient(jnp.clip(x, low, high) - x)


def ray_box(origin: Triple, direction: Triple, lower: Corner, upper: Corner) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Distances at which a ray enters and leaves an axis-aligned box (slab method, Kay and Kajiya 1986).

    The ray misses where `t_far <= t_near`. A ray parallel to a slab is inside it always or never: there the quotient
    is not formed, so neither value nor derivative is NaN. So is a ray parallel up to the square of the machine's precision, where
    the derivative of the quotient would overflow. Differentiable in everything; the choice of the face is not.
    """
    steepest = jnp.maximum(jnp.maximum(jnp.abs(direction[0]), jnp.abs(direction[1])), jnp.abs(direction[2]))
    negligible = steepest * jnp.finfo(steepest.dtype).eps ** 2
    t_near, t_far = jnp.asarray(-jnp.inf), jnp.asarray(jnp.inf)
    for o, d, low, high in zip(origin, direction, lower, upper, strict=True):
        parallel = jnp.abs(d) <= negligible
        inverse = 1.0 / jnp.where(parallel, 1.0, d)
        first, second = (low - o) * inverse, (high - o) * inverse
        inside = (o >= low) & (o <= high)
        enter = jnp.where(parallel, jnp.where(inside, -jnp.inf, jnp.inf), smaller(first, second))
        leave = jnp.where(parallel, jnp.where(inside, jnp.inf, -jnp.inf), larger(first, second))
        t_near, t_far = larger(t_near, enter), smaller(t_far, leave)
    return t_near, t_far


def materialise(mask: Bool[Array, "..."], x: Tree) -> Tree:
    """A fusion barrier: `x` itself, which the CPU compiler then computes once and not again in each kernel that reads it.

    A conditional is the one thing that it does not fuse through (an optimization barrier does not survive it). `mask` has
    an element that is true whenever `x` matters, which the compiler cannot know; where none is, zeros are returned.

    Under `vmap` one element in the whole batch is enough: a condition for each of the batch would make a selection of the conditional,
    through which the compiler fuses, and where kernels round a position on either side of a voxel, one reads another voxel than those
    that the weights of the other belong to.
    """
    return jax.lax.cond(unvmap_any(mask), lambda x: x, lambda x: jax.tree.map(jnp.zeros_like, x), x)


def read_at(array: Shaped[Array, "n"], index: Int[Array, "..."]) -> Shaped[Array, "..."]:
    """`array[index]` for indices that the caller keeps inside: nothing is wrapped or clamped.

    Numbers of a large array are best read one at a time, even where they lie side by side: the CPU compiler makes one kernel of the reads
    and what is done with the numbers, with the processor's own gathers; a run is read by a loop into memory.
    """
    numbers = jax.lax.GatherDimensionNumbers((), (0,), (0,))
    return jax.lax.gather(array, index[..., None], numbers, (1,), mode="promise_in_bounds")


def read_run(array: Shaped[Array, "n *row"], start: Int[Array, ""], length: int) -> Shaped[Array, "length *row"]:
    """`array[start : start + length]` for a traced `start` that the caller keeps inside: nothing is clamped."""
    numbers = jax.lax.GatherDimensionNumbers(tuple(range(array.ndim)), (), (0,))
    sizes = (length, *array.shape[1:])
    return jax.lax.gather(array, start[None], numbers, sizes, mode="promise_in_bounds")


def add_runs(
    array: Float[Array, "n *row"], starts: Int[Array, "runs"], terms: Float[Array, "runs length *row"]
) -> Float[Array, "n *row"]:
    """Adds `terms[i]` to `array[starts[i] : starts[i] + length]` for every `i`; runs may overlap and must lie inside."""
    numbers = jax.lax.ScatterDimensionNumbers(tuple(range(1, terms.ndim)), (), (0,))
    return jax.lax.scatter_add(array, starts[:, None], terms, numbers, mode="promise_in_bounds")
