"""What does not depend on the camera, computed once: projected materials, radiance transfer, occlusion, in-scattering; kept on disk by
their content."""

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
from jvr.rendering.medium import absorbing, occupancy
from jvr.rendering.settings import Settings

# Changes whenever what is computed from the same inputs does: what was kept before is then of no use.
VERSION = 5
# Order that materials are kept at under an environment of a lower one.
LEAST_ORDER = 3
# Nodes in a program of their own, between two reports of progress.
TOGETHER = 2048

Progress = Callable[[float], Any]


class Precomputed(NamedTuple):
    """One part that was computed beforehand: `part`, "material", "radiance transfer", "occlusion" or "shadows"; `seconds` that it took;
    `cached`, whether it was read from the folder; `nbytes` of its numbers."""

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
    """The scene with its material projected on harmonics, its radiance transfer, its occlusion and its in-scattering computed, so that
    pictures from any camera and, but for in-scattering, under any light do none of it again. The material is kept up to order 3, or that
    of the environment (with an exact product, of the transfer) where it is higher: of an environment of a still higher order no more than
    that is seen.

    All are constants from then on. After a change of the volume, the transfer function or the clipping box call it again, which computes
    what is of another scene anew (else `jvr.render` raises); a new material asks for it only with `jvr.MaterialBleeding()`. After a change
    of the settings of `radiance_transfer`, `occlusion` or `shadows`, begin with a scene that has not been through here.

    **Arguments:** `cache`: a folder to keep results in, named by the content of what they were computed from; `progress`: called with the
    share that is done, 0 ... 1; `report`: called with each part once it is there; `keep_material`: leave the material as it is, and
    `keep_unscattered`: leave the scattering pass to each picture, so that material and dipole can be fitted.
    Not traceable. Warns where a result cannot be written. **Raises** `OSError` where the folder cannot be made.
    """
    if not scene.is_precomputable:
        return scene
    scene = dataclasses.replace(scene, volume=scene.volume.current())
    folder = None if cache is None else Path(cache)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    report = report or (lambda done: None)
    if scene.environment_light is not None and not keep_material:
        order = _material_order(scene)
        material = (scene.material, np.asarray(order))
        project = lambda inputs: inputs[0].projected(order)
        projected = _kept(folder, project, material, lambda: _projected(scene.material, order), "material", report)
        scene = dataclasses.replace(scene, material=projected)
    for field in scene.precomputable:
        part = getattr(scene, field)
        if part.is_frozen and not part.stale(scene):
            continue
        part = bare = part.with_projected(None)
        if keep_unscattered and getattr(part, "scattering", None) is not None:
            bare = eqx.tree_at(lambda p: p.scattering, part, None)
        asked = dataclasses.replace(scene, **{field: bare})
        whole = lambda _, asked=asked, field=field: _whole(asked, field)
        compute = lambda asked=asked, field=field: _project(asked, field, progress or (lambda share: None))
        projected = _kept(folder, whole, (bare, bare.sources(asked)), compute, field.replace("_", " "), report)
        scene = dataclasses.replace(scene, **{field: part.with_projected(projected)})
    return scene


_projected = jax.jit(lambda material, order: material.projected(order), static_argnums=1)


def as_precomputed(scene: Scene) -> Scene:
    """A scene of the same structure as `precompute` makes of it, at once and with zeros for what it computes: for `jvr.plan`."""

    def shaped(scene: Scene) -> Any:
        if scene.environment_light is not None:
            assert scene.material is not None
            scene = dataclasses.replace(scene, material=scene.material.projected(_material_order(scene)))
        fields = [field for field in scene.precomputable if not getattr(scene, field).is_frozen]
        return scene.material, {field: _whole(scene, field) for field in fields}

    material, parts = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(shaped, scene))
    made = {field: getattr(scene, field).with_projected(projected) for field, projected in parts.items()}
    return dataclasses.replace(scene, material=material, **made)


def _material_order(scene: Scene) -> int:
    """As `Scene.material_order`, but of use under other environments too."""
    return max(scene.material_order, LEAST_ORDER)


def _projection(scene: Scene, field: str) -> Any:
    """What the nodes of a part of a scene are computed with."""
    where = occupancy(scene, Settings())
    return getattr(scene, field).projection(scene, lambda graded: absorbing(scene, where, graded))


def _finished(scene: Scene, field: str, projection: Any, *nodes: Array) -> Any:
    return getattr(scene, field).finished(scene, projection, *nodes)


def _whole(scene: Scene, field: str) -> Any:
    projection = _projection(scene, field)
    return _finished(scene, field, projection, *projection.all_nodes())


def _project(scene: Scene, field: str, progress: Progress) -> Any:
    """A part at all nodes near which there is something to see, some at a time."""
    projection = jax.jit(_projection, static_argnums=1)(scene, field)
    active = np.flatnonzero(np.asarray(projection.active()))
    shapes = jax.eval_shape(lambda projection: projection.all_nodes(), projection)
    held = [np.zeros(x.shape, x.dtype) for x in shapes]
    size = shares() * min(TOGETHER, -(-len(active) // shares()))
    for begin in range(0, len(active), size or 1):
        piece = active[begin : begin + size]
        # The last piece repeats its last node.
        index = np.pad(piece, (0, size - len(piece)), mode="edge")
        for array, found in zip(held, _some(projection, jnp.asarray(index, jnp.int32)), strict=True):
            array[index] = np.asarray(found)
        progress((begin + len(piece)) / len(active))
    return jax.jit(_finished, static_argnums=1)(scene, field, projection, *map(jnp.asarray, held))


@jax.jit
def _some(projection: Any, index: Array) -> tuple[Array, ...]:
    """What some nodes hold."""
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
