"""Starts the process that reads damaged files, again behind each file that ends it, and gathers what went wrong.

`python parent.py COUNT [SEED] [FORMAT ...]` reads so many damaged files of each format; `make fuzz` calls it.
"""

import concurrent.futures
import dataclasses
import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).parent
# Longer than any file may take, on a machine that has much else to do.
PATIENCE = 60


@dataclasses.dataclass
class Outcome:
    """How many damaged files of a format were read and refused, the processor time and the most memory (bytes) that this took, and what
    went wrong: each entry of `faults` names the mutation and its fault."""

    accepted: int = 0
    refused: int = 0
    seconds: float = 0.0
    memory: int = 0
    faults: list[str] = dataclasses.field(default_factory=list)


Report = Callable[[str, Outcome], None]


def findings(
    names: list[str], count: int, number: int = 0, together: int = 1, report: Report = lambda name, outcome: None
) -> dict[str, Outcome]:
    """What came out, by format; `together`: processes at a time; `report` is told of each format that is done."""
    found = {name: Outcome() for name in names}
    with concurrent.futures.ThreadPoolExecutor(together) as pool:
        for _ in pool.map(lambda k: _lives(names[k::together], count, number, found, report), range(together)):
            pass
    return found


def _lives(names: list[str], count: int, number: int, found: dict[str, Outcome], report: Report) -> None:
    jobs = [(name, -1) for name in names]
    while jobs:
        jobs = _one_life(jobs, count, number, found, report)


def _one_life(
    jobs: list[tuple[str, int]], count: int, number: int, found: dict[str, Outcome], report: Report
) -> list[tuple[str, int]]:
    """Runs one process; what remains to be done behind the file that ended it."""
    words = [word for name, first in jobs for word in (name, str(first))]
    command = [sys.executable, str(HERE / "child.py"), str(number), str(count), *words]
    # Memory that is freed goes back at once (glibc): what a file takes does not hide in what the one before has left.
    environment = os.environ | {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}
    # XLA compiles for every new shape: quickly.
    environment["XLA_FLAGS"] = "--xla_backend_optimization_level=0"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=environment, **pipes) as child:
        lines: queue.Queue[str] = queue.Queue()
        errors: list[str] = []
        threading.Thread(target=lambda: [*map(lines.put, child.stdout), lines.put("")], daemon=True).start()
        threading.Thread(target=lambda: errors.extend(child.stderr), daemon=True).start()
        at, fault = None, ""
        while True:
            try:
                line = lines.get(timeout=PATIENCE)
            except queue.Empty:
                fault = f"did not end in {PATIENCE} s"
                child.kill()
                break
            said = json.loads(line) if line else {}
            if line and at is not None and said.get("format") != at[0]:
                report(at[0], found[at[0]])
            if said.get("done"):
                return []
            if "accepted" in said and at is not None:
                _gather(found[at[0]], at[1], said)
            elif said:
                at = (said["format"], said["k"])
            else:
                fault = f"ended the process with {child.wait()}: {''.join(errors)[-600:]}"
                break
    if at is None:
        raise RuntimeError(f"the whole files were not read: {fault}")
    found[at[0]].faults.append(f"{at[1]}: {fault}")
    behind = [name for name, _ in jobs].index(at[0])
    return [(at[0], at[1] + 1), *jobs[behind + 1 :]]


def _gather(outcome: Outcome, k: int, said: dict) -> None:
    outcome.accepted += said["accepted"]
    outcome.refused += not said["accepted"]
    outcome.seconds += said["seconds"]
    outcome.memory = max(outcome.memory, said["memory"])
    if said["problem"]:
        outcome.faults.append(f"{k}: {said['problem']}")


if __name__ == "__main__":
    import tempfile

    from seeds import all_seeds

    with tempfile.TemporaryDirectory() as folder:
        known = list(all_seeds(Path(folder)))
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    print("format: files, accepted, refused, seconds, most MiB, faults", flush=True)

    def report(name: str, outcome: Outcome) -> None:
        numbers = f"{outcome.accepted + outcome.refused}, {outcome.accepted}, {outcome.refused}, {outcome.seconds:.0f}"
        print(
            f"{name}: {numbers}, {outcome.memory / 2**20:.1f}, {len(outcome.faults)}",
            *outcome.faults[:20],
            sep="\n    ",
            flush=True,
        )

    result = findings(sys.argv[3:] or known, int(sys.argv[1]), seed, os.cpu_count() or 1, report)
    sys.exit(any(outcome.faults for outcome in result.values()))
