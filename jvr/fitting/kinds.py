"""Kinds of unknowns: how each acts on a picture, and so which way its derivative comes.

That is told by where an array is in the scene and by what its class declares (`jvr.model.parameters`), never by its name: an array of a
class that nobody has thought of is differentiated in forward mode through the whole march.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.fitting.problem import Problem, read_after_march
from jvr.fitting.unknowns import ExposedModel
from jvr.march.differentiation import AbstractAdjoint, Forward, Rows
from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTable


class TableEntries(NamedTuple):
    """Indices of a table's colours, extinctions and emissions in the vector of all unknowns, in the shape of each, `None` where they are
    known."""

    rgb: np.ndarray | None = None
    sigma_t: np.ndarray | None = None
    emission: np.ndarray | None = None


class OfViews(NamedTuple):
    """Unknown cameras: each ray depends on those of its own view alone, so that one direction serves all views.

    - `shapes`: of the fields in question, by name.
    - `columns`: for each view and direction the index of the unknown in the vector of all, their number where that view's is known,
      `(views, directions)`.
    """

    shapes: dict[str, tuple[int, ...]]
    columns: np.ndarray

    def basis(self, dtype: Any) -> dict[str, Array]:
        """The directions: a shift of every field, with a leading axis."""
        sizes = [int(np.prod(shape)) for shape in self.shapes.values()]
        parts = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1], axis=1)
        return {
            name: jnp.asarray(part.reshape(-1, *shape), dtype)
            for (name, shape), part in zip(self.shapes.items(), parts, strict=True)
        }


class Kinds(NamedTuple):
    """Indices of the unknowns in the vector of all by how they act: as `entries` of a table (rows), after the march (`outer`), or inside
    it (`inner`). `directions`: indices in `inner` that are moved together, one for each channel of the picture. `of_views`: of cameras,
    `None` where these are known."""

    problem: Problem
    entries: TableEntries
    outer: np.ndarray
    inner: np.ndarray
    directions: np.ndarray
    of_views: OfViews | None

    @classmethod
    def of(cls, problem: Problem) -> "Kinds":
        unknowns, model = problem.unknowns, problem.model
        after, in_table = _after_march(problem), _in_table(problem)
        entries, places, starts = TableEntries(), unknowns.seen_from(model), {}
        outer, inner, directions = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros((0, 3), int)]
        begin, taken = 0, 0
        for i, array in enumerate(unknowns.values(model)):
            indices = np.arange(begin, begin + array.size)
            begin += array.size
            if i in in_table:
                entries = entries._replace(**{in_table[i]: indices.reshape(array.shape)})
            elif i in places:
                starts[i] = int(indices[0])
            elif i in after:
                outer.append(indices)
            else:
                inner.append(indices)
                own = taken + np.arange(array.size)
                taken += array.size
                # A colour of light is seen in that colour alone: one march for all three.
                apart = unknowns.by_channel[i] and array.shape[-1:] == (3,)
                directions.append(own.reshape(-1, 3) if apart else np.repeat(own[:, None], 3, axis=1))
        of_views = _of_views(problem, places, starts) if places else None
        return cls(problem, entries, np.concatenate(outer), np.concatenate(inner), np.concatenate(directions), of_views)

    def basis(self, dtype: Any) -> Float[Array, "directions inner"]:
        """`directions` as vectors."""
        vectors = np.zeros((len(self.directions), self.inner.size))
        np.put_along_axis(vectors, self.directions, 1.0, axis=1)
        return jnp.asarray(vectors, dtype)

    def changed(self, part: Array, values: Float[Array, "unknowns"], indices: np.ndarray | None = None) -> ExposedModel:
        """The model of `values` with `part` at some indices, by default those of `inner`. Arrays that hold none of them do not depend on
        `part`."""
        unknowns, model = self.problem.unknowns, self.problem.model
        where = {int(k): i for i, k in enumerate(self.inner if indices is None else indices)}
        arrays, begin = [], 0
        for array in unknowns.split(values, model):
            first = where.get(begin)
            begin += array.size
            arrays.append(array if first is None else part[first : first + array.size].reshape(array.shape))
        return unknowns.insert(model, arrays)


def _of_views(problem: Problem, places: dict[int, list[tuple[str, int]]], starts: dict[int, int]) -> OfViews:
    """`places`: fields and views of each unknown array of cameras; `starts`: where its values are in the vector of all."""
    values = problem.unknowns.values(problem.model)
    shapes = {field: values[i].shape for i, found in places.items() for field, _ in found}
    views = problem.model.views
    assert views is not None
    columns = {
        name: np.full((len(views.cameras), int(np.prod(shape))), sum(v.size for v in values)) for name, shape in shapes.items()
    }
    for i, found in places.items():
        for field, view in found:
            columns[field][view] = starts[i] + np.arange(values[i].size)
    return OfViews(shapes, np.concatenate(list(columns.values()), axis=1))


def march_unknowns(problem: Problem) -> int:
    """How many derivatives are taken by forward mode, at the cost of a march each."""
    return len(Kinds.of(problem).directions)


def adjoint_of(problem: Problem) -> AbstractAdjoint:
    """How the whole residual vector is differentiated."""
    # Rows do not know light that changes on its way: that of an environment, through a radiance transfer; ambient light.
    of_scene = lambda s: (s.environment, s.environment_lights, s.radiance_transfer)
    around = lambda m: (() if m.scene.radiance_transfer is None else of_scene(m.scene), m.scene.occlusion)
    known = _has_rows(problem) and not problem.unknowns.among(problem.model, around) and problem.model.views is None
    return Rows() if known else Forward()


def _has_rows(problem: Problem) -> bool:
    return problem.marches and has_table_jacobian(problem.model.scene)


def _after_march(problem: Problem) -> frozenset[int]:
    """Which unknowns act on what a march has gathered, and not on the way."""
    return problem.unknowns.among(problem.model, read_after_march) if problem.marches else frozenset()


def has_table_jacobian(scene: Scene) -> bool:
    """Whether entries of the transfer function act through what a sample is classified as, and nothing else."""
    by_gradient = scene.needs_gradient and scene.normals.follows_transfer(scene.volume)
    precomputable = [getattr(scene, field) for field in scene.precomputable]
    shade = scene.shadows is not None or any(not part.is_frozen or part.reads_transfer for part in precomputable)
    return isinstance(scene.transfer, AbstractTable) and not shade and not by_gradient


def _in_table(problem: Problem) -> dict[int, str]:
    """Which unknowns are entries of a table, and of which of its fields, where their derivatives come by rows."""
    if not _has_rows(problem):
        return {}
    transfer = problem.model.scene.transfer
    assert isinstance(transfer, AbstractTable)
    of = lambda name: problem.unknowns.among(problem.model, lambda m: getattr(m.scene.transfer, name))
    return {i: name for name in transfer.entries for i in of(name)}
