"""Classes that files may name: in configurations by a kind, such as "henyey-greenstein", in saved scenes by their name.

Nothing else is ever imported or called for a file. A class of your own joins them by one line, `jvr.register("ring", cls)`.
"""

import importlib
from collections.abc import Callable
from typing import Any

from jvr.integrators.slices.oracle import AbstractOracle
from jvr.march.differentiation import AbstractAdjoint
from jvr.march.quadrature import AbstractQuadrature
from jvr.model.camera import AbstractCamera
from jvr.model.clipping import AbstractClipping
from jvr.model.effects import (
    AbstractBleeding,
    AbstractOcclusion,
    AbstractRadianceTransfer,
    AbstractScattering,
    AbstractShading,
    AbstractShadows,
    AbstractSpecular,
    AbstractSurfaces,
)
from jvr.model.environment import EnvironmentLight
from jvr.model.environment_map import EnvironmentMap
from jvr.model.geometry import AbstractGeometry
from jvr.model.interpolation import AbstractInterpolation
from jvr.model.light import AbstractLight
from jvr.model.material import AbstractBRDF
from jvr.model.normals import AbstractNormals
from jvr.model.optical import AbstractOpticalModel
from jvr.model.parameters import AbstractByScalar
from jvr.model.phase import AbstractPhase
from jvr.model.transfer import AbstractTransfer
from jvr.names import NAMES
from jvr.rendering.integrator import AbstractIntegrator
from jvr.rendering.pixel_filters import AbstractPixelFilter

HOMES = {name: module for module, names in NAMES.items() for name in names}
# Public classes that a scene is made of, by name: the module that is imported when a file names one, or a class that was registered.
PARTS: dict[str, str | type] = {
    name: module for name, module in HOMES.items() if module.startswith(("jvr.model.", "jvr.effects.")) and name[0].isupper()
}
# What configurations call the classes of a family, or functions that make one, whose tables are the arguments of their constructors. Kinds
# whose tables say something else, such as a file, are in `jvr.io.config.schema`.
KINDS: dict[type, dict[str, str]] = {
    AbstractLight: {
        "directional": "DirectionalLight",
        "point": "PointLight",
        "spot": "SpotLight",
        "head": "HeadLight",
        "ambient": "AmbientLight",
    },
    AbstractShading: {
        "lambert": "Lambert",
        "phong": "Phong",
        "blinn-phong": "BlinnPhong",
        "phenomenological": "PhenomenologicalBSDF",
        "anisotropic": "AnisotropicGGX",
    },
    AbstractByScalar: {"value": "ByValue", "gradient": "ByGradient"},
    AbstractShadows: {
        "rays": "ShadowRays",
        "volume": "ShadowVolume",
        "map": "ShadowMap",
        "opacity-map": "OpacityShadowMap",
        "deep-map": "DeepShadowMap",
        "piecewise": "PiecewiseShadows",
        "in-scattering": "InScattering",
    },
    AbstractSurfaces: {"isosurfaces": "Isosurfaces"},
    AbstractSpecular: {"specular": "Specular"},
    AbstractScattering: {"single": "SingleScattering"},
    AbstractPhase: {
        "isotropic": "Isotropic",
        "rayleigh": "Rayleigh",
        "henyey-greenstein": "HenyeyGreenstein",
        "double-henyey-greenstein": "DoubleHenyeyGreenstein",
        "schlick": "Schlick",
        "draine": "Draine",
        "jendersie-eon": "JendersieEon",
        "mixture": "Mixture",
    },
    AbstractNormals: {
        "analytic": "AnalyticGradient",
        "forward": "ForwardDifferences",
        "central": "CentralDifferences",
        "sobel": "SobelDifferences",
        "precomputed": "PrecomputedGradient",
    },
    AbstractRadianceTransfer: {"projected": "RadianceTransfer"},
    AbstractOcclusion: {"local": "LocalOcclusion", "histogram": "HistogramOcclusion", "surface": "SurfaceOcclusion"},
    AbstractTransfer: {
        "linear": "LinearTransfer",
        "lut": "LutTransfer",
        "gaussian": "GaussianTransfer",
        "gradient": "GradientTransfer",
        "clear": "ClearTransfer",
    },
    AbstractBleeding: {"transfer": "TransferBleeding", "material": "MaterialBleeding"},
    AbstractBRDF: {
        "lambert": "LambertBRDF",
        "phong": "PhongBRDF",
        "blinn-phong": "BlinnPhongBRDF",
        "microfacet": "MicrofacetBRDF",
        "phase": "PhaseBRDF",
    },
    EnvironmentLight: {
        "image": "EnvironmentLight.from_image",
        "constant": "EnvironmentLight.constant",
        "disc": "EnvironmentLight.disc",
    },
    EnvironmentMap: {"image": "EnvironmentMap.from_image", "gradient": "EnvironmentMap.gradient"},
    AbstractGeometry: {"image": "DepthImage.from_image"},
    AbstractOpticalModel: {
        "emission-absorption": "EmissionAbsorption",
        "emission-only": "EmissionOnly",
        "absorption-only": "AbsorptionOnly",
    },
    AbstractClipping: {"box": "ClippingBox", "plane": "ClippingPlane"},
    AbstractInterpolation: {"trilinear": "Trilinear", "tricubic": "Tricubic", "nearest": "Nearest"},
    AbstractCamera: {
        "perspective": "PerspectiveCamera",
        "orthographic": "OrthographicCamera",
        "pinhole": "PinholeCamera",
        "fibonacci": "fibonacci_sphere",
        "orbit": "orbit",
    },
    AbstractQuadrature: {"midpoint": "Midpoint", "pre-integrated": "PreIntegrated"},
    AbstractAdjoint: {"replay": "Replay", "forward": "Forward", "rows": "Rows"},
    AbstractIntegrator: {"uniform": "Uniform", "slices": "Slices", "refinement": "Refinement"},
    AbstractPixelFilter: {"box": "BoxFilter", "tent": "TentFilter", "gaussian": "GaussianFilter", "mitchell": "MitchellFilter"},
    AbstractOracle: {
        "local-error": "LocalError",
        "opacity-change": "OpacityChange",
        "brick-range": "BrickRange",
        "finest": "Finest",
        "pixel-size": "PixelSize",
        "given": "GivenDistances",
    },
}


