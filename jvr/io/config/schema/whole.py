"""Tables of volume, cameras and fit, and the whole of them."""

import dataclasses
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from jvr.io.config.checks import number, numbers, problem, whole
from jvr.io.config.errors import shown
from jvr.io.config.schema.environment import Background, Environments, Geometry, Material, RadianceTransfer
from jvr.io.config.schema.light import (
    Lights,
    Normals,
    Occlusion,
    OneOrMore,
    Scattering,
    Shading,
    Shadows,
    Specular,
    Surfaces,
    casts_shadows,
)
from jvr.io.config.schema.parts import BASES, WRITTEN, KindTable, only, part
from jvr.io.config.schema.table import Extinction, Position, Range, Scalar, Table, one_or_more
from jvr.io.config.schema.transfer import Transfer
from jvr.io.kinds import kind_of, maker_of
from jvr.model.camera import AbstractCamera
from jvr.model.clipping import AbstractClipping
from jvr.model.interpolation import AbstractInterpolation
from jvr.model.optical import AbstractOpticalModel
from jvr.model.parameters import declared
from jvr.model.ranges import AT_LEAST_ONE, FRACTION, NOT_NEGATIVE, POSITIVE, UNIT_INTERVAL, Interval
from jvr.rendering.integrator import AbstractIntegrator
from jvr.rendering.settings import Settings


class VolumeTable(Table):
    """Where the voxels come from: a file, or a formula of jvr's own."""

    path: str | None = None
    builtin: Literal["demo"] | None = None
    source: str | None = None
    shape: list[Annotated[int, whole("voxels along x, y, z", AT_LEAST_ONE)]] | None = None
    dtype: str | None = None
    spacing: Annotated[list[float], numbers(3, "mm along x, y, z", POSITIVE)] | None = None
    origin: Position | None = None
    direction: Annotated[list[Position], Field(min_length=3, max_length=3)] | None = None
    slope: Scalar | None = None
    intercept: Scalar | None = None
    array: str | None = None
    series: str | None = None
    axes: str | None = None
    channel: Annotated[int, whole("index of a channel", NOT_NEGATIVE)] | str | None = None
    time: Annotated[int, whole("index of a point in time", NOT_NEGATIVE)] | None = None
    missing: Scalar | Literal[False] | None = None
    nan_value: Scalar | None = None
    interpolation: Annotated[Any, part(AbstractInterpolation)] | None = None
    scale: Range | None = None
    packed: bool = False

    @model_validator(mode="after")
    def _check(self) -> "VolumeTable":
        self._one_of("path", "builtin")
        return self


class CameraTable(KindTable):
    """What all cameras share. `frame`: what a camera whose place is left out shows whole: the box of the volume, or what the transfer
    function leaves visible of it."""

    found: ClassVar[tuple[str, ...]] = ("fov_y", "height_world", "radius", "width", "height")
    unsaid: ClassVar[tuple[str, ...]] = ("world_from_camera", "center")

    frame: Literal["box", "visible"] = "box"
    target: Position | None = None

    def keywords(self) -> dict[str, Any]:
        """What it says of the arguments of its class."""
        return {name: value for name, value in self.given().items() if name in declared(self.part)}


class SingleTable(CameraTable):
    """Where one camera is, or from which side of the patient (x to the left, y to the back, z up) it looks at all there is."""

    eye: Position | None = None
    view: Literal["oblique", "front", "back", "left", "right", "top", "bottom"] | None = None
    up: Position | None = None

    @model_validator(mode="after")
    def _check(self) -> "SingleTable":
        if self.eye is not None and self.view is not None:
            raise problem("excludes eye: give one of the two", "view")
        return self


class RigTable(CameraTable):
    """Several cameras around the target; their angle of view may be said by its tangent."""

    half_angle_tangent: Annotated[float, number("tangent of half the vertical angle", POSITIVE)] | None = None

    @model_validator(mode="after")
    def _check(self) -> "RigTable":
        if self.half_angle_tangent is not None and "fov_y" in self.given():
            raise problem("excludes fov_y: give one of the two", "half_angle_tangent")
        return self


class FileTable(CameraTable):
    """Cameras of other programs, in a file (`jvr.io.interop.read_cameras`)."""

    path: str
    width: Annotated[int, whole("pixels", Interval(1, 65_536))] | None = None
    height: Annotated[int, whole("pixels", Interval(1, 65_536))] | None = None
    ras: bool = False

    @model_validator(mode="after")
    def _check(self) -> "FileTable":
        for key in ("target", "frame"):
            if key in self.model_fields_set:
                raise problem("the file says where its cameras look: leave it out", key)
        return self


