"""The page of results: `python -m benchmarks.peers.report RUN.json PAGE.md` replaces what stands between two marks in the page."""

import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

BEGIN, END = "<!-- results -->", "<!-- end of results -->"
NAMES = {
    "jvr": "jvr",
    "vtk": "VTK fixed-point",
    "vtk_gpu": "VTK GPU mapper",
    "compiled": "C++ loop",
    "torch": "PyTorch",
    "mitsuba": "Mitsuba",
}
FIGURES = {
    "forward_jvr_over_vtk": "picture, jvr / VTK fixed-point, median of the scenes",
    "forward_jvr_over_vtk_gpu": "picture, jvr / VTK GPU mapper, median of the scenes",
    "forward_jvr_over_compiled": "picture, jvr / C++ loop, median of the scenes",
    "gradient_torch_over_jvr": "picture and gradient, PyTorch / jvr, median of the scenes",
    "absorption_mitsuba_over_jvr": "absorbing medium, Mitsuba / jvr",
    "fit_over_torch_gradient": "whole fit to 60 dB in jvr / one gradient over the same views in PyTorch",
    "picture_in_8_times_the_box": "jvr, the same object in a box of 8 times the volume: picture",
    "gradient_in_8_times_the_box": "the same: picture and gradient",
    "fit_in_8_times_the_box": "the same: fit to 60 dB",
}


def page(run: dict[str, Any], text: str) -> str:
    """The page with the results of this run."""
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}\n\n{results(run)}\n\n{END}{after}"


def results(run: dict[str, Any]) -> str:
    """All tables of a run, as Markdown."""
    peers = run["peers"]
    figures = [[FIGURES.get(name, name.replace("_", " ")), _number(value)] for name, value in peers["figures"].items()]
    parts: list[str] = [_machine(run), "### Figures", _table(["figure", "ratio"], figures), "### Where jvr loses", losses(peers)]
    sections = {
        "Pictures": ("forward", "jvr_over", "jvr / {}"),
        "Pictures of a growing sparse volume": ("growth", "jvr_over", "jvr / {}"),
        "Picture and gradient": ("gradient", "over_jvr", "{} / jvr"),
        "Picture and gradient of a growing sparse volume": ("gradient_growth", "over_jvr", "{} / jvr"),
    }
    for title, (name, key, ratio) in sections.items():
        parts += [f"### {title}", _rows(peers[name], key, ratio)]
    absorbing = peers["absorption"]
    parts += ["### Absorbing medium", absorbing.get("skipped") or _rows([absorbing], "over_jvr", "{} / jvr")]
    parts += [f"Single scattering: {peers['single_scattering']['skipped']}."]
    parts += ["### Fit", _fit(peers["fit"])]
    return "\n\n".join(parts)


def losses(peers: dict[str, Any]) -> str:
    """Every comparison in which a peer was faster or `jvr` took more memory, worst first."""
    found = []
    for table, what in (("forward", "picture"), ("growth", "picture"), ("gradient", "gradient"), ("gradient_growth", "gradient")):
        for row in peers[table]:
            slower = {**row.get("jvr_over", {}), **{name: 1 / value for name, value in row.get("over_jvr", {}).items()}}
            found += [(ratio, f"{what} of {_about(row)}", name, "time") for name, ratio in slower.items() if ratio > 1]
            found += _more_memory(row, f"{what} of {_about(row)}")
    rows = [[what, NAMES[name], kind, f"{ratio:.1f}"] for ratio, what, name, kind in sorted(found, reverse=True)]
    return _table(["what", "against", "of", "jvr / peer"], rows) if rows else "Nowhere in this run."


def _more_memory(row: dict[str, Any], what: str) -> list[tuple[float, str, str, str]]:
    takers = {name: taker["peak_bytes"] for name, taker in row["renderers"].items() if "peak_bytes" in taker}
    return [(takers["jvr"] / taken, what, name, "memory") for name, taken in takers.items() if takers["jvr"] > taken > 0]


def _machine(run: dict[str, Any]) -> str:
    machine, peers = run["machine"], run["peers"]
    lines = [
        f"Measured on {machine['date']}: {machine['processor']}, {machine['platform']}, Python {machine['python']}; "
        f"{peers['threads']} of {machine['cores']} cores used.",
        "; ".join(f"{NAMES[name]} {version}" for name, version in peers["versions"].items()) + ".",
        *(f"{NAMES[name]}: absent ({why})." for name, why in peers["absent"].items()),
    ]
    if peers["quick"]:
        lines.append("**A quick run: small sizes and few rounds, not to be quoted.**")
    return "\n".join(lines)


def _rows(rows: list[dict[str, Any]], key: str, ratio: str) -> str:
    """One line for each renderer of each scene."""
    head = ["scene", "renderer", "step (voxels)", "RMSE", "seconds", "peak MB", ratio.format("peer")]
    lines = []
    for row in rows:
        for name, taken in row["renderers"].items():
            if "failed" in taken:
                lines.append([_about(row), NAMES[name], f"failed: {taken['failed']}", "", "", "", ""])
                continue
            step = f"{taken['samples_per_pixel']} samples" if "samples_per_pixel" in taken else f"{taken['step']:.3g}"
            error = f"{taken['rmse']:.2g}" + ("" if taken["reached"] else " (best)")
            times = [f"{taken['seconds']:.3g}", f"{taken['peak_bytes'] / 1e6:.0f}"]
            lines.append([_about(row), NAMES[name], step, error, *times, _number(row[key].get(name))])
    return _table(head, lines)


def _fit(fit: dict[str, Any]) -> str:
    lines = [[key.replace("_", " "), value if isinstance(value, str) else _number(value)] for key, value in fit.items()]
    return _table(["", ""], lines)


def _about(row: dict[str, Any]) -> str:
    size = lambda name: " x ".join(map(str, row[name]))
    return f"{row['scene']} ({row['data']}), {size('voxels')}, {size('picture')} pixels"


def _number(value: Any) -> str:
    return "" if value is None else f"{value:.3g}" if abs(value) < 1e4 else f"{value:,.0f}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, ["---"] * len(head), *rows])


if __name__ == "__main__":
    run, target = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
    target.write_text(page(run, target.read_text()))
