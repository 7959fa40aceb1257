"""Readers that fail, for the tests of the fuzzer itself."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from jvr.io.volumes import VolumeError
from jvr.io.volumes.errors import check_size
from seeds.seed import Seed


def faulty() -> dict[str, Seed]:
    held = []

    def waits(path: Path) -> None:
        end = time.process_time() + 2.2
        while time.process_time() < end:
            pass

    def takes(path: Path, announced: int) -> None:
        check_size(path, [announced], 1, None)
        held.append(np.ones(5 << 20))

    readers = {
        "faulty: signal": lambda path: os.kill(os.getpid(), signal.SIGSEGV),
        "faulty: exception": lambda path: {}["key"],
        "faulty: time": waits,
        "faulty: terminal": lambda path: os.write(2, b"libx: odd"),
        "faulty: memory": lambda path: takes(path, 1 << 20),
        "faulty: no more than announced": lambda path: takes(path, 10 << 20),
    }
    return {name: Seed({"a.txt": b"text\n"}, "a.txt", read, (VolumeError,), share=2) for name, read in readers.items()}
