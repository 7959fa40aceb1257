"""Glossary of symbols and the array types that carry them.

| symbol | meaning |
|---|---|
| `s` | scalar value of the volume at a point, in the data's own units (HU, ...) |
| `x`, `t`, `dt` | world position; distance along a unit-direction ray; step length (world length) |
| `p` | position in grid coordinates: voxel `(i, j, k)` sits at `p = (i, j, k)` |
| `sigma_t` | extinction, 1 / world length; one value, or one per colour channel |
| `rgb` | source colour of the medium: the radiance that it emits per unit of opacity |
| `tau`, `dtau` | optical depth so far; of one segment |
| `T`, `alpha` | transmittance `exp(-tau)`; `1 - T` |
| `L` | radiance, linear RGB |
| `world_from_grid` | 4x4 affine; names of transforms read right to left |

Values that live on a ray travel as tuples of arrays, one array for each component (structure of arrays):
XLA then keeps every component contiguous, which on CPUs is several times faster than `(rays, 3)`.
"""

import enum
from collections.abc import Sequence
from typing import Any, TypeAlias

import jaxtyping
from jaxtyping import Array, Float, Num

# What constructors convert to an array: jaxtyping's own alias leaves out lists and tuples of numbers.
ArrayLike: TypeAlias = jaxtyping.ArrayLike | Sequence[Any]

Scalar: TypeAlias = Float[Array, ""]
Vector: TypeAlias = Float[Array, "3"]
Affine: TypeAlias = Float[Array, "4 4"]
Voxels: TypeAlias = Num[Array, "x y z"]
Image: TypeAlias = Float[Array, "height width 3"]

# One component for each colour channel, or a single one that serves all three.
Channels: TypeAlias = tuple[Float[Array, "..."], ...]
# Three components. Not spelled out: a type checker cannot count what a comprehension makes.
Triple: TypeAlias = tuple[Float[Array, "..."], ...]
# Corners of a box, known when the program is compiled or traced.
Corner: TypeAlias = Triple | tuple[float, ...]


class Outcome(enum.Enum):
    """How an iteration ended."""

    CONVERGED = "converged"
    STEP_LIMIT = "step limit reached"
    STALLED = "stalled: no step lowers the objective, although it is not at its bottom; the best iterate is kept"
    NON_FINITE = "non-finite value met; the last good iterate is kept"
    INTERRUPTED = "interrupted; the last good iterate is kept"
