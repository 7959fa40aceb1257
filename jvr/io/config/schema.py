"""The tables and keys of a configuration. Numbers are checked here, with their units; objects are made in `build`.

Lengths are millimetres where the volume's file says so; a file without a unit defines its own.
"""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from jvr.io.config.checks import extinctions, increasing, number, numbers, problem, whole
from jvr.io.config.errors import did_you_mean, shown

Scalar = Annotated[float, number("in the data's own units")]
Length = Annotated[float, number("mm", 0.0, inner=True)]
Position = Annotated[list[float], numbers(3, "x, y, z in mm")]
Colour = Annotated[list[float], numbers(3, "red, green, blue, linear")]
Positions = Annotated[list[float], numbers(None, "in the data's own units"), AfterValidator(increasing)]
Range = Annotated[list[float], numbers(2, "low, high in the data's own units"), AfterValidator(increasing)]
Extinctions = Annotated[list[Any], BeforeValidator(extinctions)]
Extinction = Annotated[float, number("extinction per mm", 0.0)]
Pixels = Annotated[int, whole("pixels", 1)]
Angle = Annotated[float, number("full vertical angle in degrees", 0.0, 180.0, inner=True)]


class Table(BaseModel):
    """A table of TOML: no unknown keys, no conversions between types."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:
        for key in data if isinstance(data, dict) else ():
            if key not in cls.model_fields:
                raise problem(f"unknown key; {did_you_mean(key, cls.model_fields)}", key)
        return data

    def _one_of(self, *names: str) -> None:
        given = [name for name in names if getattr(self, name) is not None]
        if len(given) > 1:
            raise problem(f"excludes {given[0]}: give one of the two", given[1])
        if not given:
            raise problem(f"missing; needs {' or '.join(names)}", names[0])

    def _same_length(self, first: str, *others: str) -> None:
        count = len(getattr(self, first))
        for other in others:
            if len(getattr(self, other)) != count:
                raise problem(f"has {len(getattr(self, other))} entries, {first} has {count}: give as many", other)


class VolumeTable(Table):
    """Where the voxels come from: a file, or a formula of jvr's own."""

    path: str | None = None
    builtin: Literal["demo"] | None = None
    source: str | None = None
    shape: list[Annotated[int, whole("voxels along x, y, z", 1)]] | None = None
    dtype: str | None = None
    spacing: Annotated[list[float], numbers(3, "mm along x, y, z", 0.0, inner=True)] | None = None
    origin: Position | None = None
    array: str | None = None
    series: str | None = None
    axes: str | None = None
    nan_value: Scalar | None = None
    interpolation: Literal["trilinear", "nearest"] = "trilinear"
    scale: Range | None = None
    packed: bool = False

    @model_validator(mode="after")
    def _check(self) -> "VolumeTable":
        self._one_of("path", "builtin")
        return self


class LinearTable(Table):
    """`jvr.LinearTransfer`."""

    kind: Literal["linear"]
    positions: Annotated[Positions, Field(min_length=2)]
    rgb: list[Colour]
    sigma_t: Extinctions

    @model_validator(mode="after")
    def _check(self) -> "LinearTable":
        self._same_length("positions", "rgb", "sigma_t")
        return self


class LutTable(Table):
    """`jvr.LutTransfer`."""

    kind: Literal["lut"]
    domain: Range
    rgb: Annotated[list[Colour], Field(min_length=2)]
    sigma_t: Extinctions

    @model_validator(mode="after")
    def _check(self) -> "LutTable":
        self._same_length("rgb", "sigma_t")
        return self


class GaussianTable(Table):
    """`jvr.GaussianTransfer`."""

    kind: Literal["gaussian"]
    center: Annotated[list[float], numbers(None, "in the data's own units"), Field(min_length=1)]
    width: Annotated[list[float], numbers(None, "in the data's own units", 0.0, inner=True)]
    height: Extinctions
    rgb: list[Colour]

    @model_validator(mode="after")
    def _check(self) -> "GaussianTable":
        self._same_length("center", "width", "height", "rgb")
        return self


class GaussianPart(Table):
    """`height * exp(-(s - center)^2 / (2 width^2))`."""

    kind: Literal["gaussian"]
    center: Scalar
    width: Annotated[float, number("in the data's own units", 0.0, inner=True)]
    height: Extinction


class RampPart(Table):
    """0 up to the first value of `between`, `height` from the second on, linear in between."""

    kind: Literal["ramp"]
    between: Range
    height: Extinction


Part = Annotated[GaussianPart | RampPart, Field(discriminator="kind")]


class SampledTable(Table):
    """A `jvr.LutTransfer` with extinction summed from parts and colours blended smoothly between a few."""

    kind: Literal["sampled"]
    entries: Annotated[int, whole("entries of the table", 2)]
    domain: Range
    positions: Positions
    rgb: list[Colour]
    extinction: list[Part]

    @model_validator(mode="after")
    def _check(self) -> "SampledTable":
        self._same_length("positions", "rgb")
        return self


