"""What depends on neither camera nor light, computed once: projected materials and radiance transfer, kept on disk by their content."""

import dataclasses
import hashlib
import os
import time
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jvr.atomic import replacing
from jvr.execution.devices import everywhere, over_rays, shares
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.rendering.medium import absorbing, occupancy
from jvr.rendering.settings import Settings

# Changes whenever what is computed from the same inputs does: what was kept before is then of no use.
VERSION = 3
# Order that materials are kept at under an environment of a lower one.
LEAST_ORDER = 3
# Nodes in a program of their own, between two reports of progress.
TOGETHER = 2048

Progress = Callable[[float], Any]


class Precomputed(NamedTuple):
    """One part that was computed beforehand: `part`, "material" or "radiance transfer"; `seconds` that it took; `cached`, whether it was
    read from the folder; `nbytes` of its numbers."""

    part: str
    seconds: float
    cached: bool
    nbytes: int


def precompute(
    scene: Scene,
    *,
    cache: str | os.PathLike | None = None,
    progress: Progress | None = None,
    report: Callable[[Precomputed], Any] | None = None,
    keep_material: bool = False,
    keep_unscattered: bool = False,
) -> Scene:
    """The scene with its material projected on harmonics and its radiance transfer computed, so that pictures from any camera and under
    any environment do neither again. The material is kept up to order 3, or that of the environment (with an exact product, of the
    transfer) where it is higher: of an environment of a still higher order no more than that is seen.

    Both are constants from then on. After a change of the volume, the transfer function or the clipping box call it again, which computes
    what is of another scene anew (else `jvr.render` raises); a new material asks for it only with `jvr.MaterialBleeding()`. After a change
    of the settings of `radiance_transfer`, begin with a scene that has not been through here.

    **Arguments:** `cache`: a folder to keep results in, named by the content of what they were computed from; `progress`: called with the
    share that is done, 0 ... 1; `report`: called with each part once it is there; `keep_material`: leave the material as it is, and
    `keep_unscattered`: leave the scattering pass to each picture, so that material and dipole can be fitted.
    Not traceable. Warns where a result cannot be written. **Raises** `OSError` where the folder cannot be made.
    """
    if scene.environment_light is None:
        return scene
    scene = dataclasses.replace(scene, volume=scene.volume.current())
    folder = None if cache is None else Path(cache)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    report = report or (lambda done: None)
    if not keep_material:
        order = _material_order(scene)
        material = (scene.material, np.asarray(order))
        project = lambda inputs: inputs[0].projected(order)
        projected = _kept(folder, project, material, lambda: _projected(scene.material, order), "material", report)
        scene = dataclasses.replace(scene, material=projected)
    if scene.radiance_transfer is None:
        return scene
    if scene.radiance_transfer.is_frozen:
        if not scene.radiance_transfer.stale(scene):
            return scene
        scene = eqx.tree_at(lambda s: s.radiance_transfer.projected, scene, None)
    radiance_transfer = scene.radiance_transfer
    assert radiance_transfer is not None
    if keep_unscattered and radiance_transfer.scattering is not None:
        scene = eqx.tree_at(lambda s: s.radiance_transfer.scattering, scene, None)
    # The light plays no part, and the material where rays do not pick up its colour none but that it has a normal.
    plays, normal = (
        radiance_transfer.bleeding is not None and radiance_transfer.bleeding.reads_material,
        scene.material is not None and scene.material.needs_gradient,
    )
    inputs = (
        _bare(scene.volume),
        scene.transfer,
        scene.clipping,
        scene.normals,
        scene.radiance_transfer,
        scene.material if plays else np.asarray(normal),
    )
    whole = lambda _: _finished(scene, *_projection(scene).all_nodes())
    projected = _kept(
        folder, whole, inputs, lambda: _project(scene, progress or (lambda share: None)), "radiance transfer", report
    )
    return dataclasses.replace(scene, radiance_transfer=radiance_transfer.with_projected(projected))


_projected = jax.jit(lambda material, order: material.projected(order), static_argnums=1)


def _bare(volume: Volume) -> Volume:
    """The volume without what it keeps of its voxels."""
    kept = lambda v: (v.bricks, v.squares, v.gradients, v.sobel_gradients)
    return eqx.tree_at(kept, volume, (None, None, None, None), is_leaf=lambda x: x is None)


