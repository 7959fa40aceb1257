"""Resident memory of this process."""

import ctypes
import resource
import sys
from pathlib import Path


def resident() -> int:
    """Bytes in memory now; where the system does not say, the most so far."""
    return _status("VmRSS")


def peak() -> int:
    """The most bytes in memory since `reset_peak`; where that cannot be reset, since the start."""
    return _status("VmHWM")


def reset_peak() -> None:
    """Forgets the peak so far. What was freed, by a compiler for example, is given back to the system first."""
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")


def _status(field: str) -> int:
    status = Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    line = next(line for line in status.read_text().splitlines() if line.startswith(field))
    return int(line.split()[1]) * 1024
