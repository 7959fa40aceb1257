"""Measured reflectance: files that the tests write from a known BRDF come back as that BRDF, bad files as one line."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.io.merl import CELLS, SCALES, MerlError, read_merl
from jvr.model.merl import half_and_difference


def cell_angles(n_h, n_d, n_p):
    """The angles in the middles of all cells, `(theta_h, theta_d, phi_d)` each."""
    middles = [(np.arange(n) + 0.5) / n for n in (n_h, n_d, n_p)]
    return np.meshgrid(0.5 * np.pi * middles[0] ** 2, 0.5 * np.pi * middles[1], np.pi * middles[2], indexing="ij")


def directions(theta_h, theta_d, phi_d):
    """`w_o` and `w_i`: mirrored about h = z first, then h tilted towards x."""
    x, y, z = np.sin(theta_d) * np.cos(phi_d), np.sin(theta_d) * np.sin(phi_d), np.cos(theta_d)
    c, s = np.cos(theta_h), np.sin(theta_h)
    tilted = lambda sign: (c * sign * x + s * z, sign * y, c * z - s * sign * x)
    return tilted(-1.0), tilted(1.0)


def table_of(brdf, cells=CELLS):
    """Reflectance in the middle of every cell, of three components; -1 where a direction is below the surface, as in measured data."""
    w_o, w_i = (tuple(jnp.asarray(c) for c in w) for w in directions(*cell_angles(*cells)))
    tinted, unmodulated = eqx.filter_jit(type(brdf).evaluate)(brdf, w_o, w_i)
    material = [np.asarray(sum(part[c % len(part)] for part in (tinted, unmodulated) if part)) for c in range(3)]
    seen = (np.asarray(w_o[2]) > 0) & (np.asarray(w_i[2]) > 0)
    return np.stack([np.where(seen, m / np.where(seen, w_i[2], 1), -1) for m in material], axis=-1)


def write_merl(path, table):
    values = np.moveaxis(np.asarray(table, float), -1, 0)
    values = np.where(values < 0, values, values / np.reshape(SCALES, (3, 1, 1, 1)))
    path.write_bytes(np.array(table.shape[:3], "<i4").tobytes() + values.astype("<f8").tobytes())
    return path


@pytest.fixture(scope="module")
def glossy():
    """Coloured paint: narrow enough to matter, wide enough for the cells."""
    return jvr.MicrofacetBRDF([0.8, 0.3, 0.1], roughness=0.4)


@pytest.fixture(scope="module")
def file(tmp_path_factory, glossy):
    return write_merl(tmp_path_factory.mktemp("merl") / "paint.binary", table_of(glossy))


def pairs(n, seed, least=0.3):
    """Directions whose cosines are at least `least`: away from the edge of what is measured."""
    rng = np.random.default_rng(seed)
    cosine, azimuth = rng.uniform(least, 1, (2, n)), rng.uniform(0, 2 * np.pi, (2, n))
    sine = np.sqrt(1 - cosine**2)
    w = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=1)
    return tuple(tuple(jnp.asarray(c, jnp.float32) for c in d) for d in w)


def by_colour(brdf, w_o, w_i):
    tinted, unmodulated = eqx.filter_jit(type(brdf).evaluate)(brdf, w_o, w_i)
    return np.stack([sum(np.asarray(part[c % len(part)]) for part in (tinted, unmodulated) if part) for c in range(3)])


def test_a_file_comes_back_as_the_brdf_it_was_made_of(file, glossy):
    w_o, w_i = pairs(4000, 0)
    # Beside the pseudorandom pairs, where the highlight is: light mirrored, and a little beside it.
    near = tuple(jnp.concatenate([a, b]) for a, b in zip(w_i, (-w_o[0] + 0.02, -w_o[1], w_o[2]), strict=True))
    length = jnp.sqrt(sum(c * c for c in near))
    w_o, w_i = tuple(jnp.tile(c, 2) for c in w_o), tuple(c / length for c in near)
    wanted, found = by_colour(glossy, w_o, w_i), by_colour(jvr.MerlBRDF.read(file), w_o, w_i)
    # Linear between cells of about a degree.
    np.testing.assert_allclose(found, wanted, rtol=0.02, atol=1e-3)
    assert np.median(np.abs(found / wanted - 1)) < 1e-3


def test_colours_and_scales(tmp_path):
    table = np.broadcast_to(np.array([0.1, 0.2, 0.3]), (*CELLS, 3))
    path = write_merl(tmp_path / "a.binary", table)
    raw = np.fromfile(path, "<f8", offset=12)
    np.testing.assert_allclose(raw[:: raw.size // 3], [150.0, 0.2 * 1500 / 1.15, 0.3 * 1500 / 1.66])
    np.testing.assert_allclose(read_merl(path), table, rtol=1e-6)
    w_o, w_i = pairs(10, 1)
    found = by_colour(jvr.MerlBRDF.read(path), w_o, w_i)
    np.testing.assert_allclose(found, np.array([0.1, 0.2, 0.3])[:, None] * np.asarray(w_i[2]), rtol=1e-5)


def test_one_cell_is_where_the_format_says(tmp_path):
    """The published look-up takes `floor(90 sqrt(theta_h / 90 deg))`, `floor(theta_d)` and `floor(phi_d)` in degrees."""
    table = np.zeros((*CELLS, 3))
    table[30, 20, 50] = [1.0, 2.0, 3.0]
    brdf = jvr.MerlBRDF(read_merl(write_merl(tmp_path / "a.binary", table)))
    # Half a cell from the middle in no direction, in each direction, and beyond.
    for offset, weight in (((0.5, 0.5, 0.5), 1.0), ((1.0, 0.5, 0.5), 0.5), ((0.5, 1.0, 0.5), 0.5), ((0.5, 0.5, 1.6), 0.0)):
        h, d, p = 30 + offset[0], 20 + offset[1], 50 + offset[2]
        angles = (0.5 * np.pi * (h / 90) ** 2, 0.5 * np.pi * d / 90, np.pi * p / 180)
        w_o, w_i = (tuple(jnp.asarray(c, jnp.float32) for c in w) for w in directions(*angles))
        found = np.asarray(brdf.evaluate(w_o, w_i)[1]) / float(w_i[2])
        np.testing.assert_allclose(found, weight * np.array([1.0, 2.0, 3.0]), rtol=2e-3, atol=1e-4)


def test_what_was_not_measured_is_black(file):
    table = read_merl(file)
    assert table.shape == (*CELLS, 3)
    assert table.min() == 0
    assert np.count_nonzero(table[80, 80, 0]) == 0  # tilted by 72 degrees and 80 more


def test_angles_there_and_back(x64):
    rng = np.random.default_rng(3)
    wanted = rng.uniform(0.01, 0.7, 100), rng.uniform(0.01, 0.7, 100), rng.uniform(0.01, 3.13, 100)
    turned = lambda w: tuple(jnp.asarray(c) for c in (0.6 * w[0] - 0.8 * w[1], 0.8 * w[0] + 0.6 * w[1], w[2]))
    w_o, w_i = (turned(w) for w in directions(*wanted))
    np.testing.assert_allclose(half_and_difference(w_o, w_i), wanted, rtol=1e-9)
    # Exchanged, the same cell.
    np.testing.assert_allclose(half_and_difference(w_i, w_o), wanted, rtol=1e-9)


def test_small_angles_keep_their_digits():
    wanted = np.geomspace(1e-4, 1e-2, 20), np.geomspace(1e-2, 1e-4, 20), np.full(20, 1.0)
    w_o, w_i = (tuple(jnp.asarray(c, jnp.float32) for c in w) for w in directions(*wanted))
    theta_h, theta_d, _ = half_and_difference(w_o, w_i)
    # Components of float32 near 1: steps of 6e-8.
    np.testing.assert_allclose(theta_h, wanted[0], atol=2e-7)
    np.testing.assert_allclose(theta_d, wanted[1], atol=2e-7)


def test_linear_beats_nearest(file, glossy):
    """Why eight times the reads are worth it."""
    table = read_merl(file)
    w_o, w_i = pairs(4000, 4)
    theta_h, theta_d, phi_d = (np.asarray(a) for a in half_and_difference(w_o, w_i))
    cells = 90 * np.sqrt(theta_h / (0.5 * np.pi)), 90 * theta_d / (0.5 * np.pi), 180 * phi_d / np.pi
    i, j, k = (np.minimum(u.astype(int), n - 1) for u, n in zip(cells, CELLS, strict=True))
    wanted = by_colour(glossy, w_o, w_i)
    error = lambda found: np.sqrt(np.mean((found / wanted - 1) ** 2))
    nearest, linear = error(table[i, j, k].T * np.asarray(w_i[2])), error(by_colour(jvr.MerlBRDF(table), w_o, w_i))
    assert linear < nearest / 5


@pytest.mark.parametrize("name", ["cut", "header", "empty", "text", "order", "nan", "huge"])
def test_bad_files_get_one_line(file, tmp_path, name):
    content = file.read_bytes()
    number = lambda x: content[:4012] + np.array([x], "<f8").tobytes() + content[4020:]
    part, says = {
        "cut": (content[:-8], r"the file has 34,992,004 bytes, a MERL BRDF 34,992,012; it is cut short or damaged"),
        "header": (content[:6], r"header says 90 cells, the format has 90 x 90 x 180"),
        "empty": (b"", "the file is empty"),
        "text": (b"<!DOCTYPE html>", "this is not a MERL BRDF"),
        "order": (np.array([180, 90, 90], "<i4").tobytes() + content[12:], "header says 180 x 90 x 90 cells"),
        "nan": (number(np.nan), "1 of its values are not finite; the file is damaged"),
        "huge": (number(1e300), "1 of its values are not finite"),
    }[name]
    path = tmp_path / "bad.binary"
    path.write_bytes(part)
    with pytest.raises(MerlError, match=says) as caught:
        jvr.MerlBRDF.read(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_missing_files_are_named(file):
    with pytest.raises(FileNotFoundError, match=r"did you mean 'paint.binary'"):
        jvr.MerlBRDF.read(file.with_name("paint.binry"))
    with pytest.raises(MerlError, match="this is a folder"):
        jvr.MerlBRDF.read(file.parent)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        (np.ones((2, 2, 2)), r"table has shape \(2, 2, 2\); it must be \(n, n, n, 3\)"),
        (-np.ones((2, 2, 2, 3)), "finite and not negative"),
        (np.full((2, 2, 2, 3), np.inf), "finite and not negative"),
    ],
)
def test_tables_are_checked(table, says):
    with pytest.raises(ValueError, match=says):
        jvr.MerlBRDF(table)
