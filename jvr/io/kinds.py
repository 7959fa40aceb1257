"""Classes that files may name: in configurations by a kind, such as "henyey-greenstein", in saved scenes by their name.

Nothing else is ever imported or called for a file. A class of your own joins them by one line, `jvr.register("ring", cls)`.
"""

import importlib

from jvr.model.effects import (
    AbstractBleeding,
    AbstractRadianceTransfer,
    AbstractScattering,
    AbstractShading,
    AbstractShadows,
)
from jvr.model.light import AbstractEmitter
from jvr.model.material import AbstractBRDF
from jvr.model.normals import AbstractNormals
from jvr.model.phase import AbstractPhase
from jvr.model.transfer import AbstractTransfer
from jvr.names import NAMES

# Public classes that a scene is made of, by name: the module that is imported when a file names one, or a class that was registered.
PARTS: dict[str, str | type] = {
    name: module
    for module, names in NAMES.items()
    if module.startswith(("jvr.model.", "jvr.effects."))
    for name in names
    if name[0].isupper()
}
# What configurations call the classes of a family whose tables are the arguments of their constructors. Kinds whose tables say something
# else, such as a file, are in `jvr.io.config.schema`.
KINDS: dict[type, dict[str, str]] = {
    AbstractEmitter: {
        "directional": "DirectionalLight",
        "point": "PointLight",
        "spot": "SpotLight",
        "head": "HeadLight",
        "ambient": "AmbientLight",
    },
    AbstractShading: {"lambert": "Lambert", "phong": "Phong", "blinn-phong": "BlinnPhong"},
    AbstractShadows: {
        "rays": "ShadowRays",
        "volume": "ShadowVolume",
        "map": "ShadowMap",
        "opacity-map": "OpacityShadowMap",
        "deep-map": "DeepShadowMap",
    },
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
    AbstractTransfer: {
        "linear": "LinearTransfer",
        "lut": "LutTransfer",
        "gaussian": "GaussianTransfer",
        "gradient": "GradientTransfer",
    },
    AbstractBleeding: {"transfer": "TransferBleeding", "material": "MaterialBleeding"},
    AbstractBRDF: {
        "lambert": "LambertBRDF",
        "phong": "PhongBRDF",
        "blinn-phong": "BlinnPhongBRDF",
        "microfacet": "MicrofacetBRDF",
        "phase": "PhaseBRDF",
    },
}


def register(kind: str, cls: type) -> None:
    """Makes a class of your own known to files, in one line: `jvr.register("ring", cls)`.

    The class is a light, phase function, transfer function, shading, shadow algorithm, scattering, gradient estimator or BRDF, whose
    constructor's arguments are parameters declared beside its fields (`jvr.model.parameters`). It can then be named in a configuration,
    `kind = "ring"`, with a key for each of them, and `jvr.save_scene` and `jvr.load_scene` write and read it by the name of its class.
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
