"""The commands and their flags."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from jvr.cli.beforehand import lines_of
from jvr.cli.flags import given_of, triple
from jvr.cli.inputs import (
    BadInput,
    check_file_output,
    check_folder_output,
    check_image_output,
    check_inputs_stay,
    explain,
    inputs_of,
    load,
    name_of,
    reading,
)
from jvr.cli.options import (
    Array,
    Axes,
    Channel,
    ConfigFile,
    Direction,
    Dtype,
    Force,
    Input,
    Intercept,
    Json,
    Layers,
    Missing,
    NanValue,
    Orbit,
    Origin,
    Series,
    Set,
    Shape,
    Slope,
    Spacing,
    Time,
)

HELP = "Differentiable volume rendering: pictures of scalar volumes, and transfer functions from pictures."
# Without markup, which would take the names of tables in brackets for its own.
app = typer.Typer(help=HELP, rich_markup_mode=None, pretty_exceptions_enable=False)


def _examples(*lines: str) -> str:
    # The mark keeps the lines as they are.
    return "\n".join(["\b", "Examples:", *(f"  {line}" for line in lines)])


def _version(wanted: bool | None) -> None:
    if wanted:
        from jvr import __version__

        typer.echo(f"jvr {__version__}")
        raise typer.Exit


@app.callback()
def every_command(
    version: Annotated[
        bool | None, typer.Option("--version", help="Say which jvr this is.", callback=_version, is_eager=True)
    ] = None,
) -> None:
    """What comes before a command."""


@app.command(
    epilog=_examples(
        "jvr render configs/demo.toml -o demo.png",
        "jvr render head.nii.gz --preset ct_bone --view front --size 800",
        "jvr render scan.mhd --orbit 36 --background white",
    )
)
def render(
    given: Input,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Picture, .exr or .png.", show_default="NAME.png")] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help="ct, ct_bone, ct_soft_tissue, ct_lung, ct_vessels (angiography), mr, micro_ct, scan, labels, or one of 3D Slicer's, "
            "such as CT-Bone; default: by the values."
        ),
    ] = None,
    view: Annotated[
        str | None, typer.Option(help="oblique, front, back, left, right, top or bottom of the patient.", show_default="oblique")
    ] = None,
    up: Annotated[str | None, typer.Option(metavar="X,Y,Z", help="What is up in the picture.", show_default="0,0,1")] = None,
    background: Annotated[
        str | None, typer.Option(help="A name, #rrggbb, or linear radiance as R,G,B.", show_default="black")
    ] = None,
    lit: Annotated[
        bool | None,
        typer.Option("--lit/--unlit", help="Surfaces under a light at the eye, or colours as they are.", show_default="lit"),
    ] = None,
    orbit: Orbit = None,
    size: Annotated[int | None, typer.Option(min=1, help="Width and height in pixels, for every camera.")] = None,
    layers: Layers = False,
    sets: Set = None,
    shape: Shape = None,
    dtype: Dtype = None,
    spacing: Spacing = None,
    origin: Origin = None,
    direction: Direction = None,
    slope: Slope = None,
    intercept: Intercept = None,
    array: Array = None,
    series: Series = None,
    axes: Axes = None,
    channel: Channel = None,
    time: Time = None,
    missing: Missing = None,
    nan_value: NanValue = None,
    as_json: Json = False,
) -> None:
    """Render a picture of a configuration's scene, or of a volume file directly."""
    from jvr.cli.first import Wishes, configured
    from jvr.cli.render import render_pictures

    with reading():
        output = Path(f"{name_of(given)}.png") if output is None else output
        check_image_output(output)
        choice = {"array": array, "series": series, "axes": axes, "channel": channel, "time": time}
        scaled = {"slope": slope, "intercept": intercept, "missing": missing, "nan_value": nan_value}
        keywords = given_of(shape, spacing, origin, direction, dtype=dtype, **choice, **scaled)
        wishes = Wishes(preset, view, triple(up, "--up", float, positive=False), background, orbit, lit)
        config, volume, notes = configured(given, sets or [], keywords, wishes)
        config = _sized(config, size)
    for note in notes:
        explain(f"note: {note}", 0)
    report = render_pictures(config, output, volume, animated=orbit is not None, layers=layers)
    report["notes"] = notes
    lines = [*report["outputs"], *lines_of(report["precomputed"])]
    _print(
        report, as_json, "\n".join([*lines, f"{report['seconds']:.2f} s, of which {report['compile_seconds']:.2f} s compiling"])
    )


@app.command(epilog=_examples("jvr fit configs/demo.toml -o out", "jvr fit configs/demo.toml -o out --resume"))
def fit(
    given: ConfigFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results; created where it does not exist.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the folder's checkpoint.npz.")] = False,
    force: Force = False,
    sets: Set = None,
    as_json: Json = False,
) -> None:
    """Find the transfer function (or other unknowns) that makes a volume look like the target images.

    Radiance transfer is computed once, for the start of the fit, and kept though the transfer function may change, unless the configuration
    says [radiance_transfer] frozen = false: then each evaluation computes it again, which is right and takes many times as long.
    """
    from jvr.cli.fit import fit_scene

    with reading():
        config = load(given, sets or [])
        check_folder_output(output)
    report = fit_scene(config, output, resume=resume, force=force)
    _print(report, as_json, _summary(report, output))


