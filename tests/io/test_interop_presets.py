"""Presets of other programs: what VTK's own functions say of opacity and colour, and what comes back from a round trip."""

import json
import warnings

import jax
import numpy as np
import pytest

import jvr
from jvr.io import interop
from jvr.io.config import ConfigError, build_scene, config_from, read_transfer
from jvr.io.interop.curves import Curve
from jvr.io.interop.points import ERROR, width
from jvr.io.interop.slicer import slicer_property

SPACES = {"RGB": 0, "HSV": 1, "Lab": 2, "Diverging": 3, "Step": 5, "ProLab": 6}


def nodes(rng, channels):
    """Rows `x, values, midpoint, sharpness`; greys, pure colours, jumps and plain points among them."""
    n = int(rng.integers(1, 7))
    values = rng.random((n, channels))
    values = np.round(values) if rng.random() < 0.3 else values
    values[rng.random(n) < 0.2] = rng.random()
    midpoint = np.where(rng.random(n) < 0.4, rng.random(n), 0.5)
    sharpness = np.where(rng.random(n) < 0.5, rng.random(n), 0.0)
    sharpness[rng.random(n) < 0.15] = 1.0
    return np.column_stack([np.sort(rng.uniform(1, 10, n)), values, midpoint, sharpness])


def of_vtk(rows, **changes):
    """VTK's function of these nodes."""
    vtk = pytest.importorskip("vtk")
    is_colour = rows.shape[1] == 6
    function = vtk.vtkColorTransferFunction() if is_colour else vtk.vtkPiecewiseFunction()
    for name, value in changes.items():
        getattr(function, f"Set{name}")(*value if isinstance(value, tuple) else (value,))
    for row in rows:
        (function.AddRGBPoint if is_colour else function.AddPoint)(*row)
    return function


@pytest.mark.parametrize("logarithmic", [False, True])
@pytest.mark.parametrize("space", SPACES)
def test_colours_between_points_are_those_of_vtk(space, logarithmic):
    rng = np.random.default_rng(SPACES[space])
    for wrap in (True, False) if space == "HSV" else (True,):
        for _ in range(25):
            rows, x = nodes(rng, 3), rng.uniform(0.5, 11, 60)
            theirs = of_vtk(rows, ColorSpace=SPACES[space], HSVWrap=wrap, Scale=int(logarithmic))
            ours = Curve.of(rows, space=space, wrap=wrap, logarithmic=logarithmic)(x)
            np.testing.assert_allclose(ours, [theirs.GetColor(s) for s in x], atol=1e-6)


@pytest.mark.parametrize("logarithmic", [False, True])
def test_opacities_between_points_are_those_of_vtk(logarithmic):
    rng = np.random.default_rng(11)
    for _ in range(40):
        rows, x = nodes(rng, 1), rng.uniform(0.5, 11, 60)
        theirs = of_vtk(rows, UseLogScale=logarithmic)
        np.testing.assert_allclose(Curve.of(rows, logarithmic=logarithmic)(x)[:, 0], [theirs.GetValue(s) for s in x], atol=1e-6)


def test_opacity_per_unit_distance():
    alpha, unit, distance = np.array([0.0, 0.001, 0.3, 0.9, 0.999]), 2.5, 0.7
    sigma = interop.extinction_from_opacity(alpha, unit)
    # VTK's correction for the distance of samples.
    np.testing.assert_allclose(1 - np.exp(-sigma * distance), 1 - (1 - alpha) ** (distance / unit), rtol=1e-12)
    np.testing.assert_allclose(interop.opacity_from_extinction(sigma, unit), alpha, rtol=1e-12)
    np.testing.assert_allclose(interop.extinction_from_opacity([1.0, 1 - 2.0**-16], 2.0), np.log(65536) / 2)
    for wrong in (lambda: interop.extinction_from_opacity(1.1), lambda: interop.extinction_from_opacity(np.nan)):
        with pytest.raises(ValueError, match="opacity must be between 0 and 1"):
            wrong()
    with pytest.raises(ValueError, match="unit_distance must be positive"):
        interop.extinction_from_opacity(0.5, 0.0)
    with pytest.raises(ValueError, match="must not be negative"):
        interop.opacity_from_extinction(-1.0)


