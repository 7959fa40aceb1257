"""What a fit knows, as a file: its values, their information matrix, and the configuration that they belong to. No pickle is read."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jvr.atomic import replacing
from jvr.io.config import Config, config_from

if TYPE_CHECKING:
    from jvr.fitting.result import FitResult

VERSION = 1


class KnowledgeError(ValueError):
    """A file that does not hold what a fit knows."""


class Saved(NamedTuple):
    """`config`: as the fit had it; `values`: of each unknown array by its path in the scene; `information` about them, `None` where
    `refused` says why there is none; `variance` of the residuals; `exposure`."""

    config: Config
    values: dict[str, np.ndarray]
    information: Float[np.ndarray, "unknowns unknowns"] | None
    variance: float
    exposure: float
    refused: str | None


def write_knowledge(path: Path, config: Config, result: "FitResult") -> None:
    """Writes what a fit of a configuration has found; of voxels or of cameras alone, that there is no information about it. The file is
    replaced at once or not at all."""
    from jvr.fitting.next_view import Knowledge
    from jvr.fitting.unknowns import leaves_by_name

    known, refused = None, None
    try:
        known = Knowledge.of(result)
    except ValueError as error:
        refused = str(error)
    meta = {
        "version": VERSION,
        "config": {"data": config.data, "name": config.name, "folder": str(config.folder.absolute())},
        "overridden": config.overridden,
        "unknowns": () if known is None else known.unknowns,
        "refused": refused,
        "variance": result.stats.residual_variance,
        "exposure": result.exposure,
    }
    arrays = {"meta": np.array(json.dumps(meta, default=str))}
    if known is not None:
        leaves = leaves_by_name(result.scene)
        arrays |= {f"value{i}": np.asarray(leaves[name]) for i, name in enumerate(known.unknowns)}
        arrays["information"] = known.information[np.triu_indices(len(known.information))]
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def read_knowledge(path: Path) -> Saved:
    """What `write_knowledge` wrote.

    **Raises** `KnowledgeError` for anything else, `OSError` where the file cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            meta = json.loads(str(file["meta"]))
            arrays = {name: file[name] for name in file.files if name != "meta"}
        if meta.get("version") == VERSION:
            return _saved(meta, arrays)
    except OSError:
        raise
    # Whatever NumPy, zipfile and JSON say of damaged bytes, and of parts that are missing.
    except Exception as error:
        raise KnowledgeError(f"{path}: damaged, or not written by a fit: run the fit again") from error
    raise KnowledgeError(f"{path}: written by another version of jvr: run the fit again")


def _saved(meta: dict[str, Any], arrays: dict[str, np.ndarray]) -> Saved:
    given: dict[str, Any] = meta["config"]
    config = config_from(given["data"], given["name"], Path(given["folder"]))
    config = dataclasses.replace(config, overridden=tuple(meta["overridden"]))
    values = {name: arrays[f"value{i}"] for i, name in enumerate(meta["unknowns"])}
    return Saved(config, values, _square(arrays.get("information")), meta["variance"], meta["exposure"], meta["refused"])


def _square(upper: np.ndarray | None) -> np.ndarray | None:
    """A symmetric matrix of its upper triangle."""
    if upper is None:
        return None
    count = int(np.sqrt(2 * upper.size))
    matrix = np.zeros((count, count))
    matrix[np.triu_indices(count)] = upper
    return matrix + np.triu(matrix, 1).T
