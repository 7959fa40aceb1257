"""Native decoders in a process of their own (`decoded`, `Decoder`): one that crashes, hangs or takes too much is an error of its file
and no more."""

import contextlib
import io
import json
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

import numpy as np

from jvr.io.volumes.errors import VolumeError, one_line

SCRIPT = Path(__file__).with_name("decode.py")
# Decoders deliver 10 MB/s and more, on one core.
SLOWEST = 2_000_000
# How much longer than its processor time a decoder may take where the machine does much else.
PATIENCE = 10.0


def decoded(path: Path, task: dict[str, Any], count: int, streams: Iterable[bytes] = ()) -> np.ndarray:
    """`count` bytes that the script `decode` makes of a task and of what is compressed.

    **Raises** `VolumeError` of `path` where it fails, or takes a few times the memory or time that so many bytes need.
    """
    with tempfile.TemporaryFile() as given:
        given.write(_line(task, count))
        given.writelines(streams)
        given.seek(0)
        with tempfile.TemporaryFile() as errors, _started(given, errors) as child:
            return _answer(child, errors, path, count)


class Decoder:
    """One process for many tasks without streams, such as the files of a folder: most of a small task's time is the start of its process.

    Each task has limits of its own. A task that fails ends the process, and the next one starts another."""

    def __init__(self):
        self._child: subprocess.Popen | None = None
        self._errors: IO[bytes] | None = None

    def __enter__(self) -> "Decoder":
        return self

    def __exit__(self, *problem: object) -> None:
        self._end()

    def __call__(self, path: Path, task: dict[str, Any], count: int) -> np.ndarray:
        """As `decoded`."""
        if self._child is None or self._errors is None:
            self._errors = tempfile.TemporaryFile()  # noqa: SIM115 (`_end` closes it)
            self._child = _started(subprocess.PIPE, self._errors)
        assert self._child.stdin is not None
        try:
            # A process that is gone has nothing to answer.
            with contextlib.suppress(BrokenPipeError):
                self._child.stdin.write(_line(task, count))
                self._child.stdin.flush()
            return _answer(self._child, self._errors, path, count, last=False)
        except BaseException:
            self._end()
            raise

    def _end(self) -> None:
        if self._child is not None and self._errors is not None:
            self._child.kill()
            # What was not written yet goes nowhere.
            with contextlib.suppress(BrokenPipeError), self._errors, self._child:
                pass
            self._child = self._errors = None


def _line(task: dict[str, Any], count: int) -> bytes:
    return json.dumps(task | {"seconds": _seconds(count)}).encode() + b"\n"


def _seconds(count: int) -> int:
    return 2 + count // SLOWEST


def _started(given: Any, errors: IO[bytes]) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-P", str(SCRIPT)], stdin=given, stdout=subprocess.PIPE, stderr=errors)


def _answer(child: subprocess.Popen, errors: IO[bytes], path: Path, count: int, last: bool = True) -> np.ndarray:
    """What the process writes; the status with which it ends counts where this is the `last` that it is asked for."""
    buffer = np.empty(count, np.uint8)
    timer = threading.Timer(PATIENCE * (1 + _seconds(count)), child.kill)
    timer.start()
    try:
        assert isinstance(child.stdout, io.BufferedReader)
        found = child.stdout.readinto(buffer.data)
        status = child.wait() if last or found != count else 0
    except BaseException:
        child.kill()
        raise
    finally:
        timer.cancel()
    if status == 0 and found == count:
        return buffer
    errors.seek(0)
    said = errors.read().decode("utf-8", "replace").strip()[-240:]
    problem = one_line(said) if said else f"the decoder crashed or took too long (status {status})"
    raise VolumeError(path, f"its compressed data are damaged or not supported: {problem}; copy or export it again")