class PresetTable(Table):
    """One of `jvr.presets`, for CT in Hounsfield units."""

    kind: Literal["preset"]
    preset: Literal["ct_bone", "ct_soft_tissue", "ct_lung", "ct_vessels"]


class WindowTable(Table):
    """`jvr.presets.window_level`; without window and level they come from the volume's values."""

    kind: Literal["window"]
    window: Annotated[float, number("width in the data's own units", 0.0, inner=True)] | None = None
    level: Scalar | None = None
    sigma_t: Extinction | None = None
    rgb: Colour = [1.0, 1.0, 1.0]

    @model_validator(mode="after")
    def _check(self) -> "WindowTable":
        if (self.window is None) != (self.level is None):
            raise problem("missing; give window and level, or neither", "window" if self.window is None else "level")
        return self


class TransferFile(Table):
    """A transfer function in a file of its own, as a fit writes it."""

    kind: Literal["file"]
    path: str


AnyTransfer = LinearTable | LutTable | GaussianTable | SampledTable | PresetTable | WindowTable | TransferFile
TransferTable = Annotated[AnyTransfer, Field(discriminator="kind")]


class ClippingTable(Table):
    """`jvr.ClippingBox`."""

    lower: Position
    upper: Position


class CameraTable(Table):
    """What all cameras share."""

    target: Position | None = None
    width: Pixels = 512
    height: Pixels = 512


class PerspectiveTable(CameraTable):
    """`jvr.PerspectiveCamera`; without `eye`, a view from the front, above and to the side that shows the whole volume."""

    kind: Literal["perspective"]
    eye: Position | None = None
    up: Position | None = None
    fov_y: Angle = 30.0


class OrthographicTable(CameraTable):
    """`jvr.OrthographicCamera`."""

    kind: Literal["orthographic"]
    eye: Position | None = None
    up: Position | None = None
    height_world: Length | None = None


class RigTable(CameraTable):
    """Several cameras around the target: `jvr.fibonacci_sphere` or `jvr.orbit`."""

    kind: Literal["fibonacci", "orbit"]
    count: Annotated[int, whole("cameras", 1)]
    radius: Length | None = None
    fov_y: Angle | None = None
    half_angle_tangent: Annotated[float, number("tangent of half the vertical angle", 0.0, inner=True)] | None = None
    axis: Position | None = None

    @model_validator(mode="after")
    def _check(self) -> "RigTable":
        if self.fov_y is not None and self.half_angle_tangent is not None:
            raise problem("excludes fov_y: give one of the two", "half_angle_tangent")
        if self.axis is not None and self.kind != "orbit":
            raise problem('only kind = "orbit" has an axis', "axis")
        return self


def _cameras(value: Any) -> Any:
    """One table or a list of them; perspective unless they say otherwise."""
    tables = value if isinstance(value, list) else [value]
    return [{"kind": "perspective", **table} if isinstance(table, dict) else table for table in tables]


AnyCamera = Annotated[PerspectiveTable | OrthographicTable | RigTable, Field(discriminator="kind")]
Cameras = Annotated[list[AnyCamera], BeforeValidator(_cameras), Field(min_length=1)]


class UniformTable(Table):
    """`jvr.Uniform`."""

    kind: Literal["uniform"]


class SlicesTable(Table):
    """`jvr.Slices`."""

    kind: Literal["slices"]
    oracle: Literal["local-error", "opacity-change", "brick-range", "finest"] = "local-error"
    tolerance: Annotated[float, number("opacity and radiance of one voxel", 0.0, inner=True)] = 0.01
    levels: Literal[0, 1, 2, 3, 4, 5] = 3


class RefinementTable(Table):
    """`jvr.Refinement`."""

    kind: Literal["refinement"]
    tolerance: Annotated[float, number("radiance and opacity, 0 for every ray", 0.0)] = 0.005
    tile: Literal[2, 4, 8, 16, 32, 64] = 8


def _sampling(value: Any) -> Any:
    """A table, or the name of a kind with its defaults."""
    return {"kind": value} if isinstance(value, str) else value


AnySampling = Annotated[UniformTable | SlicesTable | RefinementTable, Field(discriminator="kind")]
Sampling = Annotated[AnySampling, BeforeValidator(_sampling)]


class SettingsTable(Table):
    """`jvr.Settings`."""

    step: Annotated[float, number("length of a step in voxels of the smallest spacing", 0.0, inner=True)] = 0.5
    termination: Annotated[float, number("transmittance at which a ray ends, 0 for never", 0.0, 0.999)] = 1e-4
    quadrature: Literal["midpoint", "pre-integrated"] = "midpoint"
    skipping: bool = True
    negligible: Annotated[float, number("optical depth that a ray may leave out, 0 for none", 0.0, 0.999)] = 0.0
    tile: Annotated[int, whole("rays at a time", 1)] = 262_144
    adjoint: Literal["replay", "forward", "rows"] = "replay"
    sampling: Sampling = UniformTable(kind="uniform")