def property_of_vtk(opacity, colour, unit=1.0, **changes):
    vtk = pytest.importorskip("vtk")
    made = vtk.vtkVolumeProperty()
    made.SetInterpolationTypeToLinear()
    made.SetScalarOpacity(opacity)
    made.SetColor(colour)
    made.SetScalarOpacityUnitDistance(unit)
    for name, value in changes.items():
        getattr(made, f"Set{name}")(value)
    return made


def evaluated(transfer, x):
    """Colours and extinctions of a table: straight lines between its entries."""
    at, rgb, sigma = (np.asarray(getattr(transfer, name), np.float64) for name in ("positions", "rgb", "sigma_t"))
    return np.stack([np.interp(x, at, column) for column in rgb.T], -1), np.interp(x, at, sigma)


def from_quietly(read, *arguments, **keywords):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return read(*arguments, **keywords)


@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_imported_functions_meet_those_of_vtk(encoding):
    rng = np.random.default_rng(5)
    for trial in range(12):
        space = list(SPACES)[trial % len(SPACES)]
        opacity_rows, colour_rows, unit = nodes(rng, 1), nodes(rng, 3), float(rng.uniform(0.3, 4))
        outside = (
            {"UseBelowRangeColor": True, "BelowRangeColor": (0.1, 0.8, 0.2), "UseAboveRangeColor": True} if trial % 3 == 0 else {}
        )
        opacity = of_vtk(opacity_rows, Clamping=trial % 4 != 0)
        colour = of_vtk(colour_rows, ColorSpace=SPACES[space], **outside)
        preset = from_quietly(interop.from_vtk_property, property_of_vtk(opacity, colour, unit), encoding=encoding)
        x = rng.uniform(0, 11, 400)
        # Beside a jump there is a ramp.
        curves = Curve.of(opacity_rows), Curve.of(colour_rows)
        ramps = np.concatenate([curve.points(0.0) for curve in curves])
        x = x[np.abs(x[:, None] - ramps).min(axis=1) > 2 * width(ramps)]
        rgb, sigma = evaluated(preset.transfer, x)
        theirs = np.minimum([opacity.GetValue(s) for s in np.float32(x)], 1 - 2.0**-16)
        for share in (1.0, 0.5, 0.1):
            ours = 1 - np.exp(-sigma * unit * share)
            np.testing.assert_allclose(ours, 1 - (1 - theirs) ** share, atol=ERROR + 1e-5)
        shown = jvr.srgb_from_linear(rgb) if encoding == "srgb" else rgb
        np.testing.assert_allclose(shown, [colour.GetColor(s) for s in np.float32(x)], atol=ERROR + 1e-5)


def linear_transfer(rng, n=7, deepest=9.0):
    sigma = rng.uniform(0, deepest, n) * (rng.random(n) < 0.7)
    return jvr.LinearTransfer(np.sort(rng.uniform(-900, 2000, n)), rng.random((n, 3)), sigma)