def register(kind: str, cls: type) -> None:
    """Makes a class of your own known to files, in one line: `jvr.register("ring", cls)`.

    The class is a light, phase function, transfer function, shading, shadow algorithm, scattering, gradient estimator, BRDF, camera,
    integrator or another whose kinds configurations name, whose constructor's arguments are parameters declared beside its fields
    (`jvr.model.parameters`). It can then be named in a configuration, `kind = "ring"`, with a key for each of them, and
    `jvr.save_scene` and `jvr.load_scene` write and read it by the name of its class.
    Registering a class of the same name and kind again, as a notebook does, replaces it.

    **Raises** `TypeError` for a class of no such family, `ValueError` for a kind or name that another class has.
    """
    family = next((base for base in KINDS if issubclass(cls, base)), None)
    if family is None:
        raise TypeError(f"{cls.__name__} is none of {', '.join(base.__name__ for base in KINDS)}, which files can name")
    name, names = cls.__name__, KINDS[family]
    if names.get(kind, name) != name or isinstance(PARTS.get(name), str):
        raise ValueError(f"the kind {kind!r} or the name {name} is that of another class: choose another")
    names[kind], PARTS[name] = name, cls


def class_named(name: str) -> type:
    """A class of `PARTS`."""
    found = PARTS[name]
    return found if isinstance(found, type) else getattr(importlib.import_module(found), name)


def maker_of(family: type, kind: str) -> Callable[..., Any]:
    """What makes a part of a kind: its class, or a function, such as `jvr.EnvironmentLight.disc`."""
    name, *method = KINDS[family][kind].split(".")
    found = PARTS.get(name, HOMES.get(name))
    found = found if isinstance(found, type) else getattr(importlib.import_module(str(found)), name)
    return getattr(found, *method) if method else found


def kind_of(part: Any) -> str | None:
    """What configurations call the class of an object, or `None` where they have no name for it."""
    for family, kinds in KINDS.items():
        for kind, name in kinds.items() if isinstance(part, family) else ():
            if name == type(part).__name__ and maker_of(family, kind) is type(part):
                return kind
    return None