@app.command(epilog=_examples("jvr tune configs/demo.toml --error 1e-3 -o tuned.toml", "jvr tune configs/demo.toml --time 0.1"))
def tune(
    given: ConfigFile,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Copy of the configuration.", show_default="NAME-tuned.toml")
    ] = None,
    error: Annotated[
        float | None, typer.Option(help="Root mean square error, linear radiance: find the fastest settings.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--time", help="Seconds for a picture: find the most accurate settings.")
    ] = None,
    sets: Set = None,
    as_json: Json = False,
) -> None:
    """Find the settings that a scene needs for an error, or can have for a time, and write a configuration with them."""
    from jvr.cli.tune import tune_settings

    output = given.with_name(f"{given.stem}-tuned.toml") if output is None else output
    with reading():
        if (error is None) == (seconds is None):
            raise BadInput("give either --error or --time")
        for flag, value in (("--error", error), ("--time", seconds)):
            if value is not None and not 0 < value < float("inf"):
                raise BadInput(f"{flag} must be a positive number, not {value:g}")
        config = load(given, sets or [])
        check_file_output(output, "tuned.toml")
        check_inputs_stay(output, inputs_of(config))
    report = tune_settings(config, output, error, seconds)
    lines = lines_of(report["precomputed"])
    for name in ("predicted", "measured"):
        lines.append(f"{name + ':':<11}RMSE {report[name]['rmse']:.2e}, {1e3 * report[name]['seconds']:.0f} ms")
    said = lambda value: f"{value:g}" if isinstance(value, float) else str(value)
    for table, values in report["tables"].items():
        lines.append(f"[{table}]  " + ", ".join(f"{key} = {said(value)}" for key, value in values.items()))
    lines.append(f"written to {output}")
    _print(report, as_json, "\n".join(lines))


@app.command(epilog=_examples("jvr plan configs/lit.toml", "jvr plan configs/lit.toml --measure --tolerance 1/255"))
def plan(
    given: ConfigFile,
    measure: Annotated[
        bool, typer.Option("--measure", help="Render with and without each effect: its share of time, and what it changes.")
    ] = False,
    tolerance: Annotated[
        str | None,
        typer.Option(metavar="X", help="Propose what to drop or coarsen within this RMSE, such as 1/255; measures as well."),
    ] = None,
    sets: Set = None,
    as_json: Json = False,
) -> None:
    """Say what a rendering compiles to: which parts are in the program, why, and what they need."""
    from jvr.cli.advise import advise_on, as_tolerance

    bound = None if tolerance is None else as_tolerance(tolerance)
    with reading():
        from jvr.cli.runtime import start_jax
        from jvr.io.config import build_scene, build_settings
        from jvr.rendering.plan import plan as make_plan

        start_jax()
        config = load(given, sets or [])
        scene = build_scene(config)
        if scene.is_precomputable:
            from jvr.io.precompute import as_precomputed

            # The plan of what the other commands compile; it needs no numbers.
            scene = as_precomputed(scene)
        made = make_plan(scene, build_settings(config))
    parts = [{"name": p.name, "included": p.included, "reason": p.reason, "needs": list(p.needs)} for p in made.parts]
    report, text = {"command": "plan", "config": str(given), "parts": parts}, str(made)
    if measure or bound is not None:
        found, measured = advise_on(config, bound)
        report, text = report | measured, "\n".join([text, "", *lines_of(measured["precomputed"]), str(found)])
    _print(report, as_json, text)


@app.command(epilog=_examples("jvr info head.nii.gz", "jvr info embryo.raw --shape 256,256,256 --dtype uint8 --json"))
def info(
    volume: Annotated[Path, typer.Argument(metavar="VOLUME", help="A volume file, or a folder of slices.")],
    shape: Shape = None,
    dtype: Dtype = None,
    spacing: Spacing = None,
    origin: Origin = None,
    direction: Direction = None,
    slope: Slope = None,
    intercept: Intercept = None,
    array: Array = None,
    series: Series = None,
    axes: Axes = None,
    channel: Channel = None,
    time: Time = None,
    missing: Missing = None,
    nan_value: NanValue = None,
    as_json: Json = False,
) -> None:
    """Say what a volume holds: shape, type, place in the world, values."""
    with reading():
        from jvr.io.describe import describe, format_description
        from jvr.io.volumes import read_volume

        choice = {"array": array, "series": series, "axes": axes, "channel": channel, "time": time}
        scaled = {"slope": slope, "intercept": intercept, "missing": missing, "nan_value": nan_value}
        keywords = given_of(shape, spacing, origin, direction, dtype=dtype, **choice, **scaled)
        found = describe(read_volume(volume, **keywords), volume)
    _print(found, as_json, format_description(found))