@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_what_jvr_holds_comes_back_from_vtk_exactly(encoding):
    vtk = pytest.importorskip("vtk")
    rng = np.random.default_rng(8)
    for transfer in (
        linear_transfer(rng),
        linear_transfer(rng, 2),
        jvr.LutTransfer(rng.random((9, 3)), rng.uniform(0, 9, 9), (-5, 5)),
    ):
        given = interop.Preset(transfer, jvr.Phong(0.2, 0.6, 0.4, 17.0), unit_distance=0.8, encoding=encoding)
        made = vtk.vtkVolumeProperty()
        assert interop.to_vtk_property(given, made) == {}
        found = interop.from_vtk_property(made, encoding=encoding)
        assert found.lost == {}
        low, high = (float(end) for end in transfer.ends)
        x = np.linspace(low - 1, high + 1, 999)
        for ours, again in zip(evaluated(transfer, x), evaluated(found.transfer, x), strict=True):
            # Opacities near 1 keep few digits of the extinction in single precision.
            np.testing.assert_allclose(again, ours, rtol=1e-4, atol=3e-6)
        rgb, sigma = evaluated(transfer, x)
        theirs = np.array([made.GetScalarOpacity().GetValue(s) for s in x])
        np.testing.assert_allclose(theirs, 1 - np.exp(-0.8 * sigma), atol=ERROR + 1e-5)
        shown = jvr.srgb_from_linear(rgb) if encoding == "srgb" else rgb
        colours = np.array([made.GetRGBTransferFunction().GetColor(s) for s in x])
        np.testing.assert_allclose(colours, shown, atol=ERROR + 1e-5)
        assert jax.tree.all(jax.tree.map(lambda a, b: np.isclose(a, b, rtol=1e-6), found.shading, given.shading))
        assert found.unit_distance == 0.8
        assert isinstance(found.interpolation, jvr.Trilinear)


@pytest.mark.parametrize("ending", ["vp", "vp.json", "json"])
@pytest.mark.parametrize("name", ["CT-Bone", "CT-Soft-Tissue", "CT-Fat", "MR-T2-Brain"])
def test_presets_come_back_point_by_point(name, ending, tmp_path):
    given = from_quietly(interop.slicer_preset, name)
    path = tmp_path / f"a.{ending}"
    write, read = (
        (interop.write_paraview, interop.read_paraview) if ending == "json" else (interop.write_slicer, interop.read_slicer)
    )
    lost = from_quietly(write, path, given)
    assert set(lost) == ({"shading"} if ending == "json" and given.shading is not None else set())
    found = from_quietly(read, path)
    x = np.linspace(-3100, 3100, 5000)
    (rgb, sigma), (again, also) = evaluated(given.transfer, x), evaluated(found.transfer, x)
    # What is above 1 - 2^-16 counts as 1.
    np.testing.assert_allclose(np.exp(-also), np.exp(-sigma), atol=2.0**-16)
    np.testing.assert_allclose(again, rgb, atol=2e-6)
    if "opacity of 1" not in given.lost:
        np.testing.assert_allclose(found.transfer.positions, given.transfer.positions)
    if ending == "vp":
        numbers = np.array([float(word) for word in path.read_text().splitlines()[6].split()[1:]])
        x, alpha = slicer_property(name).opacity.rows()[:, :2].T
        np.testing.assert_allclose(np.interp(x, *numbers.reshape(-1, 2).T), alpha, atol=1e-5)
        assert len(numbers) // 2 <= len(x) + 1
    if ending != "json":
        assert (found.shading is None) == (given.shading is None)


def test_presets_of_slicer_by_name_and_number():
    names = interop.slicer_presets()
    assert len(names) == len(set(names)) == 31
    assert names[2] == "CT-Bone"
    for number, name in enumerate(names, 1):
        said, preset = slicer_property(number), from_quietly(interop.slicer_preset, name)
        curve = said.opacity
        # Where points coincide is a jump.
        alone = [
            i
            for i, x in enumerate(curve.x)
            if np.sum(curve.x == x) == 1 and x not in said.colour.x[:-1][np.diff(said.colour.x) == 0]
        ]
        _, sigma = evaluated(getattr(preset.transfer, "transfer", preset.transfer), curve.x[alone])
        np.testing.assert_allclose(1 - np.exp(-sigma), np.minimum(curve.values[alone, 0], 1 - 2.0**-16), atol=2e-5, err_msg=name)
        assert (preset.shading is not None) == said.shade
        assert len(preset.lights) == 2 * said.shade
    assert from_quietly(interop.slicer_preset, "uCT-Skull").lost["opacity by gradient"].startswith("5 points are not one ramp")
    for wrong in ("CT-Bon", 0, 32):
        with pytest.raises(ValueError, match="no preset of 3D Slicer is called"):
            interop.slicer_preset(wrong)


