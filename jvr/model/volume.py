"""The scalar volume: voxels, where they lie in the world, and how values between them are defined."""

import dataclasses
import functools
from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, UInt8

from jvr.execution.devices import once, spread
from jvr.model.bricks import Bricks, bricks_of
from jvr.model.checks import affine, require
from jvr.model.exact import Exact, Remainder
from jvr.model.interpolation import AbstractInterpolation, Tricubic, Trilinear, spline_coefficients
from jvr.model.kept import is_made_of, made_by, note_sources
from jvr.model.packing import Squares, squares_of
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import AbstractPart, PlanEntry
from jvr.model.voxels import VOXEL, as_missing, in_memory, masked_voxels, typical_range, without_gaps
from jvr.numerics import add_runs, inverse_of_axes, read_at, read_run, transformed, turned
from jvr.types import Affine, ArrayLike, Scalar, Triple, Vector, Voxels


class Volume(AbstractPart):
    """A scalar field sampled on a regular, possibly oblique and anisotropic grid.

    Voxel `(i, j, k)` of `values[i, j, k]` sits at `world_from_grid @ (i, j, k, 1)`; the domain is the hull of the samples,
    index 0 ... n-1 on each axis (-1/2 ... 1/2 where n = 1), and outside of it there is nothing. The scalar at a point is
    `s = slope * v + intercept`, with `v` the interpolated voxels: the unit that transfer functions use.

    **Arguments:**

    - `values`: shape `(x, y, z)`, floating point (differentiable) or integer (kept as it is in memory, not differentiable); what NumPy
      holds, too: any byte order, truth values, integers of 64 bits as narrow as they fit.
    - `world_from_grid`: 4x4 affine, default the identity.
    - `slope`, `intercept`: scalars, default 1 and 0, as DICOM's rescale.
    - `interpolation`: `Trilinear()` (default), `Tricubic()` or `Nearest()`.
    - `missing`: the stored number that means "no data", such as -2000; NaN voxels mean that by themselves, and so do, with
      a warning, those beyond 1e30. A sample that is made of such a
      voxel is empty, and neither the range of values nor gradients know of it: `values` holds what lies around in its place.
    - `unit`: of the data, such as "HU", where that is known; only said.
    - `remainder`: of a `world_from_grid` that JAX holds already: what single precision leaves of one that was given in double precision
      (see `jvr.model.exact`). Positions of cameras, lights and clipping boxes are taken relative to the volume before they are rounded.

    - `gaps`: which voxels are missing beside those, as another volume has them: non-zero, or odd, where one is.

    A masked array of NumPy has its masked voxels missing.
    `dataclasses.replace(volume, slope=2.0)` makes a volume that differs in that, as `equinox.tree_at` does.

    `bricks`, `squares`, `gradients` and `sobel_gradients` are `None` until `bricked()`, `packed()`, `graded()` and `graded_by_sobel()` make
    them. What has been replaced since is
    never seen in their place: `current()` makes them anew where they are not known to belong to the voxels. `gaps` says which voxels are
    missing (bit 0; bit 1: which cells of eight have one that is), `None` where none is; voxels that are replaced keep it.

    **Raises** `ValueError` for another number of dimensions, an empty array, infinite or only missing voxels, integers beyond 32 bits, a
    singular transform, a slope of zero, a slope or intercept that is not finite, `TypeError` for voxels that are not real numbers. Warns
    where single precision loses what sets voxels apart. Everything but `interpolation` is an array and differentiable.
    """

    values: Voxels
    world_from_grid: Affine
    slope: Scalar = parameter(doc="scalar for each unit of a voxel, not 0")
    intercept: Scalar = parameter(doc="scalar where a voxel is 0")
    interpolation: AbstractInterpolation = parameter(doc="jvr.Trilinear() or jvr.Nearest()")
    bricks: Bricks | None = eqx.field(init=False, metadata=made_by("bricked"))
    squares: Squares | None = eqx.field(init=False, metadata=made_by("packed"))
    gradients: Float[Array, "x y z 3"] | None = eqx.field(init=False, metadata=made_by("graded"))
    sobel_gradients: Float[Array, "x y z 3"] | None = eqx.field(init=False, metadata=made_by("graded_by_sobel"))
    gaps: UInt8[Array, "x y z"] | None = parameter(doc="which voxels are missing")
    remainder: Remainder = parameter(doc="what single precision leaves of world_from_grid")
    unit: str = choice(doc="of the data, such as HU")
    missing: float | int | None = choice(doc="stored number that means that there are no data")

    def __init__(
        self,
        values: ArrayLike,
        world_from_grid: ArrayLike | None = None,
        *,
        slope: ArrayLike = 1.0,
        intercept: ArrayLike = 0.0,
        interpolation: AbstractInterpolation = Trilinear(),
        missing: float | int | None = None,
        unit: str = "",
        remainder: Remainder | None = None,
        gaps: ArrayLike | None = None,
    ):
        masked, missing = masked_voxels(values), as_missing(missing)
        values = in_memory(values)
        if values.ndim != 3 or values.size == 0:
            thick = (
                ": give values[:, :, None]" if values.ndim == 2 else ": choose one of the last axis" if values.ndim > 3 else ""
            )
            raise ValueError(f"a volume needs three non-empty axes (x, y, z); its voxels have shape {values.shape}{thick}")
        if values.size >= 2**31:
            raise ValueError(
                f"{values.shape} is {values.size:,} voxels; 2^31 voxels and more do not fit 32-bit indices: crop or coarsen"
            )
        if not (jnp.issubdtype(values.dtype, jnp.floating) or jnp.issubdtype(values.dtype, jnp.integer)):
            raise TypeError(f"voxels must be real or integer numbers, not {values.dtype}")
        self.values, self.gaps = jax.tree.map(spread, without_gaps(values, missing, masked, gaps))
        if jnp.issubdtype(values.dtype, jnp.floating):
            require(
                self.values, lambda v: ~np.isinf(v), "voxels must not be infinite: replace them, by NaN where there are no data"
            )
        world_from_grid = jnp.eye(4) if world_from_grid is None else world_from_grid
        self.world_from_grid = affine(world_from_grid, "world_from_grid")
        self.remainder = Remainder.left(world_from_grid, self.world_from_grid, remainder)
        assign(self, slope=slope, intercept=intercept, interpolation=interpolation)
        require(self.slope, lambda x: x != 0, "slope must be finite and not 0")
        self.unit = unit
        # Without gaps it says nothing, and would be a reason to compile anew.
        self.missing = None if self.gaps is None else missing
        self.bricks = None
        self.squares = None
        self.gradients = None
        self.sobel_gradients = None

    def bricked(self, size: int = 4) -> "Volume":
        """The same volume with the bounds of its bricks of `size^3` voxels, which empty-space skipping needs; without them each
        picture computes them anew, as it does inside of your own `jit` where voxels are an argument (`current`): there close over the
        volume. They take `2 / size^3` of the voxels' memory. **Raises** `ValueError` where `size` is below 1.
        """
        if isinstance(size, bool) or not isinstance(size, int) or size < 1:
            raise ValueError(f"the size of a brick must be a positive whole number of voxels, not {size!r}; 4 is a good start")
        volume = self._spread()
        bricks = once(lambda values: _bricks(values, size), jax.lax.stop_gradient(volume.values))
        note_sources(bricks.lower, volume.values)
        return eqx.tree_at(lambda v: v.bricks, volume, bricks, is_leaf=lambda x: x is None)

    def packed(self) -> "Volume":
        """The same volume with its voxels packed for interpolation as well: faster pictures and fits, for 4 more bytes a voxel.

        `uint8` voxels are kept as they are. Others are rounded to 256 levels of their range, an error of at most 1/510 of it, and are no
        longer differentiable; `slope` and `intercept` make up for it, so that `s` means the same. Single voxels that lie far beyond all
        others, which would leave few levels for these, become the nearest level.
        **Raises** `ValueError` unless interpolation is trilinear.
        """
        if not isinstance(self.interpolation, Trilinear):
            raise ValueError("only trilinear interpolation reads packed voxels: set Volume(interpolation=jvr.Trilinear())")
        volume = self._spread() if self.values.dtype == jnp.uint8 else _quantised(self)
        squares = once(_squares, volume.values)
        note_sources(squares.entries, volume.values)
        return eqx.tree_at(lambda v: v.squares, volume, squares, is_leaf=lambda x: x is None).current()

    def prefiltered(self) -> "Volume":
        """The volume whose tricubic B-spline goes through the voxels: its voxels are the spline's coefficients, in floating point and
        differentiable in those. They may exceed the range of the voxels, and so may values between these.

        Only for `Tricubic()`: other interpolation would show the coefficients. **Raises** `ValueError` for that, and where voxels are
        missing.
        """
        if not isinstance(self.interpolation, Tricubic):
            raise ValueError("coefficients are those of a tricubic spline: set Volume(interpolation=jvr.Tricubic())")
        if self.gaps is not None:
            raise ValueError("voxels are missing, and a spline goes through all: fill them in, or leave prefiltered() out")
        return dataclasses.replace(self, values=spline_coefficients(self.values.astype(self.slope.dtype)))

    def graded(self) -> "Volume":
        """The same volume with the gradients at its voxels, which `jvr.PrecomputedGradient()` interpolates; without them each picture
        computes them anew, as it does where voxels, slope or intercept are differentiated or arguments of `jit` (`current`). They take
        12 bytes a voxel."""
        return self._graded(lambda v: v.gradients, sobel=False)

    def graded_by_sobel(self) -> "Volume":
        """The same with gradients that are smoothed as Sobel's differences are, for `jvr.PrecomputedGradient(sobel=True)`."""
        return self._graded(lambda v: v.sobel_gradients, sobel=True)

    def _graded(self, place: Any, *, sobel: bool) -> "Volume":
        volume = self._spread()
        arrays = volume.values, volume.slope, volume.intercept
        gradients = once(partial(_gradients, sobel=sobel), *arrays)
        note_sources(gradients, *arrays)
        return eqx.tree_at(place, volume, gradients, is_leaf=lambda x: x is None)

    def _spread(self) -> "Volume":
        """The same volume with its voxels on all devices, also those that took the place of others (`equinox.tree_at`)."""
        values = spread(self.values)
        return self if values is self.values else eqx.tree_at(lambda v: v.values, self, values)

    def current(self) -> "Volume":
        """The same volume with what it keeps made anew where voxels, slope or intercept are not the very arrays that it was made of.

        What draws a volume begins here, so that a part may be replaced like any other. Concrete arrays are told apart by identity, at no
        cost. Traced ones are not: there bricks and gradients are made for each picture, the latter with their derivative, and squares
        where they do not hold the voxels.
        """
        volume = self._spread()
        if any(isinstance(x, Tracer) for x in (self.values, self.slope, self.intercept)):
            return volume._current()
        # Within a traced function that closes over them they are constants, and the compiler would take seconds to fold all of this.
        with jax.ensure_compile_time_eval():
            return volume._current()

    def _current(self) -> "Volume":
        volume = self
        if self.bricks is not None and not is_made_of(self.bricks.lower, self.values):
            volume = volume.bricked(self.bricks.size)
        of = self.values, self.slope, self.intercept
        if self.gradients is not None and not is_made_of(self.gradients, *of):
            volume = volume.graded()
        if self.sobel_gradients is not None and not is_made_of(self.sobel_gradients, *of):
            volume = volume.graded_by_sobel()
        if self.squares is None or is_made_of(self.squares.entries, self.values):
            return volume
        fits = self.values.dtype == jnp.uint8 and self.values.shape == self.squares.entries.shape
        squares = once(_squares_if_other, self.values, self.squares) if fits else None
        if squares is not None:
            note_sources(squares.entries, self.values)
        return eqx.tree_at(lambda v: v.squares, volume, squares)

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        voxels = f"{'x'.join(map(str, self.shape))} {self.values.dtype}, {type(self.interpolation).__name__.lower()}"
        return (PlanEntry(name, True, f"{voxels}, a sample every {settings.step:g} voxels"),)

    def _repr_html_(self) -> str:
        """What notebooks show: the middle slices."""
        from jvr.model.html import volume_html

        return volume_html(self)

    @property
    def shape(self) -> tuple[int, int, int]:
        nx, ny, nz = self.values.shape
        return nx, ny, nz

    @property
    def spacing(self) -> Vector:
        """World length of one voxel along each grid axis, `(3,)`."""
        return jnp.linalg.norm(self.world_from_grid[:3, :3], axis=0)

    @property
    def origin(self) -> Exact:
        """World position of voxel (0, 0, 0)."""
        return Exact(self.world_from_grid[:3, 3], self.remainder.beside(self.world_from_grid)[:3, 3])

    def moved(self, origin: Exact) -> "Volume":
        """The same volume in a world whose origin is at `origin`."""
        matrix = self.world_from_grid.at[:3, 3].set(self.origin.minus(origin).rounded())
        return eqx.tree_at(lambda v: (v.world_from_grid, v.remainder), self, (matrix, Remainder.left(matrix, matrix)))

    @property
    def center(self) -> Vector:
        """World position of the middle of the domain, `(3,)`."""
        middle = (jnp.asarray(self.shape, self.world_from_grid.dtype) - 1) / 2
        return self.world_from_grid[:3, :3] @ middle + self.world_from_grid[:3, 3]

    @property
    def radius(self) -> Scalar:
        """World distance from the centre to the farthest corner of the domain, `()`."""
        extent = jnp.maximum(jnp.asarray(self.shape, self.world_from_grid.dtype) - 1, 1) / 2
        corners = jnp.stack(jnp.meshgrid(*[jnp.array([-1.0, 1.0])] * 3, indexing="ij"), -1).reshape(8, 3) * extent
        return jnp.max(jnp.linalg.norm(corners @ self.world_from_grid[:3, :3].T, axis=-1))

    @property
    def domain(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Lower and upper corner of the domain in grid coordinates."""
        lower, upper = zip(*[(0.0, n - 1.0) if n > 1 else (-0.5, 0.5) for n in self.shape], strict=True)
        return lower, upper

    def sample(self, p: Triple, *, in_runs: bool = False) -> Scalar:
        """The scalar `s` at one grid position `p`; positions outside of the domain are the caller's to exclude. `in_runs`: how voxels are
        read (see `interpolate`)."""
        return self.slope * self.interpolate(p, in_runs=in_runs) + self.intercept

    def interpolate(self, p: Triple, *, in_runs: bool = False) -> Scalar:
        """The stored voxels interpolated at one grid position, before slope and intercept.

        Voxels are read one at a time, within the kernel that makes the one number of them. With `in_runs` they are read into memory, so
        that several numbers, such as a gradient, are made of them and the compiler does not read anew for each.
        """
        if self.squares is not None:
            return self.squares.interpolate(p)
        voxels, value = self.values.reshape(-1), jnp.zeros_like(p[0])
        for start, weights in self.interpolation.stencil(self.shape, p):
            n = len(weights)
            run = read_run(voxels, start, n) if in_runs else [read_at(voxels, start + i) for i in range(n)]
            value += sum(w * run[i].astype(w.dtype) for i, w in enumerate(weights))
        return value

    def data(self) -> np.ndarray:
        """The stored voxels that hold data, `(n,)`, of concrete arrays."""
        values = np.asarray(self.values).reshape(-1)
        return values if self.gaps is None else values[np.asarray(self.gaps).reshape(-1) & VOXEL == 0]

    def is_known(self, p: Triple) -> Bool[Array, ""]:
        """Whether no voxel that makes the value at one grid position is missing; a volume without gaps has no use for it."""
        assert self.gaps is not None
        gaps, runs = self.gaps.reshape(-1), self.interpolation.stencil(self.shape, p)
        is_missing = lambda index: read_at(gaps, index) & self.interpolation.gap != 0
        if not self.interpolation.reach:
            # Of a cell its first voxel says what all of them are.
            return ~is_missing(runs[0].start)
        each = [is_missing(run.start + i) & (w != 0) for run in runs for i, w in enumerate(run.weights)]
        return ~functools.reduce(jnp.logical_or, each)

    def grid_from_world(self, x: Triple, *, direction: bool = False) -> Triple:
        """Grid position of a world position, or with `direction=True` grid displacement of a world displacement."""
        if not direction:
            x = tuple(x[i] - self.world_from_grid[i, 3] for i in range(3))
        return turned(self.axes_inverse, x)

    def world_from_point(self, p: Triple) -> Triple:
        """World position of a grid position."""
        return transformed(self.world_from_grid, p)

    @property
    def axes_inverse(self) -> Float[Array, "3 3"]:
        """Inverse of the linear part of `world_from_grid`; its transpose takes derivatives along the grid's axes to the world."""
        return inverse_of_axes(self.world_from_grid[:3, :3])

    def deposit(self, total: "Volume", p: Triple, of_value: Float[Array, "points"], of_gradient: Triple = ()) -> "Volume":
        """Adds the derivative of `sum(of_value * s + of_gradient . grad s)` over a batch of grid positions to `total`, in place where
        the compiler can. Only voxels, slope and intercept are asked for, where their leaf of `total` is not `None`."""
        # A cotangent of the gradient is one of the value's derivative along a direction: `d/de s(p + e c)`.
        along = lambda f: jax.vmap(lambda p, c: jax.jvp(f, (p,), (c,)))(p, of_gradient)
        if total.values is not None:
            flat = total.values.reshape(-1)
            stencil = lambda p: self.interpolation.stencil(self.shape, p)
            runs = jax.vmap(stencil)(p)
            moved = along(lambda p: [run.weights for run in stencil(p)])[1] if of_gradient else [()] * len(runs)
            for (starts, weights), changes in zip(runs, moved, strict=True):
                terms = [w * of_value for w in weights]
                terms = [t + change for t, change in zip(terms, changes, strict=True)] if changes else terms
                flat = add_runs(flat, starts, (self.slope * jnp.stack(terms, axis=1)).astype(flat.dtype))
            total = eqx.tree_at(lambda v: v.values, total, flat.reshape(self.shape))
        if total.slope is not None:
            # A point without a cotangent may be at a voxel that is NaN.
            term = jnp.sum(jnp.where(of_value == 0, 0.0, jax.vmap(self.interpolate)(p) * of_value))
            if of_gradient:
                none = functools.reduce(jnp.logical_and, [c == 0 for c in of_gradient])
                term += jnp.sum(jnp.where(none, 0.0, along(self.interpolate)[1]))
            total = eqx.tree_at(lambda v: v.slope, total, total.slope + term)
        if total.intercept is not None:
            total = eqx.tree_at(lambda v: v.intercept, total, total.intercept + jnp.sum(of_value))
        return total


def gradients_at_voxels(values: Float[Array, "x y z"], *, sobel: bool = False) -> Float[Array, "x y z 3"]:
    """Central differences along the grid's axes, one-sided at the border; zero along an axis of one voxel. With `sobel` each is averaged
    along both other axes with weights 1, 2, 1."""
    along = [jnp.gradient(values, axis=a) if n > 1 else jnp.zeros_like(values) for a, n in enumerate(values.shape)]
    if sobel:
        others = [[other for other in range(3) if other != a] for a in range(3)]
        along = [smoothed(jnp.asarray(g), (1, 2, 1), axes) for g, axes in zip(along, others, strict=True)]
    return jnp.stack([jnp.asarray(g) for g in along], axis=-1)


def smoothed(values: Float[Array, "x y z"], weights: Sequence[int], axes: Sequence[int] = (0, 1, 2)) -> Float[Array, "x y z"]:
    """Averages along some axes with an odd number of weights; the border is repeated."""
    reach, total = len(weights) // 2, sum(weights)
    for axis in axes:
        n = values.shape[axis]
        if n > 1:
            padded = jnp.pad(values, [(reach, reach) if a == axis else (0, 0) for a in range(3)], mode="edge")
            parts = (w / total * jax.lax.slice_in_dim(padded, k, k + n, axis=axis) for k, w in enumerate(weights))
            values = sum(parts, jnp.zeros_like(values))
    return values


_bricks = jax.jit(bricks_of, static_argnums=1)
_squares = jax.jit(squares_of)


@partial(jax.jit, static_argnames="sobel")
def _gradients(values: Voxels, slope: Scalar, intercept: Scalar, *, sobel: bool) -> Float[Array, "x y z 3"]:
    return gradients_at_voxels(values.astype(slope.dtype) * slope + intercept, sobel=sobel)


@jax.jit
def _squares_if_other(values: Voxels, squares: Squares) -> Squares:
    """The squares of these voxels: the concrete ones where they hold the same."""
    same = jnp.all((squares.entries & 255).astype(jnp.uint8) == values)
    return jax.lax.cond(same, lambda: squares, lambda: squares_of(values))


def _quantised(volume: Volume) -> Volume:
    """The volume with `uint8` voxels."""
    values, kind = jax.lax.stop_gradient(volume.values), volume.slope.dtype
    traced = isinstance(values, Tracer)
    ends = (jnp.min(values).astype(kind), jnp.max(values).astype(kind)) if traced else typical_range(volume.data())
    low, high = map(jnp.asarray, ends)
    scale = jnp.where(high > low, (high - low) / 255, 1.0)
    level = lambda values: jnp.clip(jnp.round((values.astype(kind) - low) / scale), 0, 255).astype(jnp.uint8)
    levels = once(level, values)
    slope, intercept = volume.slope * scale, volume.slope * low + volume.intercept
    # A level that happens to be the number of missing voxels is none of them.
    quantised = dataclasses.replace(volume, values=levels, slope=slope, intercept=intercept, missing=None)
    kept = lambda v: (v.bricks, v.gradients, v.sobel_gradients)
    return eqx.tree_at(kept, quantised, kept(volume), is_leaf=lambda x: x is None)
