"""Recovering a transfer function from eight views of a CT head: Levenberg-Marquardt beside Adam, and from 20 random starts.

`python experiments/transfer_recovery.py [--json FILE] [--figure FILE] [--quick]`; the volume is looked for in `$JVR_DATA`.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import optax
import optimistix as optx

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from experiments.protocols import Protocol, ct_head, diffdvr

UNKNOWNS = lambda scene: (scene.transfer.rgb, scene.transfer.sigma_t)
# A start counts as recovered once its held-out view is this good.
RECOVERED = 50.0


def row(name: str, result: jvr.FitResult) -> dict[str, Any]:
    """One line of the table: scores of the view that took no part."""
    ((psnr, ssim),) = result.stats.held_out
    return {
        "method": name,
        "held_out_psnr": psnr,
        "held_out_ssim": ssim,
        "fit_psnr": result.history[-1].psnr,
        "steps": len(result.history),
        "seconds": result.stats.seconds,
        "outcome": result.outcome.value,
    }


def fit(protocol: Protocol, **keywords: Any) -> jvr.FitResult:
    """A fit by a protocol, with a line of progress on stderr."""
    return jvr.fit(
        protocol.start,
        protocol.cameras,
        protocol.images,
        settings=protocol.settings,
        unknowns=UNKNOWNS,
        held_out=protocol.held_out,
        **keywords,
    )


def adam(steps: int) -> dict[str, Any]:
    """DiffDVR's own settings: Adam, learning rate 0.8, L1, squared-first-difference smoothness 0.4 on colour."""
    solver = optx.OptaxMinimiser(optax.adam(0.8), rtol=0.0, atol=0.0)
    return {"solver": solver, "loss": jvr.AbsoluteError(), "priors": (jvr.ColourSmoothness(0.4),), "max_steps": steps}


def random_starts(protocol: Protocol, count: int) -> dict[str, Any]:
    """The success rate of Levenberg-Marquardt from random tables: colours uniform, extinctions log-uniform over three decades."""
    rng = np.random.default_rng(0)
    scores = []
    for i in range(count):
        n = UNKNOWNS(protocol.start)[0].shape[0]
        tables = (rng.random((n, 3)), 10 ** rng.uniform(-3.5, -0.5, n))
        start = eqx.tree_at(UNKNOWNS, protocol.start, tuple(np.asarray(t, np.float32) for t in tables))
        result = fit(Protocol(**{**vars(protocol), "start": start}))
        scores.append(result.stats.held_out[0][0])
        print(f"start {i + 1} of {count}: held-out PSNR {scores[-1]:.1f} dB", file=sys.stderr, flush=True)
    return {"starts": count, "recovered": float(np.mean(np.asarray(scores) > RECOVERED)), "held_out_psnr": scores}


def main() -> None:
    """Runs the table and the random starts, prints both, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of the convergence of each method")
    parser.add_argument("--quick", action="store_true", help="smaller images and fewer steps")
    arguments = parser.parse_args()
    head, published = ct_head(size=64 if arguments.quick else 128), diffdvr(size=64 if arguments.quick else 256)
    if head is None or published is None:
        sys.exit("ct_head_quarter/ct_head_quarter.mhd not found: set JVR_DATA to the folder of the public volumes")
    steps = 40 if arguments.quick else 200
    results = {
        "CT head, Levenberg-Marquardt": fit(head),
        "DiffDVR protocol, Levenberg-Marquardt": fit(published),
        "DiffDVR protocol, Adam as published": fit(published, **adam(steps)),
    }
    table = [row(name, result) for name, result in results.items()]
    print(f"{'method':<40}{'PSNR':>8}{'SSIM':>9}{'steps':>7}{'seconds':>9}")
    for line in table:
        print(
            f"{line['method']:<40}{line['held_out_psnr']:>8.2f}{line['held_out_ssim']:>9.5f}{line['steps']:>7}{line['seconds']:>9.1f}"
        )
    small = ct_head(size=64)
    assert small is not None
    starts = random_starts(small, 3 if arguments.quick else 20)
    print(f"recovered (held-out PSNR above {RECOVERED:g} dB) from {starts['recovered']:.0%} of {starts['starts']} random starts")
    if arguments.json:
        Path(arguments.json).write_text(json.dumps({"table": table, "random_starts": starts}, indent=2) + "\n")
    if arguments.figure:
        figure(results, arguments.figure)


def figure(results: dict[str, jvr.FitResult], path: str) -> None:
    """PSNR of the rays in use against seconds."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    drawing = Figure(figsize=(7, 4), layout="constrained")
    axes = drawing.subplots()
    for name, result in results.items():
        axes.plot([e.seconds for e in result.history], [e.psnr for e in result.history], marker=".", label=name)
    axes.set(xlabel="seconds", ylabel="PSNR (dB)", xscale="log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.legend(frameon=False)
    drawing.savefig(path, dpi=150)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