WRITTEN[AbstractCamera] = {"file": FileTable}
BASES |= {AbstractCamera: SingleTable, (AbstractCamera, "fibonacci"): RigTable, (AbstractCamera, "orbit"): RigTable}
Camera = Annotated[Any, part(AbstractCamera, "perspective")]
Cameras = Annotated[list[Camera], BeforeValidator(one_or_more), Field(min_length=1, validate_default=True)]


class SlicesTable(KindTable):
    """`tolerance`: that of the oracle, which may also be said in a table of its own,
    `oracle = { kind = "brick-range", tolerance = 0.02 }`."""

    tolerance: Annotated[float, number("opacity and radiance of one voxel", POSITIVE)] | None = None

    @staticmethod
    def part(tolerance: float | None = None, **keywords: Any) -> Any:
        slices = maker_of(AbstractIntegrator, "slices")(**keywords)
        # Of no tolerance nothing finer can be asked than every sample.
        if tolerance is None or kind_of(slices.oracle) == "finest":
            return slices
        if "tolerance" not in declared(type(slices.oracle)):
            raise ValueError(f"{type(slices.oracle).__name__} has no tolerance: say it in the table of an oracle that has")
        return dataclasses.replace(slices, oracle=dataclasses.replace(slices.oracle, tolerance=tolerance))


BASES[AbstractIntegrator, "slices"] = SlicesTable


class StartTable(Table):
    """The table that a fit starts from: one grey and one extinction for every entry."""

    entries: Annotated[int, whole("entries of the table", Interval(2, 65_536))] = 64
    grey: Annotated[float, number("linear radiance", UNIT_INTERVAL)] = 0.5
    opacity: Annotated[float, number("optical depth of one voxel", NOT_NEGATIVE)] | None = None
    sigma_t: Extinction | None = None
    domain: Range | None = None

    @model_validator(mode="after")
    def _check(self) -> "StartTable":
        if self.opacity is not None and self.sigma_t is not None:
            raise problem("excludes opacity: give one of the two", "sigma_t")
        return self


class TikhonovTable(Table):
    """Strengths of `jvr.Tikhonov`, and the scalar that voxels are drawn to."""

    gradient: Annotated[float, number("strength", NOT_NEGATIVE)] = 0.0
    values: Annotated[float, number("strength", NOT_NEGATIVE)] = 0.0
    reference: Scalar = 0.0


class PriorsTable(Table):
    """Strengths of the priors; what is not named is not used."""

    colour_smoothness: Annotated[float, number("strength", NOT_NEGATIVE)] | None = None
    extinction_smoothness: Annotated[float, number("strength", NOT_NEGATIVE)] | None = None
    sparsity: Annotated[float, number("strength", NOT_NEGATIVE)] | None = None
    total_variation: Annotated[float, number("strength", NOT_NEGATIVE)] | None = None
    tikhonov: TikhonovTable | None = None


class VoxelsTable(Table):
    """A fit of the voxels: the scalar that all of them start with (that of the volume without it), the range that they keep to, and on how
    many grids they are found, from coarse to fine."""

    start: Scalar | None = None
    range: Range | None = None
    levels: Annotated[int, whole("grids", AT_LEAST_ONE)] = 1


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


# Keys that say how target images are read.
OF_IMAGES = ("encoding", "alpha", "layer", "weights")
VOXELS = "volume.values"
LEAST_SQUARES = ("levenberg-marquardt", "gauss-newton", "dogleg")


