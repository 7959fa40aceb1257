"""What every command that computes needs: the compilation cache, progress, and a record of what it ran on."""

import contextlib
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any


def start_jax() -> None:
    """Spreads rays over all cores, and keeps compiled programs in the user's cache folder, so that the second run starts at once;
    `JVR_CACHE=0` turns that off."""
    from jvr.execution.devices import use_all_cores

    with warnings.catch_warnings():
        # Where a command is called as a function JAX may have begun.
        warnings.simplefilter("ignore")
        use_all_cores()
    folder = None if "JAX_COMPILATION_CACHE_DIR" in os.environ else cache_folder("xla")
    if folder is None:
        return
    import jax

    # A cache on a full disk costs time and nothing else; JAX would say so for each program.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache", UserWarning)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def cache_folder(name: str) -> Path | None:
    """A folder of the user's cache, or `None` where it cannot be used or `JVR_CACHE=0` turns it off."""
    if os.environ.get("JVR_CACHE", "1") in ("0", ""):
        return None
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jvr" / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


# Signs of life that are moving now; a bar takes their place on the terminal.
_moving: list[Any] = []


@contextlib.contextmanager
def progress(message: str) -> Iterator[None]:
    """A moving sign of life on stderr where that is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(message) as status:
        _moving.append(status)
        try:
            yield
        finally:
            _moving.remove(status)


@contextlib.contextmanager
def bar(message: str) -> Iterator[Callable[[float], None]]:
    """A function to call with the share that is done, 0 ... 1; it moves a bar on stderr where that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda share: None
        return
    from rich.console import Console
    from rich.progress import Progress

    for status in _moving:
        status.stop()
    with Progress(console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task(message, total=1.0)
        yield lambda share: shown.update(task, completed=share)
    for status in _moving:
        status.start()


@contextlib.contextmanager
def compiling() -> Iterator[list[float]]:
    """The seconds that were spent compiling meanwhile, as the one element of a list; in several threads at once, all of theirs."""
    from jax import monitoring

    spent = [0.0]

    def add(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            spent[0] += duration_secs

    monitoring.register_event_duration_secs_listener(add)
    try:
        yield spent
    finally:
        monitoring.unregister_event_duration_listener(add)


def provenance() -> dict[str, Any]:
    """Versions and device, for a result that someone wants to repeat."""
    import jax

    packages = ("jvr", "jax", "jaxlib", "equinox", "optimistix", "numpy")
    device = jax.devices()[0]
    return {
        "versions": {name: metadata.version(name) for name in packages} | {"python": sys.version.split()[0]},
        "device": {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count()},
    }


def plain(number: Any) -> float | None:
    """A number as JSON can hold it: `None` where it is not finite."""
    number = float(number)
    return number if math.isfinite(number) else None


def nested(array: Any) -> Any:
    """An array as nested lists; what is not finite is `None`."""
    return [nested(row) for row in array] if getattr(array, "ndim", 0) else plain(array)
