"""Nodes of a coarse grid over a volume, at each of which something is computed once: some at a time, and only near what can be seen."""

import abc
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jvr.execution.devices import over_rays, shares
from jvr.execution.tiles import dealt, joined
from jvr.march.medium import Medium
from jvr.march.rules import perturbed
from jvr.model.grids import Shape, node_positions
from jvr.model.scene import Scene
from jvr.model.volume import Volume


class AbstractProjection(eqx.Module):
    """All that is needed to compute what the nodes of a scene hold. `medium`: what rays pass that are sent out from them."""

    volume: eqx.AbstractVar[Volume]
    medium: eqx.AbstractVar[Medium]
    # Nodes that are computed together.
    chunk: ClassVar[int] = 256
    # How many nodes away a visible point may be that makes a node worth it.
    reach_of_nodes: ClassVar[int] = 1

    @property
    @abc.abstractmethod
    def shape(self) -> Shape:
        """Nodes along each axis; the first and the last of them lie at the border of the volume."""

    @abc.abstractmethod
    def project(self, p: Float[Array, "nodes 3"]) -> tuple[Array, ...]:
        """What nodes at grid positions hold, arrays with a leading axis of nodes; zero says that nothing was computed."""

    @property
    def positions(self) -> Float[np.ndarray, "nodes 3"]:
        """Grid positions of all nodes."""
        return node_positions(self.volume, self.shape)

    def nodes(self, index: Int[Array, "nodes"]) -> tuple[Array, ...]:
        """What some nodes hold, a chunk at a time."""
        fill = -index.shape[0] % self.chunk
        chunks = jnp.pad(jnp.asarray(self.positions)[index], ((0, fill), (0, 0)), mode="edge").reshape(-1, self.chunk, 3)
        found = jax.lax.map(lambda p: self.project(p), chunks)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[: index.shape[0]], found)

    def active(self) -> Bool[Array, "nodes"]:
        """Nodes with something visible no further away than so many nodes."""
        p, occupancy = jnp.asarray(self.positions), self.medium.occupancy
        if occupancy is None:
            return jnp.ones(p.shape[0], bool)
        bricks = occupancy.empty_radius.shape
        b = [jnp.clip((p[:, i] / occupancy.size).astype(jnp.int32), 0, n - 1) for i, n in enumerate(bricks)]
        near = max((n - 1) / max(m - 1, 1) for n, m in zip(self.volume.shape, self.shape, strict=True))
        return occupancy.empty_radius[b[0], b[1], b[2]] <= math.ceil(self.reach_of_nodes * near / occupancy.size)

    def all_nodes(self) -> tuple[Array, ...]:
        """`project_all` of those that are active."""
        return project_all(self, self.active())


def seen_around(scene: Scene, medium: Medium) -> Medium:
    """The medium around nodes that are worth it near what is visible of it, and everywhere where surfaces may show what they hold."""
    return medium if scene.surfaces is None else medium._replace(occupancy=None)


def surfaces_of(scene: Scene) -> Bool[np.ndarray, "1"]:
    """Whether `seen_around` has every node computed, as a source of what is kept of them."""
    return np.array([scene.surfaces is not None])


def project_all(projection: AbstractProjection, active: Bool[Array, "nodes"]) -> tuple[Array, ...]:
    """What all nodes hold, zero where they are not `active`; chunks without an active node are left out. Traceable."""
    p, chunk_size = projection.positions, projection.chunk
    fill = -len(p) % chunk_size
    chunks = jnp.asarray(np.pad(p, ((0, fill), (0, 0)), mode="edge").reshape(-1, chunk_size, 3))
    busy = jnp.pad(active, (0, fill)).reshape(-1, chunk_size)
    # Not the bound method: JAX hashes what it is to call, and Equinox all that a method is bound to.
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(lambda p: projection.project(p), chunks[0]))

    def share(projection: AbstractProjection, inputs: tuple[Array, Array]) -> Any:
        def chunk(inputs: tuple[Array, Array]) -> Any:
            p, busy = inputs
            found = jax.lax.cond(jnp.any(busy), lambda p: projection.project(p), lambda p: blank, p)
            return jax.tree.map(lambda x: jnp.where(busy.reshape(-1, *(1,) * (x.ndim - 1)), x, jnp.zeros_like(x)), found)

        return jax.lax.map(chunk, inputs)

    order = dealt(len(chunks), shares())
    found = joined(over_rays(share, projection, (chunks[order], busy[order])), len(chunks), shares())
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[: len(p)], found)


@jax.custom_jvp
def visible_nodes(projection: AbstractProjection) -> tuple[Array, ...]:
    """What the active nodes of a scene hold. Where it is differentiated all of them do: what is not visible may become so, and has a
    derivative in the light that reaches it."""
    return projection.all_nodes()


def _visible_nodes_rule(primals: Any, tangents: Any) -> tuple[Any, Any]:
    tangents = perturbed(primals, tangents)
    moving, still = eqx.partition(primals, jax.tree.map(lambda t: t is not None, tangents, is_leaf=lambda t: t is None))

    def whole(moving: Any) -> tuple[Array, ...]:
        (projection,) = eqx.combine(moving, still)
        return project_all(projection, jnp.ones(math.prod(projection.shape), bool))

    return jax.jvp(whole, (moving,), (tangents,))


visible_nodes.defjvp(_visible_nodes_rule, symbolic_zeros=True)
