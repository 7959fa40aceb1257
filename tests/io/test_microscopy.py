"""Units, axes, microscopy's formats and stacks of pictures: where and how large the world is, and never a guess without a word."""

import json
import warnings

import numcodecs
import numpy as np
import pint
import pytest
import tifffile
import zarr
from PIL import Image

from jvr import cli
from jvr.io.config import config_from
from jvr.io.config.build import build_volume
from jvr.io.volumes import VolumeError, read_volume
from jvr.io.volumes.given import Given
from jvr.io.volumes.tiff import read_tiff
from jvr.io.volumes.units import length_of, millimetres
from jvr.io.volumes.zarr_files import read_zarr

# --- Units -----------------------------------------------------------------------------------------------------------

# The enumeration UnitsLength of the OME schema 2016-06, and the lengths that OME-Zarr takes from UDUNITS, as pint knows them.
OME = [
    *(
        f"{prefix}m"
        for prefix in ("Y", "Z", "E", "P", "T", "G", "M", "k", "h", "da", "", "d", "c", "m", "µ", "n", "p", "f", "a", "z", "y")
    )
]
OME += ["Å", "thou", "in", "ft", "yd", "mi", "pc"]
PREFIXES = (
    "atto",
    "centi",
    "deci",
    "exa",
    "femto",
    "giga",
    "hecto",
    "kilo",
    "mega",
    "micro",
    "milli",
    "nano",
    "peta",
    "pico",
    "tera",
    "yocto",
)
UDUNITS = [f"{prefix}{metre}" for prefix in (*PREFIXES, "yotta", "zepto", "zetta", "") for metre in ("meter", "metre", "meters")]
UDUNITS += ["angstrom", "foot", "inch", "mile", "parsec", "yard", "inches", "feet", "microns", "fermi"]


def test_units_of_length_are_those_of_pint():
    registry = pint.UnitRegistry()
    for unit in (*OME, *UDUNITS):
        np.testing.assert_allclose(length_of(unit), registry.Quantity(1.0, unit).to("mm").magnitude, rtol=1e-9, err_msg=unit)
    for unit, wanted in {"li": "inch / 12", "ua": "astronomical_unit", "ly": "light_year", "pt": "inch / 72"}.items():
        np.testing.assert_allclose(length_of(unit), registry.Quantity(wanted).to("mm").magnitude, rtol=1e-6, err_msg=unit)


@pytest.mark.parametrize(
    "unit",
    [
        "µm",
        "\u03bcm",
        "um",
        "&#181;m",
        "&micro;m",
        "&#x3BC;m",
        "\\u00B5m",
        "\\u00b5m",
        " Micron ",
        "MICROMETRES",
        "µm/pixel",
        "Âµm",
    ],
)
def test_spellings_of_a_micrometre(unit):
    assert length_of(unit) == 1e-3


def test_case_of_symbols_counts_and_unknown_units_are_said():
    assert (length_of("Mm"), length_of("mm"), length_of("pm"), length_of("Pm")) == (1e9, 1.0, 1e-9, 1e18)
    for unit, said in (
        ("pixel", "no length"),
        ("reference frame", "no length"),
        ("s", "'s' is unknown"),
        (None, "no unit"),
        ("", "no unit"),
    ):
        with pytest.warns(UserWarning, match=f"a.tif: field: .*{said}.*spacing="):
            assert millimetres("a.tif", "field", unit) == 1.0


# --- Help ------------------------------------------------------------------------------------------------------------


def stack(*shape, dtype="u2"):
    """Values that are all different."""
    return np.arange(np.prod(shape), dtype=dtype).reshape(shape)


def spacing_of(volume):
    return np.linalg.norm(np.asarray(volume.world_from_grid)[:3, :3], axis=0)


