"""The page of results: `python -m benchmarks.peers.report RUN.json PAGE.md` replaces what stands between marks in the page: all results
by those of `python -m benchmarks peers`, those of single scattering by its own or by those of `python -m benchmarks scattering`."""

import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

NAMES = {
    "jvr": "jvr",
    "jvr_packed": "jvr, 8 bits packed",
    "vtk": "VTK fixed-point",
    "vtk_gpu": "VTK GPU mapper",
    "compiled": "C++ loop",
    "torch": "PyTorch",
    "mitsuba": "Mitsuba",
}
FIGURES = {
    "forward_jvr_over_vtk": "picture, jvr / VTK fixed-point, worst of the scenes",
    "forward_jvr_over_vtk_gpu": "picture, jvr / VTK GPU mapper, worst of the scenes",
    "forward_jvr_over_compiled": "picture, jvr / C++ loop, worst of the scenes",
    "gradient_torch_over_jvr": "picture and gradient, PyTorch / jvr, worst of the scenes",
    "small_gradient_torch_over_jvr": "the same in small pictures",
    "absorption_mitsuba_over_jvr": "absorbing medium, Mitsuba / jvr",
    "scattering_mitsuba_over_jvr": "single scattering, Mitsuba / jvr, worst of the media",
    "fit_over_torch_gradient": "whole fit to 60 dB in jvr / one gradient over the same views in PyTorch",
    "picture_in_8_times_the_box": "jvr, the same object in a box of 8 times the volume: picture",
    "gradient_in_8_times_the_box": "the same: picture and gradient",
    "fit_in_8_times_the_box": "the same: fit to 60 dB",
}


def page(run: dict[str, Any], text: str) -> str:
    """The page with the results of this run."""
    if "peers" in run:
        text = _replaced(text, "results", results(run))
    scattered = run.get("scattering") or run["peers"]
    return _replaced(text, "scattering", scattering(run["machine"], scattered)) if "scattering" in scattered else text


def _replaced(text: str, name: str, part: str) -> str:
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    before, rest = text.split(begin)
    _, after = rest.split(end)
    return f"{before}{begin}\n\n{part}\n\n{end}{after}"


def results(run: dict[str, Any]) -> str:
    """All tables of a run, as Markdown."""
    peers = run["peers"]
    figures = [[FIGURES.get(name, name.replace("_", " ")), _number(value)] for name, value in peers["figures"].items()]
    parts: list[str] = [
        _machine(run["machine"], peers),
        "### Figures",
        _table(["figure", "ratio"], figures),
        "### Where jvr loses",
        *losses(peers),
    ]
    sections = {
        "Pictures": ("forward", "jvr_over", "jvr / {}"),
        "Pictures of a growing sparse volume": ("growth", "jvr_over", "jvr / {}"),
        "Picture and gradient": ("gradient", "over_jvr", "{} / jvr"),
        "Picture and gradient, small": ("gradient_small", "over_jvr", "{} / jvr"),
        "Picture and gradient of a growing sparse volume": ("gradient_growth", "over_jvr", "{} / jvr"),
    }
    for title, (name, key, ratio) in sections.items():
        parts += [f"### {title}", _rows(peers[name], key, ratio)]
    absorbing = peers["absorption"]
    parts += ["### Absorbing medium", _rows([absorbing], "over_jvr", "{} / jvr")]
    parts += ["### Fit", _fit(peers["fit"])]
    return "\n\n".join(parts)


def scattering(machine: dict[str, Any], run: dict[str, Any]) -> str:
    """Single scattering: times at equal error, and the agreement of Mitsuba with the reference."""
    rows = run["scattering"]
    found, close = [], lambda value, deviation: f"{value:.4f} ± {deviation:.4f}"
    for row in (row for row in rows if "failed" not in row):
        z = row["agreement"]
        mean = f"{close(z['mean_z'], z['mean_z_deviation'])} (0)"
        square = f"{close(z['mean_square_z'], z['mean_square_z_deviation'])} ({z['mean_square_z_expected']:.4f})"
        beyond = f"{100 * z['share_beyond_3']:.2f} % ({100 * z['share_beyond_3_expected']:.2f} %)"
        samples = f"{z['pixels']} pixels, {z['pictures']} pictures of {z['samples_per_pixel']} samples"
        found.append([row["data"], samples, mean, square, beyond, close(z["brightness"], z["brightness_deviation"])])
    head = ["medium", "Mitsuba", "mean z", "mean z²", "beyond 3", "brightness"]
    return "\n\n".join([_machine(machine, run), _rows(rows, "over_jvr", "{} / jvr"), _table(head, found)])


def losses(peers: dict[str, Any]) -> list[str]:
    """Every comparison in which a peer was faster, and every one in which it took less memory, worst first."""
    slower, larger = [], []
    for table in ("forward", "growth", "gradient", "gradient_small", "gradient_growth"):
        for row in (row for row in peers[table] if "failed" not in row):
            title = f"{'gradient' if 'gradient' in table else 'picture'} of {_about(row)}"
            over = {**row.get("jvr_over", {}), **{name: 1 / value for name, value in row.get("over_jvr", {}).items()}}
            slower += [(ratio, title, name) for name, ratio in over.items() if ratio > 1]
            larger += _more_memory(row, title)
    tables = []
    for kind, found in (("time", slower), ("memory", larger)):
        rows = [[title, NAMES[name], f"{ratio:.1f}"] for ratio, title, name in sorted(found, reverse=True)]
        tables.append(_table([f"in {kind}", "against", "jvr / peer"], rows) if rows else f"In {kind} nowhere in this run.")
    return tables


def _more_memory(row: dict[str, Any], title: str) -> list[tuple[float, str, str]]:
    takers = {name: taker["peak_bytes"] for name, taker in row["renderers"].items() if "peak_bytes" in taker}
    return [(takers["jvr"] / taken, title, name) for name, taken in takers.items() if takers["jvr"] > taken > 0]


def _machine(machine: dict[str, Any], peers: dict[str, Any]) -> str:
    lines = [
        f"Measured on {machine['date']}: {machine['processor']}, Python {machine['python']}; "
        f"{peers['threads']} of {machine['cores']} cores used.",
        "; ".join(f"{NAMES[name]} {version}" for name, version in peers["versions"].items()) + ".",
        f"The GPU mapper ran on {peers['opengl']}." if peers.get("opengl") else "",
        f"Load of the machine before and after: {peers['load'][0]:.1f}, {peers['load'][1]:.1f}.",
        *(f"{NAMES[name]}: absent ({why})." for name, why in peers["absent"].items()),
    ]
    if peers["quick"]:
        lines.append("**A quick run: small sizes and few rounds, not to be quoted.**")
    return "\n".join(line for line in lines if line)


def _rows(rows: list[dict[str, Any]], key: str, ratio: str) -> str:
    """One line for each renderer of each scene."""
    head = ["scene", "renderer", "step (voxels)", "RMSE", "seconds", "peak MB", ratio.format("peer")]
    lines = []
    for row in rows:
        if "failed" in row:
            lines.append([f"failed: {row['failed']}", *[""] * (len(head) - 1)])
            continue
        for name, taken in row["renderers"].items():
            if "failed" in taken:
                lines.append([_about(row), NAMES[name], f"failed: {taken['failed']}", "", "", "", ""])
                continue
            step = f"{taken['samples_per_pixel']} samples" if "samples_per_pixel" in taken else f"{taken['step']:.3g}"
            step += f", {taken['shadows']}" if "shadows" in taken else ""
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
