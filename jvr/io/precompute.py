"""What depends on neither camera nor light, computed once: projected materials and radiance transfer, kept on disk by their content."""

import dataclasses
import hashlib
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jvr.effects.radiance_transfer import MaterialBleeding, ProjectedTransfer
from jvr.effects.transfer_grid import TransferProjection, finished, project_all, transfer_of
from jvr.io.images import replacing
from jvr.model.scene import Scene
from jvr.parallel import in_threads, workers
from jvr.rendering.medium import absorbing, occupancy
from jvr.rendering.settings import Settings

# Changes whenever what is computed from the same inputs does: what was kept before is then of no use.
VERSION = 1
# Nodes in a program of their own, between two reports of progress.
TOGETHER = 2048

Progress = Callable[[float], Any]


def precompute(
    scene: Scene, *, cache: str | os.PathLike | None = None, progress: Progress | None = None, keep_unscattered: bool = False
) -> Scene:
    """The scene with its material projected on harmonics and its radiance transfer computed, so that pictures from any camera and under
    any environment do neither again.

    Both are constants from then on. After a change of the volume, the transfer function, the clipping box, or the settings of
    `radiance_transfer`, compute again from a scene that has not been through here; a new material asks for it only with
    `jvr.MaterialBleeding()`. `jvr.render` warns where the transfer function is not the one that it was made for.

    **Arguments:** `cache`: a folder to keep results in, named by the content of what they were computed from; `progress`: called with the
    share that is done, 0 ... 1; `keep_unscattered`: leave the scattering pass to each picture, so that the dipole can be fitted.
    Not traceable. **Raises** `OSError` where the folder cannot be written.
    """
    environment = scene.environment
    if environment is None:
        return scene
    folder = None if cache is None else Path(cache)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    project = lambda material: material.projected(environment.order)
    scene = dataclasses.replace(scene, material=_kept(folder, project, scene.material, lambda: jax.jit(project)(scene.material)))
    if scene.radiance_transfer is None or scene.radiance_transfer.is_frozen:
        return scene
    transfer = transfer_of(scene)
    if keep_unscattered:
        scene = eqx.tree_at(lambda s: s.radiance_transfer.scattering, scene, None)
    # The light plays no part, and the material where rays do not pick up its colour.
    plays = isinstance(transfer.bleeding, MaterialBleeding)
    inputs = (
        scene.volume,
        scene.transfer,
        scene.clipping,
        scene.normals,
        scene.radiance_transfer,
        scene.material if plays else None,
    )
    whole = lambda _: finished(scene, *project_all(_projection(scene)))
    projected = _kept(folder, whole, inputs, lambda: _project(scene, progress or (lambda share: None)))
    return dataclasses.replace(scene, radiance_transfer=transfer.with_projected(projected))


def _projection(scene: Scene) -> TransferProjection:
    """What the nodes of a scene are projected with."""
    transfer = transfer_of(scene)
    where = occupancy(scene, Settings())
    return TransferProjection.of(scene, absorbing(scene, where, scene.transfer.takes_gradient or transfer.needs_gradient))


def _project(scene: Scene, progress: Progress) -> ProjectedTransfer:
    """The transfer of all nodes near which there is something to see, as many programs at a time as there are cores."""
    projection = jax.jit(_projection)(scene)
    active = np.flatnonzero(np.asarray(projection.active()))
    size = max(1, min(TOGETHER, -(-len(active) // workers())))
    pieces = [active[i : i + size] for i in range(0, len(active), size)]
    done = []

    def one(piece: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        full = np.concatenate([piece, np.full(size - len(piece), piece[-1])])
        coefficients, opened = _some(projection, jnp.asarray(full, jnp.int32))
        done.append(len(piece))
        progress(sum(done) / len(active))
        return np.asarray(coefficients)[: len(piece)], np.asarray(opened)[: len(piece)]

    shape = jax.eval_shape(project_all, projection)
    coefficients, opened = (np.zeros(x.shape, x.dtype) for x in shape)
    for piece, (found, open_) in zip(pieces, in_threads(one, pieces), strict=True):
        coefficients[piece], opened[piece] = found, open_
    return jax.jit(finished)(scene, jnp.asarray(coefficients), jnp.asarray(opened))


_some = jax.jit(lambda projection, index: projection.nodes(index))


def _kept(folder: Path | None, function: Callable[[Any], Any], inputs: Any, compute: Callable[[], Any]) -> Any:
    """`compute()`, from the folder where it holds a result of the same inputs, and kept there where it does not."""
    if folder is None:
        return compute()
    leaves, structure = jax.tree.flatten(jax.eval_shape(function, inputs))
    path = folder / f"{_digest(inputs)}.npz"
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = [file[f"arr_{i}"] for i in range(len(leaves))]
        if all(a.shape == x.shape and a.dtype == x.dtype for a, x in zip(arrays, leaves, strict=True)):
            return jax.tree.unflatten(structure, [jnp.asarray(a) for a in arrays])
    except (FileNotFoundError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        pass  # not there, or damaged: it is made anew
    result = compute()
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, *[np.asarray(x) for x in jax.tree.leaves(result)])
    return result


def _digest(inputs: Any) -> str:
    """A name for the content of a tree: its structure, static choices and numbers."""
    leaves, structure = jax.tree.flatten(inputs)
    name = hashlib.sha256(f"{VERSION} {structure} {[(x.shape, str(x.dtype)) for x in leaves]}".encode())
    for leaf in leaves:
        name.update(np.ascontiguousarray(leaf).tobytes())
    return name.hexdigest()[:32]