def silent(path, **keywords):
    """Reads without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_volume(path, **keywords)


def fails(match, path, **keywords):
    """One line that names the file and what to type."""
    with pytest.raises(VolumeError, match=match) as caught:
        read_volume(path, **keywords)
    assert "\n" not in str(caught.value)
    assert path.name in str(caught.value)


# --- Axes ------------------------------------------------------------------------------------------------------------


def test_channels_and_times_of_a_numpy_array_are_chosen_by_name_of_axis(tmp_path):
    path, values = tmp_path / "a.npy", stack(2, 3, 4, 5, 6)
    np.save(path, np.asfortranarray(values.astype(">i4")))
    fails("5 axes.*axes=.*tczyx", path)
    fails("2 points in time.*time=.*--time", path, axes="tczyx")
    fails("3 channels.*channel=.*0 to 2", path, axes="tczyx", time=1)
    fails("no channel 3", path, axes="tczyx", time=1, channel=3)
    fails("no channel -1", path, axes="tczyx", time=1, channel=-1)
    fails("axes='tqzyx'", path, axes="tqzyx", time=1)
    np.testing.assert_array_equal(silent(path, axes="tczyx", time=1, channel="2").values, values[1, 2].T)
    np.testing.assert_array_equal(silent(path, axes="ctxzy", channel=1, time=0).values, values[1, 0].transpose(0, 2, 1))
    np.save(path, values[:1, :1, :, :, :])
    np.testing.assert_array_equal(silent(path, axes="tczyx").values, values[0, 0].T)
    np.testing.assert_array_equal(silent(path, axes="zyx").values, values[0, 0].T)
    np.save(path, values[0, 0] % 2 == 0)
    fails("channel=1: it has no axis of channels", path, channel=1)
    np.testing.assert_array_equal(silent(path, axes="zyx").values, (values[0, 0] % 2 == 0).T)


# --- TIFF ------------------------------------------------------------------------------------------------------------


def test_resolution_of_a_plain_tiff_counts_in_its_unit_and_z_is_said(tmp_path):
    path = tmp_path / "a.tif"
    for unit, size in (("CENTIMETER", 10 / 400), ("INCH", 25.4 / 400)):
        tifffile.imwrite(path, stack(3, 4, 5), resolution=(400, 200), resolutionunit=unit, photometric="minisblack")
        with pytest.warns(UserWarning, match="no voxel size along z.*spacing="):
            np.testing.assert_allclose(spacing_of(read_volume(path)), [size, 2 * size, size], rtol=1e-6)
    tifffile.imwrite(path, stack(3, 4, 5), resolution=(400, 200), resolutionunit="NONE", photometric="minisblack")
    with pytest.warns(UserWarning, match="no voxel size along x, y, z.*ResolutionUnit"):
        np.testing.assert_array_equal(spacing_of(read_volume(path)), 1)
    np.testing.assert_allclose(spacing_of(silent(path, spacing=(1, 2, 3))), [1, 2, 3])


def test_imagej_hyperstack(tmp_path):
    path, values = tmp_path / "a.tif", stack(2, 3, 2, 4, 5)
    about = {"axes": "TZCYX", "unit": "\\u00B5m", "spacing": -2.0, "finterval": 3.0}
    tifffile.imwrite(path, values, imagej=True, resolution=(4, 2), metadata=about)
    fails("2 points in time.*time=", path)
    fails("2 channels.*channel=", path, time=0)
    volume = silent(path, time=1, channel=0)
    np.testing.assert_array_equal(volume.values, values[1, :, 0].T)
    np.testing.assert_allclose(spacing_of(volume), [0.25e-3, 0.5e-3, 2e-3], rtol=1e-6)
    tifffile.imwrite(path, values[:, 0, 0], imagej=True, metadata={"axes": "TYX", "unit": "pixel"})
    fails("2 points in time", path)
    with pytest.warns(UserWarning, match="ImageJ's unit: the unit 'pixel' is no length"):
        assert read_volume(path, axes="zyx").shape == (5, 4, 2)


def test_ome_tiff_sizes_channels_and_images(tmp_path):
    path, values = tmp_path / "a.ome.tif", stack(2, 3, 4, 5)
    about = {
        "axes": "CZYX",
        "Channel": {"Name": ["DAPI", "a > b"]},
        "PhysicalSizeX": 5.0,
        "PhysicalSizeXUnit": "Å",
        "PhysicalSizeY": 0.5,
    }
    tifffile.imwrite(path, values, photometric="minisblack", metadata=about)
    fails("2 channels.*channel=.*0 'DAPI', 1 'a > b'", path)
    with pytest.warns(UserWarning, match="no voxel size along z.*PhysicalSizeZ"):
        volume = read_volume(path, channel="a > b")
    np.testing.assert_array_equal(volume.values, values[1].T)
    np.testing.assert_allclose(spacing_of(volume), [5e-7, 5e-4, 5e-7], rtol=1e-6)
    tifffile.imwrite(
        path,
        values[0],
        metadata={"axes": "ZYX"} | {f"PhysicalSize{a}{b}": c for a in "XYZ" for b, c in (("", 2), ("Unit", "pixel"))},
    )
    with pytest.warns(UserWarning, match="PhysicalSizeXUnit, PhysicalSizeYUnit, PhysicalSizeZUnit: the unit 'pixel'") as said:
        np.testing.assert_array_equal(spacing_of(read_volume(path)), 2)
    assert len(said) == 1
    with tifffile.TiffWriter(path, ome=True) as file:
        for k, name in enumerate(("overview", "scan")):
            sizes = {f"PhysicalSize{a}": 2.0 + k for a in "XYZ"} | {f"PhysicalSize{a}Unit": "nm" for a in "XYZ"}
            file.write(values[k], photometric="minisblack", metadata={"axes": "ZYX", "Name": name, **sizes})
    fails("2 images.*'overview'.*'scan'.*array=", path)
    for name in ("scan", "1"):
        volume = silent(path, array=name)
        np.testing.assert_array_equal(volume.values, values[1].T)
        np.testing.assert_allclose(spacing_of(volume), 3e-6, rtol=1e-6)


def test_ome_xml_that_defines_entities_or_points_elsewhere_is_refused(tmp_path):
    path = tmp_path / "a.ome.tif"
    head = '<?xml version="1.0"?>{}<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">{}</OME>'
    bomb = '<!DOCTYPE OME [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
    for text, said in (
        (head.format(bomb, "&b;"), "entities"),
        (head.format("", '<BinaryOnly MetadataFile="x.ome.xml"/>'), "x.ome.xml"),
    ):
        tifffile.imwrite(path, stack(3, 4, 5), description=text, metadata=None)
        fails(said, path)


@pytest.mark.parametrize("compression", ["lzw", "packbits", "zstd", "lzma"])
def test_compressed_tiff(tmp_path, compression):
    values = stack(3, 40, 50)
    tifffile.imwrite(tmp_path / "a.tif", values, compression=compression, photometric="minisblack")
    np.testing.assert_array_equal(silent(tmp_path / "a.tif", spacing=1).values, values.T)


def test_one_bit_and_jpeg_tiff_that_pillow_writes(tmp_path):
    bits = np.random.default_rng(0).random((40, 50)) > 0.5
    pages = [Image.fromarray(bits), Image.fromarray(~bits)]
    for compression in (None, "group4"):
        pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:], compression=compression)
        np.testing.assert_array_equal(silent(tmp_path / "a.tif", spacing=1).values, np.stack([bits, ~bits]).T)
    smooth = Image.fromarray(np.add.outer(np.arange(40), np.arange(50)).astype("u1"))
    smooth.save(tmp_path / "b.tif", compression="jpeg")
    found = np.asarray(silent(tmp_path / "b.tif", spacing=1).values)[..., 0].T
    np.testing.assert_array_less(abs(found.astype(int) - np.asarray(smooth)), 4)  # JPEG is lossy
    whole = (tmp_path / "b.tif").read_bytes()
    at = whole.index(b"\xff\xc0") + 5
    (tmp_path / "b.tif").write_bytes(whole[:at] + b"\xff\x00\xff\x00" + whole[at + 4 :])
    fails("JPEG", tmp_path / "b.tif", spacing=1)


def test_no_data_and_colour_of_tiff(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, stack(3, 4, 5, dtype="f4"), photometric="minisblack", extratags=[(42113, "s", 0, "-9999", True)])
    assert read_tiff(path, Given(spacing=np.ones(3))).missing == -9999
    colour = np.random.default_rng(0).integers(0, 99, (3, 4, 5, 3), dtype="u1")
    tifffile.imwrite(path, colour, photometric="rgb")
    fails("colour.*grey.*channel=", path)
    np.testing.assert_array_equal(silent(path, channel="green", spacing=1).values, colour[..., 1].T)


# --- Zarr ------------------------------------------------------------------------------------------------------------


def ome_zarr(path, values, image, *, zarr_format=2, omero=None):
    """An OME-Zarr image of one level; `image` is its entry in multiscales."""
    group = zarr.open_group(path, mode="w", zarr_format=zarr_format)
    group.create_array("0", shape=values.shape, dtype=values.dtype)[...] = values
    data = {"multiscales": [{"datasets": [{"path": "0"}]} | image]} | ({"omero": omero} if omero else {})
    group.attrs.update({"ome": {"version": "0.5"} | data} if zarr_format == 3 else data)


def space(unit, kinds="tczyx"):
    types = {"t": {"type": "time", "unit": "second"}, "c": {"type": "channel"}}
    return [{"name": k, **types.get(k, {"type": "space"} | ({"unit": unit} if unit else {}))} for k in kinds]


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_both_transformations_units_and_channel_names_of_ome_zarr(tmp_path, zarr_format):
    path, values = tmp_path / "a.zarr", stack(2, 2, 3, 4, 5)
    first = [{"type": "scale", "scale": [1, 1, 4, 2, 1]}, {"type": "translation", "translation": [0, 0, 40, 20, 10]}]
    second = [{"type": "scale", "scale": [0.1, 1, 10, 10, 10]}, {"type": "translation", "translation": [9, 0, 1, 2, 3]}]
    datasets = [{"path": "0", "coordinateTransformations": first}]
    image = {"axes": space("micrometer"), "datasets": datasets, "coordinateTransformations": second}
    ome_zarr(path, values, image, zarr_format=zarr_format, omero={"channels": [{"label": "DAPI"}, {"label": "GFP"}]})
    fails("2 channels.*0 'DAPI', 1 'GFP'", path, time=0)
    volume = silent(path, time=1, channel="GFP")
    np.testing.assert_array_equal(volume.values, values[1, 1].T)
    wanted = np.diag([10e-3, 20e-3, 40e-3, 1.0])
    wanted[:3, 3] = [103e-3, 202e-3, 401e-3]
    np.testing.assert_allclose(volume.world_from_grid, wanted, rtol=1e-6)
    image["axes"] = space(None)
    ome_zarr(path, values, image, zarr_format=zarr_format)
    with pytest.warns(UserWarning, match="axes z, y, x: no unit of length") as said:
        read_volume(path, time=1, channel=1)
    assert len(said) == 1
    image["coordinateTransformations"] = [{"type": "scale", "scale": [1, 2]}]
    ome_zarr(path, values, image, zarr_format=zarr_format)
    fails("coordinateTransformations.*spacing=", path, time=1, channel=1)
    np.testing.assert_allclose(spacing_of(silent(path, time=1, channel=1, spacing=2, origin=(0, 0, 0))), 2)


@pytest.mark.slow
def test_old_ome_zarr_and_the_layout_of_bioformats2raw(tmp_path):
    path, values = tmp_path / "a.zarr", stack(1, 2, 3, 4, 5)
    for image in ({}, {"axes": list("tczyx")}):
        ome_zarr(path, values, image)
        with pytest.warns(UserWarning, match="no scale"):
            np.testing.assert_array_equal(read_volume(path, channel=1).values, values[0, 1].T)
    path = tmp_path / "b.zarr"
    zarr.open_group(path, mode="w", zarr_format=2).attrs["bioformats2raw.layout"] = 3
    for k in range(2):
        scale = [{"path": "0", "coordinateTransformations": [{"type": "scale", "scale": [1, 1, 1 + k, 2, 2]}]}]
        ome_zarr(path / str(k), values + k, {"axes": space("angstrom"), "datasets": scale})
    with pytest.warns(UserWarning, match="2 images; '0' is read: array="):
        np.testing.assert_array_equal(read_volume(path, channel=0).values, values[0, 0].T)
    for name in ("1", "1/0"):
        volume = silent(path, array=name, channel=0)
        np.testing.assert_array_equal(volume.values, values[0, 0].T + 1)
        np.testing.assert_allclose(spacing_of(volume), 2e-7, rtol=1e-6)


def test_plain_zarr_names_no_data_zip_and_codecs(tmp_path):
    path, values = tmp_path / "a.zarr", stack(2, 3, 4, 5, dtype="f4")
    array = zarr.create_array(path, shape=values.shape, dtype="f4", zarr_format=2, attributes={"_FillValue": -9.0})
    array[...] = values
    fails("4 axes.*axes=", path)
    array.attrs["_ARRAY_DIMENSIONS"] = ["time", "z", "y", "x"]
    fails("2 points in time", path)
    np.testing.assert_array_equal(silent(path, time=1).values, values[1].T)
    assert read_zarr(path, Given(time=0)).missing == -9
    array.attrs["_ARRAY_DIMENSIONS"] = ["a", "z", "y", "x"]
    fails("called a, z, y, x.*axes=", path)
    np.testing.assert_array_equal(silent(path, axes="czyx", channel=1).values, values[1].T)
    with zarr.storage.ZipStore(tmp_path / "b.zarr.zip", mode="w") as store:
        zarr.create_array(store, shape=(3, 4, 5), dtype="f4")[...] = values[0]
    np.testing.assert_array_equal(silent(tmp_path / "b.zarr.zip").values, values[0])
    header = json.loads((path / ".zarray").read_text())
    for packed in ({"compressor": {"id": "pickle"}}, {"filters": [{"id": "zlib"}, {"id": "pickle"}]}):
        (path / ".zarray").write_text(json.dumps(header | packed))
        fails("'pickle'", path, axes="czyx", channel=1)


def test_chunks_that_crash_a_decoder_or_announce_too_much(tmp_path):
    """The decoder of Blosc reads beyond the end of a chunk that is cut short, which ends its process."""
    path, values = tmp_path / "a.zarr", stack(3, 4, 5)
    blosc = numcodecs.Blosc(cname="lz4")
    zarr.create_array(path, shape=values.shape, dtype=values.dtype, zarr_format=2, compressors=blosc)[...] = values
    np.testing.assert_array_equal(silent(path).values, values)
    chunk = path / "0.0.0"
    whole = chunk.read_bytes()
    for damaged in (whole[:24], whole[:4] + (2**31 - 257).to_bytes(4, "little") + whole[8:]):
        chunk.write_bytes(damaged)
        fails("compressed data are damaged", path)


# --- Folders of pictures ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ["png", "tif", "bmp"])
def test_slices_are_in_the_order_of_their_numbers(tmp_path, ending):
    values = stack(11, 4, 5, dtype="u1")
    for k, page in enumerate(values):
        Image.fromarray(page).save(tmp_path / f"slice{k}.{ending}")
    (tmp_path / "Thumbs.db").write_bytes(b"x")
    (tmp_path / ".hidden.png").write_bytes(b"x")
    with pytest.warns(UserWarning, match="spacing=") as said:
        np.testing.assert_array_equal(read_volume(tmp_path).values, values.T)
    assert len(said) == 1
    np.testing.assert_allclose(spacing_of(silent(tmp_path, spacing=(1, 2, 3))), [1, 2, 3])
    (tmp_path / f"slice4.{ending}").unlink()
    with pytest.warns(UserWarning, match=f"no slice lies between slice3.{ending} and slice5.{ending}"):
        read_volume(tmp_path, spacing=1)


def test_slices_that_are_no_volume(tmp_path):
    def save(name, values):
        Image.fromarray(values).save(tmp_path / name)

    save("a1.png", stack(4, 5, dtype="u1"))
    save("a2.png", stack(4, 6, dtype="u1"))
    fails("a1.png is 5 x 4 uint8, a2.png is 6 x 4", tmp_path)
    save("a2.png", stack(4, 5))
    fails("a1.png is 5 x 4 uint8, a2.png is 5 x 4 uint16", tmp_path)
    save("a2.png", stack(4, 5, 3, dtype="u1"))
    with pytest.raises(VolumeError, match=r"a2.png: .*colour"):
        read_volume(tmp_path)
    save("a2.png", np.repeat(stack(4, 5, 1, dtype="u1"), 3, axis=2))
    np.testing.assert_array_equal(silent(tmp_path, spacing=1).values[..., 1], stack(4, 5).T)
    whole = (tmp_path / "a2.png").read_bytes()
    (tmp_path / "a2.png").write_bytes(whole[:-30])
    with pytest.raises(VolumeError, match=r"a2.png: damaged"):
        read_volume(tmp_path)
    (tmp_path / "a2.png").write_bytes(whole[:16] + (40000).to_bytes(4, "big") * 2 + whole[24:])
    with pytest.raises(VolumeError, match=r"a2.png: (damaged|.*free in memory)"):
        read_volume(tmp_path)
    (tmp_path / "a2.png").unlink()
    save("a2.bmp", stack(4, 5, dtype="u1"))
    fails("several kinds.*a1.png.*a2.bmp", tmp_path)
    (tmp_path / "a1.png").unlink()
    whole = (tmp_path / "a2.bmp").read_bytes()
    (tmp_path / "a2.bmp").write_bytes(whole[:18] + (8000).to_bytes(4, "little") * 2 + whole[26:])
    with pytest.raises(VolumeError, match=r"a2.bmp: the header announces 8000 x 8000 voxels"):
        read_volume(tmp_path)


# --- Command line, configuration, packages ---------------------------------------------------------------------------


def test_flags_and_configuration_keys_choose_channel_and_time(tmp_path, capsys):
    values = stack(2, 3, 4, 5, 6)
    np.save(tmp_path / "a.npy", values)
    flags = ["--axes", "tczyx", "--channel", "2", "--time", "1", "--spacing", "1,2,3", "--origin", "-4,5,6", "--json"]
    assert cli.run(["info", str(tmp_path / "a.npy"), *flags]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["shape"], [found["minimum"], found["maximum"]]) == (
        [6, 5, 4],
        [int(values[1, 2].min()), int(values[1, 2].max())],
    )
    table = {"path": "a.npy", "axes": "tczyx", "channel": 2, "time": 1, "slope": 2, "intercept": 1}
    table |= {"direction": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "spacing": [1, 2, 3], "origin": [-4, 5, 6]}
    volume = build_volume(config_from({"volume": table, "transfer": {"kind": "window"}}, "test", tmp_path))
    np.testing.assert_array_equal(volume.values, values[1, 2].T)
    np.testing.assert_array_equal(volume.world_from_grid, [[0, 2, 0, -4], [-1, 0, 0, 5], [0, 0, 3, 6], [0, 0, 0, 1]])
    assert (float(volume.slope), float(volume.intercept)) == (2, 1)


@pytest.mark.parametrize("compression", ["lzw", "zstd"])
def test_what_to_install_where_a_decoder_is_missing(tmp_path, monkeypatch, compression):
    tifffile.imwrite(tmp_path / "a.tif", stack(3, 4, 5), compression=compression, photometric="minisblack")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)

    def missing(*_, **__):
        raise ValueError(f"<COMPRESSION.{compression.upper()}> requires the 'imagecodecs' package")

    monkeypatch.setattr(tifffile.TiffPageSeries, "asarray", missing)
    fails("pip install imagecodecs", tmp_path / "a.tif", spacing=1)