def test_opacity_by_gradient():
    vtk = pytest.importorskip("vtk")
    opacity, colour = of_vtk(np.array([[0, 0, 0.5, 0], [9, 0.5, 0.5, 0]])), of_vtk(np.array([[0, 1, 1, 1, 0.5, 0]]))
    made = property_of_vtk(opacity, colour)
    for points, ramp in [
        ([(0, 1), (90, 1)], None),
        ([(-10, 0), (-1, 1), (20, 1)], None),
        ([(0, 0), (10, 0), (30, 1), (90, 1)], (10, 30)),
        ([(10, 0), (20, 0.5), (30, 1)], (10, 30)),
    ]:
        function = vtk.vtkPiecewiseFunction()
        for point in points:
            function.AddPoint(*point)
        made.SetGradientOpacity(function)
        preset = interop.from_vtk_property(made, spacing=2.0)
        assert preset.lost == {}
        assert isinstance(preset.transfer, jvr.GradientOpacity) == (ramp is not None)
        if ramp is not None:
            # VTK's gradients are by the mean distance of voxels.
            np.testing.assert_allclose([preset.transfer.low, preset.transfer.high], np.array(ramp) / 2)
            again = vtk.vtkVolumeProperty()
            interop.to_vtk_property(preset, again)
            np.testing.assert_allclose([again.GetGradientOpacity().GetValue(m) for m in (5, 10, 20, 30, 40)], [0, 0, 0.5, 1, 1])
    made.SetDisableGradientOpacity(True)
    assert isinstance(interop.from_vtk_property(made).transfer, jvr.LinearTransfer)
    made.SetDisableGradientOpacity(False)
    function.AddPoint(0, 0.5)
    with pytest.warns(UserWarning, match="not kept: opacity by gradient"):
        assert isinstance(interop.from_vtk_property(made).transfer, jvr.LinearTransfer)


def test_grey_functions_of_vtk_are_colours():
    grey, opacity = of_vtk(np.array([[0, 0.2, 0.5, 0], [9, 0.6, 0.5, 0]])), of_vtk(np.array([[0, 0.5, 0.5, 0]]))
    preset = interop.from_vtk_property(property_of_vtk(opacity, grey))
    assert preset.lost == {}
    np.testing.assert_allclose(evaluated(preset.transfer, [-1, 4.5, 9])[0], [[0.2] * 3, [0.4] * 3, [0.6] * 3], atol=1e-6)


def test_what_vtk_says_and_jvr_does_not_hold_is_named():
    opacity = of_vtk(np.array([[0, 0, 0.3, 0], [9, 1, 0.5, 0]]))
    colour = of_vtk(np.array([[0, 1, 0, 0, 0.5, 0], [9, 0, 0, 1, 0.5, 0]]), ColorSpace=4)
    made = property_of_vtk(opacity, colour, Shade=1, SpecularPower=0.5, IndependentComponents=0, ScatteringAnisotropy=0.5)
    with pytest.warns(UserWarning, match="vtkVolumeProperty: not kept: ") as caught:
        preset = interop.from_vtk_property(made)
    expected = {
        "colours through Lab/CIEDE2000",
        "dependent components",
        "scattering",
        "opacity of 1",
        "way between points of opacity",
    }
    expected |= {"way between points of colours", "specular power below 1"}
    assert set(preset.lost) == expected
    assert len(caught) == 1
    assert "\n" not in str(caught[0].message)
    assert all(name in str(caught[0].message) for name in expected)
    made.SetTransferFunctionModeTo2D()
    with pytest.raises(ValueError, match="of two dimensions: set its mode to 1D"):
        interop.from_vtk_property(made)
    with pytest.raises(TypeError, match="takes a vtkVolumeProperty, not dict"):
        interop.from_vtk_property({})


