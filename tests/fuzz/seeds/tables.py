"""Reflectance, configurations, transfer functions, scenes and the checkpoints of fits."""

import hashlib
import json
import re
import struct
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from seeds.seed import SHAPE, Seed, voxels

TRANSFERS = {
    "linear": 'kind = "linear"\npositions = [0, 1, 2]\nrgb = [[0, 0, 0], [1, 1, 1], [1, 0.5, 0]]\nsigma_t = [0, 1, 2]\n',
    "lut": 'kind = "lut"\ndomain = [0, 1]\nrgb = [[0, 0, 0], [1, 1, 1]]\nsigma_t = [0, 1]\ngradient_opacity = { low = 1, high = 2 }\n',
    "gaussian": 'kind = "gaussian"\ncenter = [0.5, 1]\nwidth = [0.1, 0.2]\nheight = [1, 2]\nrgb = [[1, 0, 0], [0, 1, 0]]\n',
    "window": 'kind = "window"\nwindow = 400\nlevel = 40\nsigma_t = 0.5\nrgb = [1, 1, 0.9]\n',
    "preset": 'kind = "preset"\npreset = "ct_bone"\n',
    "sampled": 'kind = "sampled"\nentries = 32\ndomain = [0, 1]\npositions = [0, 1]\nrgb = [[0, 0, 0], [1, 1, 1]]\n'
    'extinction = [\n{ kind = "ramp", between = [0.2, 0.4], height = 1 },\n'
    '{ kind = "gaussian", center = 0.5, width = 0.1, height = 2 },\n]\n',
    "slicer": 'kind = "slicer"\nname = "MR-T2-Brain"\nencoding = "srgb"\n',
    "gradient": 'kind = "gradient"\ndomain = [0, 1]\nmagnitudes = [1, 2]\nrgb = [[[0, 0, 0], [1, 1, 1]], [[0, 0, 0], [1, 0, 0]]]\n'
    "sigma_t = [[0, 0], [1, 2]]\n",
}
SCENE = (
    f'background = [0, 0, 0]\n[volume]\npath = "a.raw"\nshape = {list(SHAPE)}\ndtype = "<i2"\nspacing = [0.5, 1.25, 3]\nmissing = 0\n'
    '[transfer]\nkind = "preset"\npreset = "ct_bone"\n[camera]\neye = [1, 2, 3]\nfov_y = 30\nwidth = 8\nheight = 8\n'
    "[settings]\nstep = 0.5\n"
)


def tables(folder: Path) -> dict[str, Seed]:
    from jvr.io.config import ConfigError, read_config, read_transfer

    configs = Path(__file__).parents[3] / "configs"
    seeds = {
        f"config, {path.stem}": Seed({"a.toml": path.read_bytes()}, "a.toml", read_config, (ConfigError,))
        for path in sorted(configs.glob("*.toml"))
    }
    files = {"a.toml": SCENE.encode(), "a.raw": voxels().tobytes(order="F")}
    seeds["config, scene"] = _scene(files)
    for kind, text in TRANSFERS.items():
        seeds[f"transfer, {kind}"] = Seed({"a.toml": text.encode()}, "a.toml", read_transfer, (ConfigError,))
    seeds |= _cameras() | _presets(folder)
    seeds["merl"] = _merl()
    seeds["checkpoint"] = _checkpoint(folder)
    return seeds | _scenes(folder)


def _scene(files: dict[str, bytes]) -> Seed:
    """A configuration with its volume, up to the scene and the cameras."""
    from jvr.io.config import ConfigError, read_config
    from jvr.io.config.build import build_cameras, build_scene, build_settings
    from jvr.io.volumes import VolumeError

    def read(path: Path) -> Any:
        config = read_config(path)
        scene = build_scene(config)
        return build_cameras(config, scene.volume, scene.transfer), build_settings(config)

    return Seed(files, "a.toml", read, (ConfigError, VolumeError))


def _cameras() -> dict[str, Seed]:
    """Cameras of other programs."""
    from jvr.io import interop

    places = {"Position": (9, 8, 7), "FocalPoint": (0, 0, 0), "ViewUp": (0, 0, 1), "ViewAngle": (30,), "ParallelProjection": (0,)}
    elements = lambda values: "".join(f'<Element index="{i}" value="{v}"/>' for i, v in enumerate(values))
    properties = (f'<Property name="Camera{name}">{elements(values)}</Property>' for name, values in places.items())
    paraview = f'<?xml version="1.0"?><PVCameraConfiguration><Proxy>{"".join(properties)}</Proxy></PVCameraConfiguration>'
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    transforms = json.dumps({"w": 8, "h": 6, "fl_x": 9.5, "cx": 4.5, "frames": [frame, frame | {"camera_angle_y": 0.5}]})
    read = lambda path: interop.from_paraview(path, 8, 6)
    return {
        "camera, pvcc": Seed({"a.pvcc": paraview.encode()}, "a.pvcc", read, (interop.CameraError,)),
        "cameras, json": Seed({"a.json": transforms.encode()}, "a.json", interop.read_transforms, (interop.CameraError,)),
    }


