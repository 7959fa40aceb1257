"""Native decoders in a process of their own (`decode`): one that crashes, hangs or takes too much is an error of its file and no more."""

import io
import json
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any

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
    seconds, buffer = 2 + count // SLOWEST, np.empty(count, np.uint8)
    with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as errors:
        given.write(json.dumps(task | {"seconds": seconds}).encode() + b"\n")
        given.writelines(streams)
        given.seek(0)
        command = [sys.executable, "-P", str(SCRIPT)]
        with subprocess.Popen(command, stdin=given, stdout=subprocess.PIPE, stderr=errors) as child:
            timer = threading.Timer(PATIENCE * (1 + seconds), child.kill)
            timer.start()
            try:
                assert isinstance(child.stdout, io.BufferedReader)
                found = child.stdout.readinto(buffer.data)
                status = child.wait()
            except BaseException:
                child.kill()
                raise
            finally:
                timer.cancel()
        errors.seek(0)
        said = errors.read().decode("utf-8", "replace").strip()[-240:]
    if status == 0 and found == count:
        return buffer
    problem = one_line(said) if said else f"the decoder crashed or took too long (status {status})"
    raise VolumeError(path, f"its compressed data are damaged or not supported: {problem}; copy or export it again")