def test_what_jvr_says_and_others_do_not_hold_is_named(tmp_path):
    coloured = jvr.LinearTransfer([0, 1], [[0, 0, 0], [2.0, 1, 1]], [[0, 0, 0], [10, 20, 30]])
    shading = jvr.BlinnPhong(diffuse=jvr.ByValue([0, 1], [0.2, 0.4]), threshold=1.0, two_sided=False)
    gradient = interop.Preset(jvr.GradientOpacity(coloured, 1, 2), shading, jvr.Nearest(), 2.0)
    both = {"coloured extinction", "extinction", "colours", "half-way highlights", "diffuse by value"}
    both |= {"threshold of surfaces", "one-sided surfaces"}
    with pytest.warns(UserWarning, match="not kept: coloured extinction"):
        assert set(interop.write_slicer(tmp_path / "a.vp.json", gradient)) == both
    said = json.loads((tmp_path / "a.vp.json").read_text())["volumeProperties"][0]
    assert said["interpolationType"] == "nearest"
    assert said["components"][0]["lighting"]["diffuse"] == pytest.approx(0.3)
    found = from_quietly(interop.read_slicer, tmp_path / "a.vp.json")
    assert isinstance(found.interpolation, jvr.Nearest)
    np.testing.assert_allclose([found.transfer.low, found.transfer.high], [1, 2], rtol=1e-6)
    assert set(from_quietly(interop.write_slicer, tmp_path / "a.vp", gradient)) == {*both, "unit distance"}
    theirs = {*both, "unit distance", "opacity by gradient", "shading", "nearest interpolation"}
    assert set(from_quietly(interop.write_paraview, tmp_path / "a.json", gradient)) == theirs
    two = jvr.GradientTransfer(np.ones((2, 2, 3)), np.ones((2, 2)), (0, 1), (0, 1))
    with pytest.raises(ValueError, match="GradientTransfer has no form in other programs"):
        interop.write_paraview(tmp_path / "b.json", interop.Preset(two))
    rng = np.random.default_rng(0)
    with pytest.raises(interop.PresetError, match=r"too many points for a \.vp.* write \.vp\.json"):
        interop.write_slicer(tmp_path / "b.vp", interop.Preset(linear_transfer(rng, 90)))
    with pytest.raises(interop.PresetError, match=r"written as \.vp\.json or \.vp"):
        interop.write_slicer(tmp_path / "b.xml", interop.Preset(linear_transfer(rng)))


@pytest.mark.slow
def test_gaussians_are_sampled(tmp_path):
    transfer = jvr.GaussianTransfer([0.5, 1.5], [0.1, 0.3], [2.0, 5.0], [[1, 0, 0], [0, 1, 0]])
    interop.write_paraview(tmp_path / "a.json", interop.Preset(transfer))
    found = interop.read_paraview(tmp_path / "a.json").transfer
    x = np.linspace(-1, 4, 500)
    rgb, (sigma,), _ = jax.vmap(transfer.evaluate)(x)
    rgb, (again, also) = np.stack(rgb, -1), evaluated(found, x)
    np.testing.assert_allclose(1 - np.exp(-also), 1 - np.exp(-sigma), atol=2 * ERROR)
    np.testing.assert_allclose(again, rgb, atol=2 * ERROR)


MAP = {"Name": "warm", "ColorSpace": "RGB", "RGBPoints": [0, 0, 0, 0, 1, 1, 0.5, 0], "Points": [0, 0, 0.5, 0, 1, 0.5, 0.5, 0]}