def _presets(folder: Path) -> dict[str, Seed]:
    """Presets of other programs."""
    from jvr.io import interop

    given = interop.slicer_preset("CT-Fat")
    interop.write_slicer(folder / "a.vp", given)
    interop.write_slicer(folder / "a.vp.json", given)
    bent = {"RGBPoints": [0, 0.1, 0.2, 1, 5, 1, 0, 0, 9, 0, 1, 0], "Points": [0, 0, 0.5, 0, 5, 0.7, 0.3, 0.4, 9, 1, 0.5, 1]}
    maps = [{"Name": space, "ColorSpace": space, **bent} for space in ("Diverging", "HSV")]
    maps[0] |= {"UseLogScale": 0, "UseBelowRangeColor": 1, "BelowRangeColor": [1, 1, 1]}
    contents = {name: (folder / name).read_bytes() for name in ("a.vp", "a.vp.json")}
    read = lambda path: interop.read_paraview(path, "Diverging", range=(-1, 7))
    return {
        "preset, vp": Seed({"a.vp": contents["a.vp"]}, "a.vp", interop.read_slicer, (interop.PresetError,)),
        "preset, vp.json": Seed({"a.vp.json": contents["a.vp.json"]}, "a.vp.json", interop.read_slicer, (interop.PresetError,)),
        "preset, paraview": Seed({"a.json": json.dumps(maps).encode()}, "a.json", read, (interop.PresetError,)),
    }


def _merl() -> Seed:
    from jvr.io import merl

    # A whole table has 35 MB: damage does not need so many cells.
    few = (3, 2, 4)

    def read(path: Path) -> Any:
        with mock.patch.object(merl, "CELLS", few):
            return merl.read_merl(path)

    content = struct.pack("<3i", *few) + np.linspace(0, 900, 72).astype("<f8").tobytes()
    return Seed({"a.binary": content}, "a.binary", read, (merl.MerlError,))


def _checkpoint(folder: Path) -> Seed:
    from jvr.fitting import checkpoint

    state, fingerprint = {"x": np.arange(6.0), "k": np.array(3)}, {"camera": "abc"}
    checkpoint.save(folder / "a.npz", state, [{"loss": 1.0}], fingerprint)
    read = lambda path: checkpoint.load(path, state, fingerprint)
    return Seed({"a.npz": (folder / "a.npz").read_bytes()}, "a.npz", read, (checkpoint.CheckpointError,))


def _scenes(folder: Path) -> dict[str, Seed]:
    """A scene: as it was written, and with archives whose checksum is right, as who means harm would write them."""
    import jvr
    from jvr.io.config import ConfigError
    from jvr.io.scenes.kinds import PARTS, class_named
    from jvr.io.volumes import VolumeError

    # The list of all kinds in an error imports their modules, which takes memory once.
    for kind in PARTS:
        class_named(kind)
    values = voxels("<f4")
    values[0, 0, 0] = np.nan
    scene = jvr.Scene(
        jvr.Volume(values),
        jvr.GradientOpacity(jvr.GaussianTransfer([0.5, 1], [0.1, 0.2], [1, 2], [[1, 0, 0], [0, 1, 0]]), 0.1, 0.2),
        background=(0, 0, 0),
        clipping=jvr.ClippingBox((0, 0, 0), (2, 2, 2)),
        lights=[jvr.SpotLight((1.1, 2, 3), (0, 0, 1)), jvr.AmbientLight()],
        shading=jvr.Phong(diffuse=jvr.ByValue([0, 1], [0.2, 0.4])),
        shadows=jvr.ShadowMap(),
        scattering=jvr.SingleScattering(jvr.Mixture([jvr.Rayleigh(), jvr.Draine(0.1, 1)], [1, 2])),
        environment=jvr.EnvironmentLight.constant(),
        material=jvr.HarmonicMaterial.project(jvr.LambertBRDF(), 1, directions=2, nodes=4),
        radiance_transfer=jvr.RadianceTransfer(scattering=jvr.Dipole.preset("skin1")),
    )
    jvr.save_scene(scene, folder / "scene.toml")
    text, archive = ((folder / f"scene.{ending}").read_bytes() for ending in ("toml", "npz"))

    def read_mended(path: Path) -> Any:
        if path.with_suffix(".npz").is_file():
            found = hashlib.sha256(path.with_suffix(".npz").read_bytes()).hexdigest()
            path.write_bytes(re.sub(rb'checksum = "\w*"', f'checksum = "{found}"'.encode(), path.read_bytes()))
        return jvr.load_scene(path)

    errors = (ConfigError, VolumeError)
    return {
        "scene": Seed({"a.toml": text, "a.npz": archive}, "a.toml", jvr.load_scene, errors),
        "scene, arrays": Seed({"a.npz": archive, "a.toml": text}, "a.toml", read_mended, errors),
    }