class FitTable(Table):
    """What `jvr.fit` finds, and how. Target images are files, read by `encoding`, `alpha` and `layer` (`jvr.read_image`) and weighted by
    those of `weights`, or are rendered with the transfer function of `[truth]`. `lights`: those of each view, in place of the scene's."""

    unknowns: Annotated[list[str], Field(min_length=1)] = Field(default=["transfer.rgb", "transfer.sigma_t"])
    images: Annotated[list[str], Field(min_length=1)] | None = None
    encoding: Literal["srgb", "linear"] | None = None
    alpha: Literal["straight", "associated", "ignored"] | None = None
    layer: str | None = None
    weights: Annotated[list[str], Field(min_length=1)] | None = None
    lights: Annotated[list[OneOrMore], Field(min_length=1)] | None = None
    start: StartTable | None = None
    initial: dict[str, Any] = Field(default={})
    solver: Literal["levenberg-marquardt", "gauss-newton", "dogleg", "lbfgsb", "bfgs", "lbfgs", "adam"] = "levenberg-marquardt"
    max_steps: Annotated[int, whole("steps", AT_LEAST_ONE)] = 100
    rtol: Annotated[float, number("relative change at which the fit ends", FRACTION)] | None = None
    learning_rate: Annotated[float, number("of Adam, on the transformed unknowns", POSITIVE)] = 0.05
    loss: Literal["squared-error", "huber", "absolute-error", "dssim"] = "squared-error"
    huber_delta: Annotated[float, number("radiance", POSITIVE)] = 0.05
    priors: PriorsTable = PriorsTable()
    voxels: VoxelsTable | None = None
    exposure: bool = False
    keep_samples: Annotated[bool | int, BeforeValidator(_keep)] = True
    smooth_undetermined: bool = True
    coarse_levels: Annotated[int, whole("levels of blurred pictures to begin with", NOT_NEGATIVE)] = 0
    held_out: Annotated[int | list[int], BeforeValidator(_held_out)] = 0

    @model_validator(mode="after")
    def _check(self) -> "FitTable":
        if self.loss == "dssim" and self.solver in LEAST_SQUARES:
            raise problem(f"'dssim' is not a sum over pixels, which solver = '{self.solver}' needs: use 'bfgs' or 'adam'", "loss")
        if self.voxels is not None and VOXELS not in self.unknowns:
            raise problem(f"is about unknown voxels: name '{VOXELS}' in fit.unknowns, or leave it out", "voxels")
        for key in OF_IMAGES if self.images is None else ():
            if getattr(self, key) is not None:
                raise problem("is about target images in files: name them in fit.images, or leave it out", key)
        return self


_Clipping = Annotated[Any, part(AbstractClipping, "box")]
Clippings = Annotated[
    Annotated[list[_Clipping], Field(min_length=1), Tag("(several)")] | Annotated[_Clipping, Tag("(one)")],
    Discriminator(lambda value: "(several)" if isinstance(value, list) else "(one)"),
]


class ConfigTable(Table):
    """A whole configuration."""

    volume: VolumeTable
    transfer: Transfer | None = None
    truth: Transfer | None = None
    background: Background | None = None
    optical: Annotated[Any, part(AbstractOpticalModel)] | None = None
    clipping: Clippings | None = None
    lights: Lights = Field(default=[])
    shading: Shading | None = None
    shadows: Shadows | None = None
    scattering: Scattering | None = None
    normals: Normals | None = None
    surfaces: Surfaces | None = None
    specular: Specular | None = None
    environment: Environments = Field(default=[])
    material: Material | None = None
    radiance_transfer: RadianceTransfer | None = None
    geometry: Geometry | None = None
    occlusion: Occlusion | None = None
    camera: Cameras = Field(default=[{}])
    settings: Annotated[Any, only(Settings)] = Field(default={}, validate_default=True)
    fit: FitTable | None = None

    @model_validator(mode="after")
    def _check(self) -> "ConfigTable":
        fit = self.fit
        if self.shadows is not None and not any(map(casts_shadows, self.lights)):
            raise problem('there is no light that casts them; add [[lights]] with kind = "directional", or "point"', "shadows")
        if self.shadows is not None and self.shading is None and self.scattering is None:
            raise problem("nothing shows them; add [shading] or [scattering]", "shadows")
        if self.occlusion is not None and not any(light.kind == "ambient" for light in self.lights):
            raise problem('it is that of ambient light; add [[lights]] with kind = "ambient"', "occlusion")
        if self.occlusion is not None and self.shading is None and self.scattering is None:
            raise problem("nothing shows it; add [shading] or [scattering]", "occlusion")
        if self.specular is not None and self.surfaces is None:
            raise problem("there is no surface to be specular; add [surfaces]", "specular")
        if self.environment and self.material is None:
            raise problem('nothing shows it; add [material], such as kind = "lambert"', "environment")
        if self.material is not None and not self.environment:
            raise problem(
                'it shows environment lighting; add [environment] with kind = "image", "constant" or "disc"', "material"
            )
        if self.radiance_transfer is not None and not self.environment:
            raise problem("it is that of environment lighting; add [environment] and [material]", "radiance_transfer")
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
