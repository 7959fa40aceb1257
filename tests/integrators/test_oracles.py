"""Oracles that are given, that know the view, and of somebody's own, against brute force in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import affine, linear_transfer, perspective, voxels

import jvr
from jvr.integrators.slices.oracle import AbstractOracle
from jvr.io.config import build_settings, config_from
from jvr.model.parameters import assign, parameter
from jvr.model.ranges import NOT_NEGATIVE
from jvr.types import Scalar


class Focus(AbstractOracle):
    """Every sample within a distance of the eye, along the view, and samples as far apart as `beyond` behind that."""

    brick = 3
    reach: Scalar = parameter(NOT_NEGATIVE, doc="distance from the eye", unit="mm")
    beyond: Scalar = parameter(NOT_NEGATIVE, doc="distance between samples behind it", unit="mm")

    def __init__(self, reach=0.0, beyond=4.0):
        assign(self, reach=reach, beyond=beyond)

    def wanted(self, volume, features, plane):
        axes = [3.0 * jnp.arange(max(-(-(n - 1) // 3), 1)) for n in volume.shape]
        pose, x = plane.camera.world_from_camera, volume.world_from_point(tuple(jnp.meshgrid(*axes, indexing="ij")))
        depth = sum(pose[i, 2] * (pose[i, 3] - x[i]) for i in range(3))
        return jnp.where(depth < self.reach, 0.0, self.beyond)


# -- what is given


def test_the_longest_distance_within_the_tolerance_is_taken():
    """With errors that do not grow, where a longer one is of no use, and one that is no number."""
    rng = np.random.default_rng(3)
    errors, lengths = rng.random((3, 2, 3, 2)), np.array([0.5, 1.5, 4.0])
    errors[1, 0, 0, 0], errors[0, 1, 1, 1] = np.nan, 0.9
    found = jvr.GivenDistances.from_errors(errors, lengths, 0.6, brick=5)
    wanted = np.zeros((2, 3, 2))
    for index in np.ndindex(2, 3, 2):
        for error, length in zip(errors[:, *index], lengths, strict=True):
            if not error <= 0.6:
                break
            wanted[index] = length
    assert len(np.unique(wanted)) == 4
    np.testing.assert_array_equal(np.array(found.distances), wanted)
    assert found.brick == 5


def test_given_distances_are_static():
    one, same, other = (jvr.GivenDistances(np.full((1, 2, 3), value)) for value in (2.0, 2.0, np.inf))
    assert one == same
    assert hash(one) == hash(same)
    assert one != other
    assert not jax.tree.leaves(one)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jvr.GivenDistances(np.full((1, 1, 1), -1.0)), "distances must be not negative"),
        (lambda: jvr.GivenDistances(np.full((1, 1, 1), np.nan)), "distances must be not negative"),
        (lambda: jvr.GivenDistances(np.zeros((2, 2))), "shape"),
        (lambda: jvr.GivenDistances(np.zeros((1, 1, 1)), brick=0), "brick must be a whole number of at least 1"),
        (lambda: jax.jit(jvr.GivenDistances)(np.zeros((1, 1, 1))), "derive an oracle that computes them"),
        (lambda: jvr.GivenDistances.from_errors(np.zeros((2, 1, 1, 1)), [1.0], 0.1), "errors in bricks for each length"),
        (lambda: jvr.GivenDistances.from_errors(np.zeros((2, 1, 1, 1)), [2.0, 1.0], 0.1), "strictly increasing"),
        (lambda: jvr.PixelSize(pixels=0), "pixels must be positive"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_what_is_no_distance_is_refused(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()


def test_distances_of_another_volume_are_refused():
    scene = jvr.Scene(jvr.Volume(voxels((9, 6, 5))), linear_transfer())
    settings = jvr.Settings(sampling=jvr.Slices(jvr.GivenDistances(np.zeros((1, 2, 1)))))
    with pytest.raises(ValueError, match=r"GivenDistances asks .* \(1, 2, 1\) bricks; .* \(9, 6, 5\) has \(2, 2, 1\)"):
        jvr.render(scene, perspective(scene.volume), settings)


# -- pictures by an oracle of one's own

LEVELS, STEP, WIDTH, HEIGHT = 2, 0.53, 9, 7


@pytest.fixture(scope="module")
def cube():
    """A volume that fills the picture, seen along an axis: every pixel enters on the first slice and leaves in front of the last."""
    volume = jvr.Volume(voxels((13, 13, 13)), affine((1.0, 1.0, 1.0)))
    camera = jvr.OrthographicCamera.look_at([6.0, 6.0, 40.0], [6.0, 6.0, 6.0], [0.0, 1.0, 0.0], 5.0, WIDTH, HEIGHT)
    return jvr.Scene(volume, linear_transfer()), camera


@pytest.fixture(scope="module")
def picture(cube):
    """The picture with any reach and distance, by one program."""
    settings = lambda *focus: jvr.Settings(STEP, termination=0, sampling=jvr.Slices(Focus(*focus), levels=LEVELS))
    return jax.jit(lambda *focus: jvr.render(*cube, settings(*focus)))


def counted(wanted, last):
    """The samples on each level where all of slice `k` want to be `wanted(k)` slices from the next: the loop of figure 3. `last`: the slice
    behind each pixel, `(HEIGHT, WIDTH)`."""
    period, samples, d = 2**LEVELS, [0] * (LEVELS + 1), [0.0] * (LEVELS + 1)
    ended = -(-last // period) * period
    pixels = [(x, y) for x in range(WIDTH) for y in range(HEIGHT)]
    parents = lambda x: [X for X in range(-2, 20) if 2 * X - 1 <= x <= 2 * X + 2]
    for k in range(np.max(ended) + 1):
        used = [{(x, y) for x, y in pixels if k - k % period <= ended[y, x]}]
        for _ in range(LEVELS):
            used.append({(X, Y) for x, y in used[-1] for X in parents(x) for Y in parents(y)})
        if k % period:
            used[0] = {(x, y) for x, y in used[0] if k <= last[y, x]}
        top = max(level for level in range(LEVELS + 1) if k % 2**level == 0)
        for level in range(top, -1, -1):
            if top < LEVELS and not d[level] < 2 ** (top + 1):
                continue
            d[level] = d[level + 1] if level < top else d[level]
            if level == LEVELS or d[level] < 2 ** (level + 1):
                samples[level] += len(used[level])
                d[level] = wanted(k)
    return samples


ALL = np.full((HEIGHT, WIDTH), int(np.ceil(12 / STEP)))


@pytest.mark.slow
@pytest.mark.parametrize("d", [0.0, 1.9, 2.1, 3.9, 4.1])
def test_samples_are_those_that_an_oracle_asks_for(picture, d):
    """Pixels are farther apart than slices: they are the unit."""
    np.testing.assert_array_equal(picture(0.0, d * 5.0 / HEIGHT).stats.sampling.samples, counted(lambda k: d, ALL))


def by_pixels(scene, camera, pixels):
    oracle = jvr.PixelSize(jvr.PixelSize(jvr.Finest(), pixels=1.0), pixels=pixels)
    settings = jvr.Settings(STEP, termination=0, sampling=jvr.Slices(oracle, levels=LEVELS))
    return jax.jit(jvr.render)(scene, camera, settings).stats.sampling.samples


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [1.9, 2.0])
def test_pixels_of_parallel_rays_are_as_wide_everywhere(cube, pixels):
    np.testing.assert_array_equal(by_pixels(*cube, pixels), counted(lambda k: pixels, ALL))


@pytest.mark.slow
def test_pixels_widen_with_the_distance_from_the_eye(cube):
    """From an eye within the volume, near which pixels are narrower than slices are apart."""
    eye, fov_y = np.array([6.1, 5.8, 11.3]), 60.0
    camera = jvr.PerspectiveCamera.look_at(eye, [6.1, 5.8, 0.0], [0.0, 1.0, 0.0], fov_y, WIDTH, HEIGHT)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    tangent = 2 * np.tan(np.radians(fov_y) / 2) / HEIGHT
    ray = np.stack([(x + 0.5 - WIDTH / 2) * tangent, (HEIGHT / 2 - y - 0.5) * tangent, np.full(x.shape, -1.0)], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    # Rays of the column in the middle cross no plane across x.
    some = np.where(ray == 0, 1e-9, ray)
    length = np.min(np.where(some > 0, 12 - eye, -eye) / some, axis=-1)
    last = np.ceil(length / STEP).astype(int)
    wanted = lambda k: 3 * tangent * k * STEP / max(STEP, tangent * k * STEP)
    assert {np.floor(np.log2(max(wanted(k), 1))) for k in range(np.max(last))} == {0, 1}
    np.testing.assert_array_equal(by_pixels(cube[0], camera, 3.0), counted(wanted, last))


def test_an_oracle_of_ones_own_knows_the_view(picture):
    """What it wants sampled is as it is with every sample; behind that there is an error."""
    every, near, none = (picture(reach, 100.0) for reach in (1e3, 32.0, 0.0))
    error = lambda one: float(jnp.max(jnp.abs(one.rgb - every.rgb)))
    assert 0 < error(near) < 0.5 * error(none)
    counts = [int(one.stats.samples) for one in (none, near, every)]
    assert counts == sorted(set(counts))


@pytest.mark.usefixtures("_registry")
def test_an_oracle_of_ones_own_is_named_in_a_configuration():
    jvr.register("focus", Focus)
    table = {"sampling": {"kind": "slices", "oracle": {"kind": "focus", "reach": 3.0, "beyond": 2}}}
    oracle = build_settings(
        config_from({"volume": {"builtin": "demo"}, "transfer": {"kind": "window"}, "settings": table}, "here")
    ).sampling.oracle
    assert isinstance(oracle, Focus)
    assert (float(oracle.reach), float(oracle.beyond)) == (3.0, 2.0)


@pytest.mark.slow
def test_pictures_are_right_to_the_size_that_is_told_apart(cube):
    """The more pixels are one, the fewer samples and the larger the error: in each direction every second is left out, or three of four."""
    scene, camera = cube[0], perspective(cube[0].volume, 32, 30)
    by = lambda oracle: jax.jit(jvr.render)(
        scene, camera, jvr.Settings(0.25, termination=0, sampling=jvr.Slices(oracle, levels=2))
    )
    every, *some = map(by, (jvr.Finest(), *(jvr.PixelSize(jvr.Finest(), pixels=n) for n in (2.0, 4.0))))
    errors = [float(jnp.sqrt(jnp.mean((one.rgb - every.rgb) ** 2))) for one in some]
    samples = [int(one.stats.samples) for one in (every, *some)]
    assert 0 < errors[0] < errors[1] < 0.1
    assert samples[1] < samples[0] / 4
    assert samples[2] < samples[1] / 4


@pytest.mark.slow
def test_gradients_with_the_samples_of_a_view(cube, x64):
    """The samples depend on the view alone, so that differences in the transfer function see the same ones."""
    scene, camera = jax.tree.map(lambda x: x.astype(jnp.float64), cube)
    sampling = jvr.Slices(jvr.PixelSize(jvr.GivenDistances(np.zeros((3, 3, 3)))), levels=1)
    weights = np.random.default_rng(2).random((HEIGHT, WIDTH, 3))

    def loss(sigma_t):
        transfer = jvr.LinearTransfer(scene.transfer.positions, scene.transfer.rgb, sigma_t)
        found = jvr.render(jvr.Scene(scene.volume, transfer), camera, jvr.Settings(0.5, termination=0, sampling=sampling))
        return jnp.sum(weights * found.rgb)

    at = jnp.asarray(scene.transfer.sigma_t)
    along, value, h = jnp.array([0.3, -0.7, 1.1, 0.4]), jax.jit(loss), 1e-6
    difference = (value(at + h * along) - value(at - h * along)) / (2 * h)
    np.testing.assert_allclose(jnp.vdot(jax.jit(jax.grad(loss))(at), along), difference, rtol=1e-7)
