"""Reads damaged files one after the other in a process of its own, which may die of one.

`python child.py SEED COUNT FORMAT FIRST [FORMAT FIRST ...]` says on its output, as lines of JSON, which file it reads and what is wrong
with what came out.
"""

import contextlib
import json
import os
import resource
import shutil
import sys
import tempfile
import time
import warnings
import zlib
from pathlib import Path

import numpy as np
from mutations import mutated
from seeds import Seed, all_seeds, faulty

# Seeds have 10 kB at most, a deflate stream of which announces 11 MB at most: four times that, and what a process does by itself.
MOST_MEMORY, MOST_SECONDS = 64 << 20, 2.0


def _say(**line: object) -> None:
    os.write(OUT, (json.dumps(line) + "\n").encode())


def damaged(seed: Seed, name: str, number: int, k: int) -> dict[str, bytes]:
    """The files of one mutation: one of them is changed."""
    rng = np.random.default_rng([number, zlib.crc32(name.encode()), k])
    # The header is the first of several.
    names = list(seed.files)
    chosen = names[0] if rng.random() < 0.7 else names[int(rng.integers(len(names)))]
    return seed.files | {chosen: mutated(seed.files[chosen], rng)}


def _problem(seed: Seed, path: Path) -> str:
    """What is wrong with how a file was read or refused."""
    # The highest use of memory starts anew at what is used here (Linux).
    Path("/proc/self/clear_refs").write_text("5")
    before, start = _most_memory(), time.process_time()
    problem = ""
    try:
        seed.read(path)
    except (*seed.errors, OSError) as error:
        if "\n" in str(error):
            problem = f"more than one line: {error!r}"
    except BaseException as error:
        problem = f"{type(error).__name__}: {error}"[:300]
    seconds = time.process_time() - start
    memory = _most_memory() - before
    if seconds > MOST_SECONDS:
        problem += f" took {seconds:.1f} s"
    if memory > MOST_MEMORY:
        problem += f" took {memory / 2**20:.0f} MiB"
    return problem


def main(number: int, count: int, jobs: list[tuple[str, int]]) -> None:
    warnings.simplefilter("ignore")
    folder = Path(tempfile.mkdtemp())
    try:
        seeds = all_seeds(folder) | faulty()
        for name, first in jobs:
            seed, place = seeds[name], folder / "one"
            for k in range(first or -1, count):
                shutil.rmtree(place, ignore_errors=True)
                place.mkdir()
                # Before the first of them the whole file, which must be read.
                for file, content in (seed.files if k < 0 else damaged(seed, name, number, k)).items():
                    (place / file).write_bytes(content)
                if k < 0:
                    if not name.startswith("faulty"):
                        seed.read(place / seed.main)
                    with contextlib.suppress(ValueError):
                        resource.setrlimit(resource.RLIMIT_AS, (_address_space() + (2 << 30), resource.RLIM_INFINITY))
                    continue
                _say(format=name, k=k)
                if problem := _problem(seed, place / seed.main):
                    _say(format=name, k=k, problem=problem)
        _say(done=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _most_memory() -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmHWM:")[1].split()[0])


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


if __name__ == "__main__":
    OUT = os.dup(1)
    pairs = sys.argv[3:]
    main(int(sys.argv[1]), int(sys.argv[2]), [(name, int(first)) for name, first in zip(pairs[::2], pairs[1::2], strict=True)])
