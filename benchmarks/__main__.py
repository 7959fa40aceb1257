"""`python -m benchmarks [NAME ...] [--json FILE]`."""

import argparse
import json
import os
import platform
import sys

import jax

import jvr
from benchmarks.cases import CASES


def main() -> None:
    """Runs the named measurements, all by default, and prints one JSON object."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(CASES)}; all by default")
    parser.add_argument("--json", metavar="FILE", help="also write the result to FILE")
    arguments = parser.parse_args()
    unknown = set(arguments.names) - set(CASES)
    if unknown:
        parser.error(f"unknown benchmark {', '.join(sorted(unknown))}: choose from {', '.join(CASES)}")
    result = {"machine": machine()}
    for name in arguments.names or CASES:
        print(f"{name} ...", file=sys.stderr, flush=True)
        result[name] = CASES[name]()
    text = json.dumps(result, indent=2)
    print(text)
    if arguments.json:
        with open(arguments.json, "w") as file:
            file.write(text + "\n")


def machine() -> dict[str, str | int | None]:
    """What the numbers were measured on."""
    return {
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
        "platform": platform.platform(terse=True),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jvr": jvr.__version__,
    }


if __name__ == "__main__":
    main()