class StartTable(Table):
    """The table that a fit starts from: one grey and one extinction for every entry."""

    entries: Annotated[int, whole("entries of the table", 2)] = 64
    grey: Annotated[float, number("linear radiance", 0.0, 1.0)] = 0.5
    opacity: Annotated[float, number("optical depth of one voxel", 0.0)] | None = None
    sigma_t: Extinction | None = None
    domain: Range | None = None

    @model_validator(mode="after")
    def _check(self) -> "StartTable":
        if self.opacity is not None and self.sigma_t is not None:
            raise problem("excludes opacity: give one of the two", "sigma_t")
        return self


class PriorsTable(Table):
    """Strengths of the priors; what is not named is not used."""

    colour_smoothness: Annotated[float, number("strength", 0.0)] | None = None
    extinction_smoothness: Annotated[float, number("strength", 0.0)] | None = None
    sparsity: Annotated[float, number("strength", 0.0)] | None = None


def _keep(value: Any) -> Any:
    if not isinstance(value, bool) and not (isinstance(value, int) and value > 0):
        raise problem(f"must be true, false or the most bytes to take, not {shown(value)}")
    return value


def _held_out(value: Any) -> Any:
    """A number of extra views, or which of the images to hold out."""
    views = value if isinstance(value, list) else [value]
    if any(isinstance(v, bool) or not isinstance(v, int) or v < 0 for v in views):
        raise problem(f"must be a number of extra views, or a list of indices of images, not {shown(value)}")
    return value


LEAST_SQUARES = ("levenberg-marquardt", "gauss-newton", "dogleg")


class FitTable(Table):
    """What `jvr.fit` finds, and how. Target images are files, or are rendered with the transfer function of `[truth]`."""

    unknowns: Annotated[list[str], Field(min_length=1)] = ["transfer.rgb", "transfer.sigma_t"]
    images: Annotated[list[str], Field(min_length=1)] | None = None
    start: StartTable | None = None
    solver: Literal["levenberg-marquardt", "gauss-newton", "dogleg", "lbfgsb", "bfgs", "lbfgs", "adam"] = "levenberg-marquardt"
    max_steps: Annotated[int, whole("steps", 1)] = 100
    rtol: Annotated[float, number("relative change at which the fit ends", 0.0, 1.0, inner=True)] | None = None
    learning_rate: Annotated[float, number("of Adam, on the transformed unknowns", 0.0, inner=True)] = 0.05
    loss: Literal["squared-error", "huber", "absolute-error", "dssim"] = "squared-error"
    huber_delta: Annotated[float, number("radiance", 0.0, inner=True)] = 0.05
    priors: PriorsTable = PriorsTable()
    exposure: bool = False
    keep_samples: Annotated[bool | int, BeforeValidator(_keep)] = True
    held_out: Annotated[int | list[int], BeforeValidator(_held_out)] = 0

    @model_validator(mode="after")
    def _check(self) -> "FitTable":
        if self.loss == "dssim" and self.solver in LEAST_SQUARES:
            raise problem(f"'dssim' is not a sum over pixels, which solver = '{self.solver}' needs: use 'bfgs' or 'adam'", "loss")
        return self


class ConfigTable(Table):
    """A whole configuration."""

    volume: VolumeTable
    transfer: TransferTable | None = None
    truth: TransferTable | None = None
    background: Colour | None = None
    optical: Literal["emission-absorption", "emission-only", "absorption-only"] = "emission-absorption"
    clipping: ClippingTable | None = None
    camera: Cameras = [PerspectiveTable(kind="perspective")]
    settings: SettingsTable = SettingsTable()
    fit: FitTable | None = None

    @model_validator(mode="after")
    def _check(self) -> "ConfigTable":
        fit = self.fit
        if fit is None and self.transfer is None and self.truth is None:
            raise problem('missing; add a table such as [transfer] kind = "window"', "transfer")
        if fit is None:
            return self
        if fit.images is None and self.truth is None:
            raise problem("missing; name the target images, or give a [truth] to render them with", "fit.images")
        if fit.images is not None and self.truth is not None:
            raise problem("excludes [truth]: the targets are files, or rendered with the truth", "fit.images")
        if fit.start is not None and self.transfer is not None:
            raise problem("excludes [transfer]: a fit starts from one of the two", "fit.start")
        if fit.images is not None and isinstance(fit.held_out, int) and fit.held_out:
            raise problem("must be a list of indices of fit.images: extra views of a photograph do not exist", "fit.held_out")
        return self
