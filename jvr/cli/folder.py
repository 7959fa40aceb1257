"""The folder of a fit: one run at a time, and never over what the run reads or what another has found."""

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from jvr.atomic import remove_parts
from jvr.cli.inputs import BadInput

CHECKPOINT, PAGE, RESULT, TRANSFER = "checkpoint.npz", "report.html", "result.json", "transfer.toml"
CAMERAS, KNOWLEDGE, NEXT_VIEWS, VOLUME = "cameras.toml", "knowledge.npz", "next_views.png", "volume.mha"
# Of a fit on several grids, those of the finer ones have a number.
CHECKPOINTS = r"checkpoint(_\d+)?\.npz"
PICTURES = r"(target|fitted|difference)_(held_out_)?\d{2,}\.(exr|png)"
NAMES = (PAGE, RESULT, TRANSFER, CAMERAS, KNOWLEDGE, NEXT_VIEWS, VOLUME)
WRITTEN = re.compile("|".join([PICTURES, CHECKPOINTS, *map(re.escape, NAMES)]))


def results_in(folder: Path) -> list[Path]:
    """What a fit has written in a folder."""
    return sorted(path for path in folder.iterdir() if WRITTEN.fullmatch(path.name)) if folder.is_dir() else []


def check_results(folder: Path, inputs: list[Path], *, resume: bool, force: bool) -> None:
    """Refuses a folder whose files a fit would replace: its own inputs always, results of another run unless that is asked for."""
    results = results_in(folder)
    for path in inputs:
        if any(path.samefile(result) for result in results) or (path.is_dir() and folder.is_dir() and path.samefile(folder)):
            raise BadInput(f"-o {folder}: the fit reads {path} and would write over it; choose another folder")
    if resume and folder / CHECKPOINT not in results:
        raise BadInput(f"--resume: {folder / CHECKPOINT} does not exist; leave --resume out to start anew")
    if not results or resume or force:
        return
    if folder / RESULT in results:
        raise BadInput(f"-o {folder}: holds the results of another fit; choose another folder, or replace them with --force")
    if folder / CHECKPOINT in results:
        raise BadInput(f"-o {folder}: holds an unfinished fit; go on with --resume, or start anew with --force")
    raise BadInput(
        f"-o {folder}: holds {results[0].name}, which a fit would replace; choose another folder, or replace it with --force"
    )


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """One process at a time in a folder, as long as the block lasts; what a killed one left half written is removed.

    The lock is the system's, on the folder itself: it ends with the process, however that ends.
    """
    try:
        import fcntl
    except ImportError:  # Windows has no such lock.
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BadInput(f"-o {folder}: another fit is writing there; wait for it, or choose another folder") from None
        except OSError:
            pass  # Some network file systems lock no folders.
        remove_parts(folder)
        yield
    finally:
        os.close(handle)