@app.command(epilog=_examples("jvr demo", "jvr demo -o out"))
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results.")] = Path("jvr-demo"),
    force: Force = False,
    sets: Set = None,
    as_json: Json = False,
) -> None:
    """Fit the transfer function of a small volume made by a formula, from six of its pictures; needs no data."""
    from jvr.cli.fit import demo_config, fit_scene

    with reading():
        config = load(demo_config(), sets or [])
        check_folder_output(output)
    report = fit_scene(config, output, force=force)
    _print(report, as_json, _summary(report, output))


@app.command(
    epilog=_examples(
        "jvr preset out/transfer.toml -o bone.vp.json",
        "jvr preset CT-Bone -o bone.toml",
        "jvr preset maps.json --name Jet --range 0,400 -o jet.toml",
    )
)
def preset(
    given: Annotated[
        str,
        typer.Argument(
            metavar="FILE|NAME", help="A transfer function (.toml), .vp, .vp.json, ParaView's .json, or Slicer's name."
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="For jvr (.toml), 3D Slicer (.vp.json, .vp) or ParaView (.json).")
    ],
    name: Annotated[
        str | None, typer.Option(help="Which of several presets of ParaView; of one that is written, its name.")
    ] = None,
    ends: Annotated[
        str | None, typer.Option("--range", metavar="LOW,HIGH", help="Scalars that the ends of ParaView's preset are moved to.")
    ] = None,
    unit_distance: Annotated[
        float | None, typer.Option(help="Millimetres that opacities belong to.", show_default="the file's, or 1")
    ] = None,
    spacing: Annotated[float, typer.Option(help="Mean distance of voxels, for opacity by gradient.")] = 1.0,
    encoding: Annotated[
        str, typer.Option(help="Whether colours of other programs are taken for linear light, or for srgb codes.")
    ] = "linear",
    as_json: Json = False,
) -> None:
    """Convert transfer functions from and to the presets of 3D Slicer and ParaView, and say what they cannot hold."""
    from jvr.cli.preset import convert

    with reading():
        report = convert(given, output, name, ends, unit_distance, spacing, encoding)
    shading = [f"[shading]  {report['shading']}"] if report["shading"] else []
    _print(report, as_json, "\n".join([*shading, f"written to {output}"]))


@app.command(
    "next-view",
    epilog=_examples(
        "jvr next-view out",
        "jvr next-view out --cameras could_be_taken.toml",
        "jvr next-view out --cameras transforms.json --json",
    ),
)
def next_view(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="What jvr fit -o has written.")],
    cameras: Annotated[
        Path | None,
        typer.Option(
            help="Views that could be taken: [[camera]] tables (.toml), transforms.json, VTK's cameras (.json), or a .pvcc.",
            show_default="from all around",
        ),
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, max=10_000, help="Views from all around.", show_default="32")] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Picture of the best three, .png or .exr.", show_default="FOLDER/next_views.png"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Rank views by what one more of them would tell about the unknowns of a finished fit.

    Bits are information about all unknowns together; beside them are the median standard errors of each fitted array before and after. No
    picture is needed for that. Gains of several views do not add up: take the best, fit again, ask again.
    """
    from jvr.cli.folder import NEXT_VIEWS
    from jvr.cli.next_view import rank_views, table

    with reading():
        if cameras is not None and count is not None:
            raise BadInput("--count is of views from all around; leave it or --cameras out")
        output = folder / NEXT_VIEWS if output is None else output
        if folder.is_dir():
            check_image_output(output)
    report = rank_views(folder, cameras, count or 32, output)
    _print(report, as_json, table(report))


def _sized(config: Any, size: int | None) -> Any:
    """The configuration with square pictures of another size."""
    if size is None:
        return config
    import dataclasses

    cameras = [camera.model_copy(update={"width": size, "height": size}) for camera in config.tables.camera]
    return dataclasses.replace(config, tables=config.tables.model_copy(update={"camera": cameras}))


def _summary(report: dict[str, Any], output: Path) -> str:
    psnr = report["views"]["mean_psnr"]
    lines = lines_of(report["precomputed"])
    lines += [f"{report['outcome']} after {len(report['history'])} steps, {report['seconds']:.1f} s; PSNR {psnr:.1f} dB"]
    if report["held_out"]["psnr"]:
        lines.append(f"held-out views: PSNR {report['held_out']['mean_psnr']:.1f} dB")
    if report["transfer_kept"] is not None:
        again = report["transfer_kept"]["mean_psnr"]
        lines.append(f"with the radiance transfer of what was found, not of the start: PSNR {again:.1f} dB")
    return "\n".join([*lines, f"{output / report['page']}"])


def _print(report: dict[str, Any], as_json: bool, text: str) -> None:
    typer.echo(json.dumps(report, allow_nan=False) if as_json else text)
