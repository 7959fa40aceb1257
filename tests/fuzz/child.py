"""Reads damaged files one after the other in a process of its own, which may die of one.

`python child.py SEED COUNT FORMAT FIRST [FORMAT FIRST ...]` says on its output, as lines of JSON, which file it reads and what is wrong
with what came out.

The memory that a file may take is four times what it announces and `REST`. It announces what its reader hands to `check_size` or
`check_pixels` and these let pass, and at least what it takes on disk: no more, where a reader allocates without having asked. The
highest use counts from what the process has before the file, with all libraries and behind a whole file of the format. A process that a
reader starts is not measured: it has limits of its own (`jvr/io/volumes/decode.py`).

With JVR_FUZZ_SHAPE=160,150,64 the whole files show what a byte of voxels takes, beside which `REST` is small.
"""

import contextlib
import json
import math
import os
import resource
import shutil
import sys
import tempfile
import time
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mutations import damaged
from seeds import Seed, all_seeds, faulty

from jvr.io import image_sizes
from jvr.io.volumes import errors
from jvr.model.volume import Volume

TIMES, MOST_SECONDS = 4, 2.0
# Bytes that come and go whatever is read: Python and NumPy take memory by the MiB, XLA for each program that it compiles.
REST = 16 << 20


def _say(**line: object) -> None:
    os.write(OUT, (json.dumps(line) + "\n").encode())


class Announced:
    """The most bytes that a file announced, as far as its reader's checks let them pass."""

    def __init__(self) -> None:
        self.bytes = 0
        self._watch(errors.check_size, lambda path, shape, itemsize, *rest, **more: math.prod(shape) * itemsize)
        # A pixel in memory is three float32, or what the file says where that is more.
        self._watch(image_sizes.check_pixels, lambda path, kind, width, height, bytes_each: width * height * max(bytes_each, 12))

    def _watch(self, check: Callable[..., None], size: Callable[..., float]) -> None:
        """Wraps a check in each module that uses it."""

        def watched(*arguments: Any, **keywords: Any) -> None:
            check(*arguments, **keywords)
            self.bytes = max(self.bytes, int(size(*arguments, **keywords)))

        for module in list(sys.modules.values()):
            if getattr(module, check.__name__, None) is check:
                setattr(module, check.__name__, watched)


def _read(seed: Seed, path: Path, announced: Announced) -> dict[str, Any]:
    """Whether a file was accepted, and what is wrong with how it was read or refused.

    Where memory is short the system takes pages of libraries away and brings them back as they are used, which counts as memory that a
    file takes: what is too much is measured again.
    """
    found = _read_once(seed, path, announced)
    return _read_once(seed, path, announced) if " MiB, announced " in found["problem"] else found


def _read_once(seed: Seed, path: Path, announced: Announced) -> dict[str, Any]:
    # The highest use of memory starts anew at what is used here (Linux).
    Path("/proc/self/clear_refs").write_text("5")
    files = path.rglob("*") if path.is_dir() else [path]
    announced.bytes = sum(file.stat().st_size for file in files if file.is_file())
    before, start = _most_memory(), time.process_time()
    problem, accepted = "", False
    try:
        with _terminal():
            seed.read(path)
        accepted = True
    except (*seed.errors, OSError) as error:
        if "\n" in str(error):
            problem = f"more than one line: {error!r}"
    except BaseException as error:
        problem = f"{type(error).__name__}: {error}"[:300]
    seconds = time.process_time() - start
    memory = _most_memory() - before
    if text := os.pread(WRITTEN, 200, 0):
        problem += f" wrote {text!r} on the terminal"
    if seconds > MOST_SECONDS:
        problem += f" took {seconds:.1f} s"
    if memory > TIMES * announced.bytes + REST:
        problem += f" took {memory / 2**20:.0f} MiB, announced {announced.bytes / 2**20:.1f} MiB"
    return {"accepted": accepted, "problem": problem, "seconds": seconds, "memory": memory}


@contextlib.contextmanager
def _terminal() -> Iterator[None]:
    """A file that takes what is written on standard output and error meanwhile, by native code too."""
    os.ftruncate(WRITTEN, 0)
    kept = [os.dup(1), os.dup(2)]
    try:
        for stream in (1, 2):
            os.dup2(WRITTEN, stream)
        yield
    finally:
        for stream, own in zip((1, 2), kept, strict=True):
            os.dup2(own, stream)
            os.close(own)


def main(number: int, count: int, jobs: list[tuple[str, int]]) -> None:
    warnings.simplefilter("ignore")
    # Files in memory: removing a folder from a disk takes longer than most reads.
    folder = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    try:
        seeds = faulty()
        if not {name for name, _ in jobs} <= set(seeds):
            seeds |= all_seeds(folder)
        announced, place = Announced(), folder / "one"
        # XLA takes tens of megabytes when it compiles for the first time, as it does for the gaps of a volume.
        Volume(np.arange(60, dtype=np.uint8).reshape(3, 4, 5), missing=0)
        for name, first in jobs:
            seed = seeds[name]
            _warm(seed, place)
            for k in range(first, -(-count // seed.share)):
                rng = np.random.default_rng([number, zlib.crc32(name.encode()), max(k, 0)])
                # Before the first damaged file the whole one.
                _place(seed.files if k < 0 else damaged(seed.files, rng), place)
                _say(format=name, k=k)
                found = _read(seed, place / seed.main, announced)
                if k < 0 and found["accepted"] == seed.refused:
                    found["problem"] += " the whole file is " + ("accepted" if seed.refused else "refused")
                _say(format=name, **found)
        _say(done=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _warm(seed: Seed, place: Path) -> None:
    """Brings into memory what reading a format takes by itself in this process, and limits how much more may be taken."""
    _place(seed.files, place)
    if seed.share == 1:
        with contextlib.suppress(*seed.errors):
            seed.read(place / seed.main)
    with contextlib.suppress(ValueError):
        resource.setrlimit(resource.RLIMIT_AS, (_address_space() + (2 << 30), resource.RLIM_INFINITY))


def _place(files: dict[str, bytes], place: Path) -> None:
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    for name, content in files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(content)


def _most_memory() -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmHWM:")[1].split()[0])


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


if __name__ == "__main__":
    OUT, WRITTEN = os.dup(1), os.memfd_create("written")
    pairs = sys.argv[3:]
    main(int(sys.argv[1]), int(sys.argv[2]), [(name, int(first)) for name, first in zip(pairs[::2], pairs[1::2], strict=True)])