def as_precomputed(scene: Scene) -> Scene:
    """A scene of the same structure as `precompute` makes of it, at once and with zeros for what it computes: for `jvr.plan`."""
    if scene.environment_light is None:
        return scene
    order = _material_order(scene)

    def shaped(scene: Scene) -> Any:
        assert scene.material is not None
        scene = dataclasses.replace(scene, material=scene.material.projected(order))
        if scene.radiance_transfer is None or scene.radiance_transfer.is_frozen:
            return scene.material, None
        return scene.material, _finished(scene, *_projection(scene).all_nodes())

    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(shaped, scene))
    scene = dataclasses.replace(scene, material=zeros[0])
    if zeros[1] is None or scene.radiance_transfer is None:
        return scene
    return dataclasses.replace(scene, radiance_transfer=scene.radiance_transfer.with_projected(zeros[1]))


def _material_order(scene: Scene) -> int:
    """As `Scene.material_order`, but of use under other environments too."""
    return max(scene.material_order, LEAST_ORDER)


def _projection(scene: Scene) -> Any:
    """What the nodes of a scene are projected with."""
    assert scene.radiance_transfer is not None
    where = occupancy(scene, Settings())
    return scene.radiance_transfer.projection(scene, lambda graded: absorbing(scene, where, graded))


def _finished(scene: Scene, *nodes: Array) -> Any:
    assert scene.radiance_transfer is not None
    return scene.radiance_transfer.finished(scene, *nodes)


def _project(scene: Scene, progress: Progress) -> Any:
    """The radiance transfer of all nodes near which there is something to see, some at a time."""
    projection = jax.jit(_projection)(scene)
    active = np.flatnonzero(np.asarray(projection.active()))
    shape = jax.eval_shape(lambda projection: projection.all_nodes(), projection)
    coefficients, around = (np.zeros(x.shape, x.dtype) for x in shape)
    size = shares() * min(TOGETHER, -(-len(active) // shares()))
    for begin in range(0, len(active), size or 1):
        piece = active[begin : begin + size]
        # The last piece repeats its last node.
        index = np.pad(piece, (0, size - len(piece)), mode="edge")
        found = _some(projection, jnp.asarray(index, jnp.int32))
        coefficients[index], around[index] = map(np.asarray, found)
        progress((begin + len(piece)) / len(active))
    return jax.jit(_finished)(scene, jnp.asarray(coefficients), jnp.asarray(around))


@jax.jit
def _some(projection: Any, index: Array) -> tuple[Array, Array]:
    """The radiance transfer of some nodes."""
    return everywhere(over_rays(lambda projection, index: projection.nodes(index), projection, index))


def _kept(
    folder: Path | None,
    function: Callable[[Any], Any],
    inputs: Any,
    compute: Callable[[], Any],
    part: str,
    report: Callable[[Precomputed], Any],
) -> Any:
    """`compute()`, from the folder where it holds a result of the same inputs, and kept there where it does not."""
    began = time.perf_counter()
    path = None if folder is None else folder / f"{_digest(inputs)}.npz"
    found = None if path is None else _found(path, function, inputs)
    result = jax.block_until_ready(compute()) if found is None else found
    if path is not None and found is None:
        try:
            with replacing(path) as temporary, temporary.open("wb") as file:
                np.savez(file, *[np.asarray(x) for x in jax.tree.leaves(result)])
        except OSError as error:
            # Minutes of work are not lost for want of a place to keep them.
            warnings.warn(f"{error}; the {part} is used and not kept", RuntimeWarning, stacklevel=2)
    nbytes = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(result))
    report(Precomputed(part, time.perf_counter() - began, found is not None, nbytes))
    return result


def _found(path: Path, function: Callable[[Any], Any], inputs: Any) -> Any:
    """What the file holds of `function(inputs)`, or `None`."""
    leaves, structure = jax.tree.flatten(jax.eval_shape(function, inputs))
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = [file[f"arr_{i}"] for i in range(len(leaves))]
        if all(a.shape == x.shape and a.dtype == x.dtype for a, x in zip(arrays, leaves, strict=True)):
            return jax.tree.unflatten(structure, [jnp.asarray(a) for a in arrays])
    except (FileNotFoundError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        pass  # not there, or damaged: it is made anew
    return None


def _digest(inputs: Any) -> str:
    """A name for the content of a tree: its structure, static choices and numbers."""
    leaves, structure = jax.tree.flatten(inputs)
    name = hashlib.sha256(f"{VERSION} {structure} {[(x.shape, str(x.dtype)) for x in leaves]}".encode())
    for leaf in leaves:
        name.update(np.ascontiguousarray(leaf).tobytes())
    return name.hexdigest()[:32]