def test_presets_of_paraview(tmp_path):
    path = tmp_path / "maps.json"
    path.write_text(json.dumps([MAP, {**MAP, "Name": "cool", "RGBPoints": [-1, 0, 0, 1, 3, 0, 1, 1], "ColorSpace": "CIELAB"}]))
    warm = interop.read_paraview(path, "warm", range=(-1000, 3000), unit_distance=2.0).transfer
    rgb, sigma = evaluated(warm, [-2000, -1000, 1000, 3000])
    np.testing.assert_allclose(rgb[:, 0], [0, 0, 0.5, 1], atol=1e-6)
    np.testing.assert_allclose(1 - np.exp(-2 * sigma), [0, 0, 0.25, 0.5], atol=1e-6)
    cool = from_quietly(interop.read_paraview, path, "cool")
    assert set(cool.lost) == {"way between points of colours"}
    with pytest.raises(interop.PresetError, match="it has 2 presets: name one of warm, cool"):
        interop.read_paraview(path)
    with pytest.raises(interop.PresetError, match="no preset 'worm'; did you mean 'warm'"):
        interop.read_paraview(path, "worm")
    path.write_text(json.dumps({key: value for key, value in MAP.items() if key != "Points"}))
    with pytest.warns(UserWarning, match="opacity .the file has none: 0 to 1 across the colours"):
        np.testing.assert_allclose(evaluated(interop.read_paraview(path).transfer, [0.5])[1], np.log(2), rtol=1e-5)
    points = {"RGBPoints": [1, 0, 0, 0, 100, 1, 1, 1], "Points": [1, 0, 0.5, 0, 100, 0, 0.5, 0]}
    path.write_text(json.dumps(MAP | points | {"UseLogScale": 1}))
    scaled = from_quietly(interop.read_paraview, path, range=(10, 1000)).transfer
    np.testing.assert_allclose(evaluated(scaled, [100])[0], 0.5, atol=ERROR)


VP = "1\n1\n0.9\n0.1\n0.2\n10\n4 0 0 100 0.5\n4 0 1 255 1\n8 0 0 0 0 100 1 0.5 0\n"


def written(made, tmp_path, text, ending):
    path = tmp_path / f"file{ending}"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return made(path)


def slicer_json(version="1.0.0", **changes):
    function = {"points": [{"x": 0, "y": 0.1, "midpoint": 0.5, "sharpness": 0}]}
    colours = {"points": [{"x": 0, "color": [0, 0.1, 1], "midpoint": 0.5, "sharpness": 0}]}
    part = {
        "scalarOpacity": function,
        "rgbTransferFunction": colours,
        "gradientOpacity": {"points": [{"x": 0, "y": 1}]},
    } | changes
    return json.dumps(
        {"@schema": f"https://a/volume-property-schema-v{version}.json#", "volumeProperties": [{"components": [part]}]}
    )


