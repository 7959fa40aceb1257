"""`python -m benchmarks [NAME ...] [--json FILE] [--quick]`."""

import argparse
import datetime
import json
import os
import platform
import sys
from pathlib import Path

import jax

import jvr
from benchmarks.accelerator import accelerator
from benchmarks.cases import CASES
from benchmarks.peers.run import peers, scattering


def main() -> None:
    """Runs the named measurements, all by default, and prints one JSON object. `scattering` is a part of `peers`, also to be had alone;
    `accelerator` is among the default ones where there is one."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    beside = {"peers": peers, "scattering": scattering, "accelerator": accelerator}
    names = [*CASES, *beside]
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help=f"of {', '.join(names)}; all by default, scattering as a part of peers, accelerator where there is one",
    )
    parser.add_argument("--json", metavar="FILE", help="also write the result to FILE")
    parser.add_argument(
        "--quick", action="store_true", help="peers, scattering, accelerator: small sizes and few rounds, to see that it runs"
    )
    arguments = parser.parse_args()
    unknown = set(arguments.names) - set(names)
    if unknown:
        parser.error(f"unknown benchmark {', '.join(sorted(unknown))}: choose from {', '.join(names)}")
    jvr.use_all_cores()
    result = {"machine": machine()}
    default = [*CASES, "peers"] if jax.default_backend() == "cpu" else [*CASES, "peers", "accelerator"]
    for name in arguments.names or default:
        print(f"{name} ...", file=sys.stderr, flush=True)
        result[name] = beside[name](arguments.quick) if name in beside else CASES[name]()
    text = json.dumps(result, indent=2)
    print(text)
    if arguments.json:
        with open(arguments.json, "w") as file:
            file.write(text + "\n")


def machine() -> dict[str, str | int | None]:
    """What the numbers were measured on."""
    return {
        "date": datetime.date.today().isoformat(),
        "processor": processor(),
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
        "platform": platform.platform(terse=True),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jvr": jvr.__version__,
    }


def processor() -> str:
    """Its name, where the system says."""
    described = Path("/proc/cpuinfo")
    lines = described.read_text().splitlines() if described.exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.processor())


if __name__ == "__main__":
    main()
