"""Flags and arguments that several commands have."""

from pathlib import Path
from typing import Annotated

import typer

Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key, e.g. settings.step=0.25. Repeatable.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one machine-readable object on stdout.")]
Force = Annotated[bool, typer.Option("--force", help="Replace the results of another fit in the folder.")]
Shape = Annotated[str | None, typer.Option(metavar="X,Y,Z", help="Voxels of a headerless file.")]
Dtype = Annotated[str | None, typer.Option(help="NumPy type of a headerless file, such as uint8 or >i2.")]
Spacing = Annotated[str | None, typer.Option(metavar="X,Y,Z", help="Millimetres between voxels, in place of the file's.")]
Origin = Annotated[
    str | None, typer.Option(metavar="X,Y,Z", help="Position of the first voxel in millimetres, in place of the file's.")
]
Direction = Annotated[
    str | None, typer.Option(metavar="NUMBERS", help="Nine numbers: x, y, z of each of the grid's axes, in place of the file's.")
]
Slope = Annotated[float | None, typer.Option(help="Data units for one stored, in place of the file's.")]
Intercept = Annotated[float | None, typer.Option(help="Data units where 0 is stored, in place of the file's.")]
Array = Annotated[str | None, typer.Option("--array", help="Which array of a .vtk, .vti or .zarr, or image of a .tif.")]
Series = Annotated[str | None, typer.Option(help="Which series of a DICOM folder.")]
Axes = Annotated[str | None, typer.Option(help="Names of the axes of a .npy, .tif or .zarr, such as zyx or tczyx.")]
Channel = Annotated[str | None, typer.Option(help="Which of several channels: its index from 0, or its name.")]
Time = Annotated[int | None, typer.Option("--time", min=0, help="Which of several points in time: its index from 0.")]
NanValue = Annotated[float | None, typer.Option(help="Number that takes the place of NaN and infinite voxels.")]
Missing = Annotated[
    str | None,
    typer.Option(metavar="NUMBER|none", help='The number that means "no data", in data units.', show_default="by the file"),
]
Input = Annotated[Path, typer.Argument(metavar="CONFIG|VOLUME", help="A configuration (.toml) or a volume file.")]
ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="A configuration (.toml).")]
Layers = Annotated[bool, typer.Option("--layers", help="Layers of its surfaces as channels of the .exr.", show_default=False)]
Orbit = Annotated[
    int | None,
    typer.Option(metavar="N", help="So many pictures from all around, and an animation (.gif).", show_default=False),
]