@pytest.mark.parametrize(
    ("read", "ending", "text", "said"),
    [
        (interop.read_slicer, ".vp", "", "line 1, interpolation, is missing; save it anew in the module Volume Rendering"),
        (interop.read_slicer, ".vp", VP.replace("4 0 0 100 0.5", ""), "line 7, opacity, is missing"),
        (interop.read_slicer, ".vp", VP.replace("4 0 0", "6 0 0"), "opacity announces 6 numbers and has 4"),
        (
            interop.read_slicer,
            ".vp",
            VP.replace("8 0 0 0 0 100 1 0.5 0", "6 0 0 0 0 100 1"),
            "colour has 6 numbers, which are not points of 4",
        ),
        (interop.read_slicer, ".vp", VP.replace("0.5", "1.5"), "opacity must be between 0 and 1"),
        (interop.read_slicer, ".vp", VP.replace("100", "nan"), "finite numbers"),
        (interop.read_slicer, ".vp", VP.replace("100", "1e300"), "too large for single precision"),
        (interop.read_slicer, ".vp", VP.replace("0.9", "-0.9"), "diffuse must not be negative|diffuse"),
        (interop.read_slicer, ".vp", b"\xff\xfe\x00", "it is not text"),
        (interop.read_slicer, ".vp.json", "{", r"not a \.vp\.json of 3D Slicer .*save it anew"),
        (interop.read_slicer, ".vp.json", "[1]", r"not a \.vp\.json of 3D Slicer"),
        (interop.read_slicer, ".vp.json", "{}", "it has no '@schema'"),
        (interop.read_slicer, ".vp.json", '{"@schema": "markups-v1.0.json"}', "its schema is 'markups"),
        (interop.read_slicer, ".vp.json", slicer_json("2.1.0"), "schema is version 2, known is 1: save it as .vp"),
        (interop.read_slicer, ".vp.json", slicer_json(scalarOpacityUnitDistance=0), "unit_distance must be positive"),
        (interop.read_slicer, ".vp.json", slicer_json(scalarOpacity={"points": []}), "y has 0 numbers"),
        (interop.read_slicer, ".vp.json", slicer_json(scalarOpacity=3), r"not a \.vp\.json"),
        (interop.read_paraview, ".json", "[]", "it has no presets; export it anew"),
        (interop.read_paraview, ".json", "3", "not a preset of ParaView"),
        (
            interop.read_paraview,
            ".json",
            json.dumps(MAP | {"ColorSpace": "CMYK"}),
            "its ColorSpace 'CMYK' is not one of RGB, HSV",
        ),
        (interop.read_paraview, ".json", json.dumps({"Name": "a", "IndexedColors": [1, 0, 0]}), "its colours are of categories"),
        (interop.read_paraview, ".json", json.dumps({"Name": "a"}), "it has no 'RGBPoints'"),
        (interop.read_paraview, ".json", json.dumps(MAP | {"Points": [0, 1, 2]}), "Points has 3 numbers"),
        (interop.read_paraview, ".json", json.dumps(MAP | {"Points": [0, 1, 2, 0]}), "midpoint and sharpness must be between"),
        (interop.read_paraview, ".json", json.dumps(MAP | {"RGBPoints": [0, 0, 0, 255]}), "colours must be between 0 and 1"),
        (interop.read_paraview, ".json", json.dumps(MAP | {"RGBPoints": [0, 0, 0, 1] * 5000}), "more than 4,096 points"),
        (lambda p: interop.read_paraview(p, range=(1, 1)), ".json", json.dumps(MAP), "range must be low < high"),
        (lambda p: interop.read_paraview(p, encoding="gamma"), ".json", json.dumps(MAP), "encoding must be one of"),
    ],
)
def test_what_is_no_preset_is_refused_in_one_line(read, ending, text, said, tmp_path):
    with pytest.raises(interop.PresetError, match=said) as caught:
        written(read, tmp_path, text, ending)
    assert str(caught.value).startswith(str(tmp_path / "file"))
    assert "\n" not in str(caught.value)


def test_a_folder_is_no_preset(tmp_path):
    with pytest.raises(interop.PresetError, match="is one; save it anew"):
        interop.read_slicer(tmp_path)
    with pytest.raises(FileNotFoundError):
        interop.read_slicer(tmp_path / "none.vp")


def drawn_by_vtk(voxels, made, size, distance):
    """A picture of VTK's mapper on the graphics card, without one by Mesa's rasteriser, and its camera."""
    vtk = pytest.importorskip("vtk")
    from vtkmodules.util import numpy_support

    vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_ERROR)
    data = vtk.vtkImageData()
    data.SetDimensions(*voxels.shape)
    data.GetPointData().SetScalars(numpy_support.numpy_to_vtk(voxels.ravel(order="F"), deep=True))
    mapper = vtk.vtkGPUVolumeRayCastMapper()
    mapper.SetInputData(data)
    mapper.SetAutoAdjustSampleDistances(False)
    mapper.SetSampleDistance(distance)
    mapper.UseJitteringOff()
    volume, renderer, window = vtk.vtkVolume(), vtk.vtkRenderer(), vtk.vtkRenderWindow()
    volume.SetMapper(mapper)
    volume.SetProperty(made)
    renderer.AddVolume(volume)
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(0)
    window.SetSize(size, size)
    window.AddRenderer(renderer)
    renderer.ResetCamera()
    renderer.GetActiveCamera().Azimuth(30)
    renderer.GetActiveCamera().Zoom(1.6)
    renderer.ResetCameraClippingRange()
    window.Render()
    reader = vtk.vtkWindowToImageFilter()
    reader.SetInput(window)
    reader.Update()
    pixels = numpy_support.vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars())
    return pixels.reshape(size, size, 3)[::-1] / 255, renderer.GetActiveCamera()


