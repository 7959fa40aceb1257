"""Atomic writes: files that are there whole or not at all."""

import contextlib
import glob
import os
import shutil
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

# Seconds after which nobody writes a file any more that has no name of its own yet.
ABANDONED = 86_400.0
_unfinished: set[Path] = set()


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """A new, empty file beside `path`: it takes that name when the block ends well and vanishes when it does not.

    A link is followed, and a file that was there keeps its permissions. **Raises** `OSError`, which names `path`, where it cannot be
    written, is write-protected, or its disk is full.
    """
    path = Path(path)
    real = Path(os.path.realpath(path))
    if not real.parent.is_dir():
        raise FileNotFoundError(f"{path}: the folder {path.parent} does not exist; create it first")
    if real.exists() and not os.access(real, os.W_OK):
        raise PermissionError(f"{path}: the file is write-protected; choose another name")
    remove_parts(real.parent, real.name, older=ABANDONED)
    # Not tempfile: its files are for their owner's eyes only, and the name would keep that.
    temporary = real.with_name(f".{real.name[:80]}.{uuid.uuid4().hex[:8]}.part")
    _unfinished.add(temporary)
    try:
        temporary.touch(exist_ok=False)
        yield temporary
        if real.is_file():
            temporary.chmod(real.stat().st_mode & 0o7777)
        os.replace(temporary, real)
    except OSError as error:
        reason = error.strerror or " ".join(str(error).split())
        raise type(error)(f"{path}: cannot be written: {reason}; choose another name or folder, or make room") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        _unfinished.discard(temporary)


@contextlib.contextmanager
def replacing_together(*paths: str | os.PathLike) -> Iterator[tuple[Path, ...]]:
    """As `replacing` for files that belong together: all take their names, or each that was there stays."""
    with contextlib.ExitStack() as before, contextlib.ExitStack() as files:
        yield tuple(files.enter_context(replacing(path)) for path in paths)
        for path in paths:
            before.enter_context(_or_as_before(Path(os.path.realpath(path))))


@contextlib.contextmanager
def _or_as_before(path: Path) -> Iterator[None]:
    """Where the block fails, the file at `path` is the one that was there, or none."""
    old = path.with_name(f".{path.name[:80]}.{uuid.uuid4().hex[:8]}.part")
    if path.is_file():
        try:
            os.link(path, old)
        # Not every file system knows a second name for a file.
        except OSError:
            shutil.copy2(path, old)
    try:
        yield
    except BaseException:
        if old.exists():
            os.replace(old, path)
        elif path.is_file():
            path.unlink()
        raise
    finally:
        old.unlink(missing_ok=True)


def remove_unfinished() -> None:
    """Removes what `replacing` writes in this process now: for one that ends without unwinding."""
    for temporary in tuple(_unfinished):
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_parts(folder: Path, name: str | None = None, older: float = 0.0) -> None:
    """Removes what a killed process left of `replacing` in a folder, of files called `name` or of all, last written that many seconds
    ago."""
    prefix = "*" if name is None else glob.escape(name[:80])
    for part in folder.glob(f".{prefix}.{'[0-9a-f]' * 8}.part"):
        with contextlib.suppress(OSError):
            if time.time() - part.stat().st_mtime >= older:
                part.unlink()