@pytest.mark.slow
@pytest.mark.parametrize("shaded", [False, True])
def test_a_picture_through_an_imported_preset_is_that_of_vtk(shaded):
    vtk = pytest.importorskip("vtk")
    x, y, z = np.indices((24, 24, 24)) / 11.5 - 1
    voxels = 1000 * np.exp(-2.5 * (x * x + 1.3 * y * y + 0.8 * z * z)) * (1 + 0.25 * np.sin(5 * x) * np.cos(4 * y + 2 * z)) - 200
    made = vtk.vtkVolumeProperty()
    interop.to_vtk_property(interop.slicer_preset("CT-Bone"), made)
    made.SetShade(shaded)
    theirs, camera = drawn_by_vtk(voxels.astype(np.float32), made, 40, 0.2)
    preset = interop.from_vtk_property(made)
    parts = {"shading": preset.shading, "lights": preset.lights, "normals": preset.normals}
    scene = jvr.Scene(jvr.Volume(voxels.astype(np.float32)), preset.transfer, **parts)
    ours = jvr.render(scene, interop.from_vtk(camera, 40, 40), jvr.Settings(0.2)).rgb
    # Eight bits alone leave 59 dB.
    assert -10 * np.log10(np.mean(np.square(ours - theirs))) > 50
    assert np.mean(theirs) > 0.05


def test_configurations_name_presets_of_others(tmp_path):
    (tmp_path / "maps.json").write_text(json.dumps([MAP]))
    (tmp_path / "a.vp").write_text(VP)

    def transfer(table):
        config = config_from({"volume": {"builtin": "demo"}, "transfer": table, "camera": {}}, "a.toml", tmp_path)
        return build_scene(config).transfer

    named = transfer({"kind": "slicer", "name": "CT-Bone", "encoding": "srgb"})
    assert jax.tree.all(jax.tree.map(np.array_equal, named, interop.slicer_preset("CT-Bone", encoding="srgb").transfer))
    np.testing.assert_allclose(transfer({"kind": "slicer", "path": "a.vp"}).sigma_t[-1], np.log(2), rtol=1e-6)
    np.testing.assert_allclose(
        transfer({"kind": "slicer", "path": "a.vp", "unit_distance": 2.0}).sigma_t[-1], np.log(2) / 2, rtol=1e-6
    )
    moved = transfer({"kind": "paraview", "path": "maps.json", "name": "warm", "range": [-3.0, 5.0]})
    np.testing.assert_allclose(moved.ends, (-3, 5))
    gradient = transfer({"kind": "slicer", "name": "CT-Bone", "gradient_opacity": {"low": 0.1, "high": 0.2}})
    assert isinstance(gradient, jvr.GradientOpacity)
    for table, said in [
        ({"kind": "slicer", "name": "CT-Bon"}, "transfer.name: unknown choice .CT-Bon.; did you mean 'CT-Bone'?"),
        ({"kind": "slicer"}, "name: missing; needs name or path"),
        ({"kind": "slicer", "name": "CT-Bone", "path": "a.vp"}, "excludes name"),
        ({"kind": "slicer", "name": "CT-Bone", "unit_distance": 2.0}, "unit_distance: belongs to files"),
        ({"kind": "slicer", "path": "b.vp"}, "transfer.path: 'b.vp' is not in"),
        ({"kind": "slicer", "path": "maps.json"}, r"maps.json: not a \.vp\.json of 3D Slicer"),
        ({"kind": "paraview", "path": "a.vp"}, "a.vp: not a preset of ParaView"),
        ({"kind": "paraview", "path": "maps.json", "encoding": "gamma"}, "encoding: unknown choice"),
    ]:
        with pytest.raises(ConfigError, match=said):
            transfer(table)
    (tmp_path / "own.toml").write_text('kind = "slicer"\nname = "CT-Bone"\n')
    assert jax.tree.all(jax.tree.map(np.array_equal, read_transfer(tmp_path / "own.toml"), interop.slicer_preset(3).transfer))
    (tmp_path / "own.toml").write_text('kind = "slicer"\npath = "a.vp"\n')
    with pytest.raises(ConfigError, match="cannot name another file"):
        read_transfer(tmp_path / "own.toml")
