"""Configurations: what is refused and how, overrides, where files are searched, and transfer functions in TOML."""

import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.io.config import (
    ConfigError,
    build_cameras,
    build_fit,
    build_scene,
    build_settings,
    config_from,
    read_config,
    read_transfer,
    write_transfer,
)
from jvr.io.config.parts import choices_of
from jvr.io.kinds import KINDS, PARTS
from jvr.march.quadrature import AbstractQuadrature
from jvr.model.camera import AbstractCamera
from jvr.model.exact import Remainder
from jvr.model.parameters import assign, choice, parameter
from jvr.model.ranges import ANGLE_OF_VIEW, AT_LEAST_ONE, UNIT_INTERVAL
from jvr.rendering.trace import enter
from jvr.types import Affine, Scalar

CONFIGS = Path(__file__).parents[2] / "configs"
BASE = '[volume]\nbuiltin = "demo"\n[transfer]\nkind = "window"\n'
LINEAR = "transfer={kind='linear',positions=[0,1],rgb=[[1,1,1],[1,1,1]],sigma_t=[1,2]}"


def config(text=BASE, *sets):
    return config_from(tomllib.loads(text), "config.toml", Path(), sets)


def build(made):
    scene = build_scene(made)
    return scene, build_cameras(made, scene.volume), build_settings(made)


def refusal(text, *sets):
    with pytest.raises(ConfigError) as caught:
        build(config(text, *sets))
    line = str(caught.value)
    assert "\n" not in line
    assert len(line) < 400
    return line


@pytest.mark.parametrize(
    ("text", "key", "hint"),
    [
        ("[fit]\nsolvr = 'dogleg'", "fit.solvr", "did you mean 'solver'?"),
        ("[fit]\nsolver = 'levenberg'", "fit.solver", "did you mean 'levenberg-marquardt'?"),
        ("[settings]\nstep = '0.5mm'", "settings.step", "voxels"),
        ("[settings]\nstep = -0.5", "settings.step", "must be positive"),
        ("[settings]\nstep = true", "settings.step", "not true"),
        ("[settings]\nstep = inf", "settings.step", "finite"),
        ("[settings]\ntermination = 1.5", "settings.termination", "in [0, 1)"),
        ("[settings]\ntile = 0", "settings.tile", "at least 1"),
        ("[settings]\nadjoint = 'Replay'", "settings.adjoint", "did you mean 'replay'?"),
        ("[camera]\nfov_y = 200", "camera.fov_y", "degrees"),
        ("[camera]\nfov_y = '30deg'", "camera.fov_y", "degrees"),
        ("[camera]\neye = [0, 1]", "camera.eye", "3 numbers"),
        ("[camera]\neye = [0, 0, 0]\ntarget = [0, 0, 0]", "camera", "eye and target"),
        ("[camera]\nup = [0, 0, 0]", "camera", "up must not be zero"),
        ("[[camera]]\n[[camera]]\neyes = [0, 1, 2]", "camera[1].eyes", "did you mean 'eye'?"),
        ("[[camera]]\n[[camera]]\nkind = 'orbit'", "camera[1].count", "missing"),
        ("[camera]\nkind = 'fish'", "camera.kind", "perspective"),
        ("[camera]\nkind = 'orthographic'\nfov_y = 30", "camera.fov_y", 'only kind = "perspective" or'),
        ("[camera]\nkind = 'orbit'\ncount = 3\naxis = [0, 0, 0]", "camera.axis", "must have a direction"),
        ("[[camera]]\nkind = 'orbit'\ncount = 99999", "camera[0].count", "from 1 to 10000"),
        ("[camera]\nworld_from_camera = []", "camera.world_from_camera", "unknown key"),
        ("[settings]\nkind = 'fast'", "settings.kind", "unknown key"),
        ("[settings]\nnegligible = 0.1\nskipping = false", "settings", "skipping=True"),
        ("[settings]\nquadrature = 3", "settings.quadrature", "or one of 'midpoint', 'pre-integrated', not 3"),
        (
            "[settings.quadrature]\nkind = 'midpoint'\nparts = 2",
            "settings.quadrature.parts",
            'only kind = "pre-integrated" has it',
        ),
        ("[settings.sampling]\nkind = 'slices'\nlevels = 6", "settings.sampling.levels", "from 0 to 5"),
        ("[settings.sampling]\nkind = 'slices'\ntolerance = 0", "settings.sampling.tolerance", "must be positive"),
        ("[settings.sampling]\nkind = 'slices'\noracle = 'finst'", "settings.sampling.oracle", "did you mean 'finest'?"),
        ("[settings.sampling]\nkind = 'slices'\noracle = 'pixel-size'\ntolerance = 1", "settings.sampling", "has no tolerance"),
        (
            "[settings.sampling]\nkind = 'slices'\n[settings.sampling.oracle]\nkind = 'given'\ndistances = [[[-1]]]",
            "settings.sampling.oracle",
            "distances must be not negative",
        ),
        ("[settings.sampling]\nkind = 'refinement'\ntile = 6", "settings.sampling", "a power of two from 2 to 64"),
        ("[clipping]\nkind = 'ball'\nlower = [0, 0, 0]\nupper = [1, 1, 1]", "clipping.kind", "known: box, plane"),
        (
            "[clipping]\nkind = 'plane'\npoint = [0, 0, 0]\nnormal = [0, 0, 0]",
            "clipping.normal",
            "must have a direction",
        ),
        (
            "[[clipping]]\nlower = [0, 0, 0]\nupper = [1, 1, 1]\n[[clipping]]\nnormal = [0, 0, 1]",
            "clipping[1].normal",
            'kind = "plane"',
        ),
        ("[camera]\nwidth = 12.5", "camera.width", "whole number"),
        ("[clipping]\nlower = [0, 0, 0]\nupper = [1, 1, 0]", "clipping", "lower < upper"),
        ("[fit]\nloss = 'huber'", "fit.images", "[truth]"),
        ("[fit]\nmax_steps = 0\n[truth]\nkind = 'window'", "fit.max_steps", "at least 1"),
        ("[fit]\nloss = 'dssim'\n[truth]\nkind = 'window'", "fit.loss", "bfgs"),
        ("[fit]\nheld_out = -1\n[truth]\nkind = 'window'", "fit.held_out", "indices"),
        ("[fit.start]\nentries = 8\n[truth]\nkind = 'window'", "fit.start", "excludes [transfer]"),
        ("[weather]\nx = 1", "weather", "known:"),
    ],
)
def test_mistakes_in_a_table_are_named(text, key, hint):
    line = refusal(BASE + text)
    assert line.startswith(f"config.toml: {key}: ")
    assert hint in line


@pytest.mark.parametrize(
    ("change", "key", "hint"),
    [
        ("transfer.positions=[1,0]", "transfer.positions", "strictly increasing"),
        ("transfer.positions=[0]", "transfer.positions", "too few"),
        ("transfer.sigma_t=[1,-2]", "transfer.sigma_t", "entry 1 must be finite and not negative"),
        ("transfer.sigma_t=[1,[1,2,3]]", "transfer.sigma_t", "mixture"),
        ("transfer.sigma_t=[1]", "transfer.sigma_t", "1 entries"),
        ("transfer.rgb=[[1,1,1],[1,1]]", "transfer.rgb[1]", "red, green, blue"),
        ("transfer.kind=linea", "transfer.kind", "did you mean 'linear'?"),
        ("transfer.kind=lut", "transfer.positions", "unknown key"),
        ("volume.spacing=[1,1,0]", "volume.spacing", "mm along x, y, z"),
        ("volume.path=nothing.mhd", "volume.path", "$JVR_DATA"),
        ("background=[0,0,nan]", "background", "finite"),
        ("optical=emission", "optical", "emission-only"),
        ("volum.path=a.mhd", "volum", "did you mean 'volume'?"),
    ],
)
def test_mistakes_on_the_command_line_are_named_as_such(change, key, hint):
    line = refusal(BASE, LINEAR, change)
    assert line.startswith(f"--set: {key}")
    assert hint in line


def test_an_override_without_value_is_refused():
    assert "key=value" in refusal(BASE, "settings.step")


def test_overrides_take_toml_values_and_plain_text():
    made = config(BASE, "settings.step=0.25", "camera.eye=[9, 0, 0]", "optical=emission-only", "volume.source=a = b")
    assert made.tables.settings.step == 0.25
    assert made.tables.camera[0].eye == [9, 0, 0]
    assert made.tables.optical.part is jvr.EmissionOnly
    assert made.tables.volume.source == "a = b"


def test_overrides_reach_into_lists_and_replace_alternatives():
    made = config(
        BASE + "[[camera]]\n[[camera]]\nkind='orbit'\ncount=2\nfov_y=20\n", "camera.1.count=5", "camera[1].half_angle_tangent=0.3"
    )
    assert made.tables.camera[1].count == 5
    assert made.tables.camera[1].fov_y is None
    assert config(BASE, "volume.path=a.mhd").tables.volume.builtin is None
    assert "index from 0 to 1" in refusal(BASE + "[[camera]]\n[[camera]]\n", "camera.2.width=4")


def test_a_missing_volume_says_what_it_is_and_where_it_was_searched(tmp_path, monkeypatch):
    monkeypatch.setenv("JVR_DATA", str(tmp_path / "elsewhere"))
    text = BASE.replace('builtin = "demo"', 'path = "head/head.mhd"\nsource = "the head of Example, example.org/head"')
    line = refusal(text)
    assert "volume.path" in line
    assert "the head of Example, example.org/head" in line
    assert str(tmp_path / "elsewhere") in line


def test_paths_are_searched_beside_the_configuration_then_in_the_data_folder(tmp_path, monkeypatch):
    data, beside = tmp_path / "data", tmp_path / "configs"
    for folder, value in ((data, 1.0), (beside, 2.0)):
        folder.mkdir()
        np.save(folder / "both.npy", np.full((3, 3, 3), value, np.float32))
    np.save(data / "one.npy", np.full((3, 3, 3), 3.0, np.float32))
    monkeypatch.setenv("JVR_DATA", str(data))
    file = beside / "scene.toml"
    file.write_text(
        '[volume]\npath = "both.npy"\n'
        + LINEAR.replace("transfer={", "[transfer]\n")
        .replace("}", "")
        .replace(",pos", "\npos")
        .replace(",rgb", "\nrgb")
        .replace(",sig", "\nsig")
    )
    assert float(build_scene(read_config(file)).volume.values[0, 0, 0]) == 2.0
    assert float(build_scene(read_config(file, ["volume.path=one.npy"])).volume.values[0, 0, 0]) == 3.0
    np.save(tmp_path / "one.npy", np.full((3, 3, 3), 4.0, np.float32))
    monkeypatch.chdir(tmp_path)
    assert float(build_scene(read_config(file, ["volume.path=one.npy"])).volume.values[0, 0, 0]) == 4.0


def test_damaged_and_missing_files_are_one_line(tmp_path):
    (tmp_path / "bad.toml").write_text("[volume\n")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    for name, hint in (
        ("bad.toml", "not valid TOML"),
        ("binary.toml", "not valid TOML"),
        ("bda.toml", "did you mean 'bad.toml'?"),
    ):
        with pytest.raises(ConfigError, match=hint.replace("?", r"\?")) as caught:
            read_config(tmp_path / name)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("path", sorted(CONFIGS.rglob("*.toml")), ids=lambda p: p.stem)
def test_every_shipped_configuration_is_valid(path):
    made = read_config(path)
    assert made.tables.volume.builtin or made.tables.volume.source


def test_the_ct_head_protocol(data, monkeypatch):
    monkeypatch.setenv("JVR_DATA", str(data))
    made = read_config(CONFIGS / "real" / "ct_head.toml")
    scene, cameras, settings = build(made)
    volume, table = scene.volume, scene.transfer
    assert (float(volume.values.min()), float(volume.values.max())) == (0.0, 1.0)
    assert settings.step * float(volume.spacing.min()) == pytest.approx(1.0)
    assert len(cameras) == 8
    distances = [np.linalg.norm(c.world_from_camera[:3, 3] - volume.center) for c in cameras]
    np.testing.assert_allclose(distances, 450, rtol=1e-5)
    assert np.tan(np.radians(float(cameras[0].fov_y) / 2)) == pytest.approx(0.3, rel=1e-5)
    s = np.linspace(0, 1, 256)
    expected = 0.02 * np.exp(-0.5 * ((s - 0.4) / 0.05) ** 2) + 0.5 * np.clip((s - 0.47) / 0.1, 0, 1)
    np.testing.assert_allclose(table.sigma_t, expected, atol=1e-6)
    assert table.rgb.shape == (256, 3)


@pytest.mark.parametrize(
    ("kind", "width", "height"), [("perspective", 64, 48), ("perspective", 40, 64), ("orthographic", 64, 64)]
)
def test_an_automatic_camera_shows_the_whole_volume_and_little_more(kind, width, height):
    scene, (camera,), _ = build(config(BASE, f"camera={{kind='{kind}',width={width},height={height}}}"))
    rays, _ = enter(scene, *camera.rays(jnp.arange(width * height)))
    hit = np.asarray(rays.length > 0).reshape(height, width)
    assert not np.concatenate([hit[0], hit[-1], hit[:, 0], hit[:, -1]]).any()
    assert max(np.mean(hit.any(axis=0)), np.mean(hit.any(axis=1))) > 0.75


def test_a_pinhole_camera_of_a_configuration():
    keys = "kind='pinhole',focal_lengths=[80,90],principal_point=[30,20],width=60,height=48"
    _, (camera,), _ = build(config(BASE, f"camera={{{keys},eye=[0,-200,5],target=[1,2,3]}}"))
    pose = jvr.PerspectiveCamera.look_at((0, -200, 5), (1, 2, 3), (0, 0, 1), 30, 60, 48).world_from_camera
    expected = jvr.PinholeCamera(pose, (80, 90), 60, 48, principal_point=(30, 20))
    for ours, theirs in zip(camera.rays(jnp.arange(60 * 48)), expected.rays(jnp.arange(60 * 48)), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)
    with pytest.raises(ConfigError, match="camera: eye is missing"):
        build(config(BASE, f"camera={{{keys}}}"))


def test_scaling_maps_a_range_to_the_unit_interval():
    volume = build_scene(config(BASE, "volume.scale=[0.2, 0.6]")).volume
    before = build_scene(config(BASE)).volume
    np.testing.assert_allclose(volume.values, np.clip((np.asarray(before.values) - 0.2) / 0.4, 0, 1), atol=1e-6)


def test_settings_become_objects():
    made = build_settings(config(BASE, "settings.quadrature=pre-integrated", "settings.skipping=false", "settings.step=2"))
    assert made == jvr.Settings(2.0, quadrature=jvr.PreIntegrated(), skipping=False)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("'uniform'", jvr.Uniform()),
        ("'refinement'", jvr.Refinement()),
        ("{kind='refinement', tolerance=0.02, tile=16}", jvr.Refinement(0.02, tile=16)),
        ("'slices'", jvr.Slices()),
        ("{kind='slices', oracle='brick-range', tolerance=0.02, levels=2}", jvr.Slices(jvr.BrickRange(0.02), levels=2)),
        ("{kind='slices', tolerance=0.02}", jvr.Slices(jvr.LocalError(0.02))),
        ("{kind='slices', oracle={kind='brick-range', tolerance=0.02}}", jvr.Slices(jvr.BrickRange(0.02))),
        ("{kind='slices', oracle='finest'}", jvr.Slices(jvr.Finest())),
        ("{kind='slices', oracle='finest', tolerance=0.02}", jvr.Slices(jvr.Finest())),
        (
            "{kind='slices', oracle={kind='pixel-size', pixels=3, oracle={kind='opacity-change', tolerance=0.02}}}",
            jvr.Slices(jvr.PixelSize(jvr.OpacityChange(0.02), pixels=3)),
        ),
        (
            "{kind='slices', oracle={kind='given', distances=[[[0, 1.5], [inf, 2]]], brick=8}}",
            jvr.Slices(jvr.GivenDistances([[[0, 1.5], [np.inf, 2]]], brick=8)),
        ),
    ],
)
def test_a_sampling_is_a_name_or_a_table(text, wanted):
    settings = build_settings(config(BASE, f"settings.sampling={text}"))
    assert settings == jvr.Settings(sampling=wanted)
    # What a report says of settings are settings again.
    assert build_settings(config_from({"settings": choices_of(settings)} | tomllib.loads(BASE), "again")) == settings


class Fisheye(AbstractCamera):
    """A camera of somebody's own: the angle from its axis is in proportion to the distance from the middle of the picture."""

    world_from_camera: Affine = parameter(doc="rigid transform")
    angle: Scalar = parameter(ANGLE_OF_VIEW, doc="of the picture's height", unit="degrees")
    width: int = choice(AT_LEAST_ONE, doc="pixels")
    height: int = choice(AT_LEAST_ONE, doc="pixels")
    remainder: Remainder = parameter(doc="of the pose")

    def __init__(self, world_from_camera, angle=170.0, width=8, height=8):
        self.world_from_camera, self.remainder = world_from_camera, Remainder.left(world_from_camera, world_from_camera, None)
        assign(self, angle=angle, width=width, height=height)

    def rays_ahead(self, pixels, ahead):
        raise NotImplementedError


class Thrifty(AbstractQuadrature):
    """A quadrature of somebody's own."""

    weight: float = choice(UNIT_INTERVAL, doc="of the middle")

    def __init__(self, weight=0.5):
        assign(self, weight=weight)

    @property
    def explanation(self):
        return ""

    def integrates(self, transfer):
        return True


@pytest.fixture
def registered():
    known = dict(PARTS), {family: dict(names) for family, names in KINDS.items()}
    jvr.register("fisheye", Fisheye)
    jvr.register("thrifty", Thrifty)
    yield
    for here, before in zip((PARTS, KINDS), known, strict=True):
        here.clear()
        here.update(before)


def test_cameras_and_settings_take_classes_of_ones_own(registered):
    made = config(BASE, "camera={kind='fisheye',eye=[9,8,700],angle=90}", "settings.quadrature={kind='thrifty',weight=0.25}")
    _, (camera,), settings = build(made)
    assert isinstance(camera, Fisheye)
    assert float(camera.angle) == 90
    np.testing.assert_allclose(camera.world_from_camera[:3, 3], [9, 8, 700])
    assert settings == jvr.Settings(quadrature=Thrifty(0.25))
    assert "camera.angle: must be between 0 and 180, without either (of the picture's height, in degrees), not 180" in refusal(
        BASE, "camera={kind='fisheye',angle=180}"
    )
    assert "camera: eye is missing: from where a Fisheye shows the whole volume is not known" in refusal(BASE, "camera=fisheye")
    assert "settings.quadrature.weight: must be in [0, 1]" in refusal(BASE, "settings.quadrature={kind='thrifty',weight=2}")


def test_names_become_objects():
    made = config(
        BASE + "[truth]\nkind = 'window'\n[fit]\n",
        "settings.adjoint=rows",
        "volume.interpolation=nearest",
        "camera.width=8",
        "camera.height=8",
        "fit.unknowns=['transfer.sigma_t']",
        "fit.loss=huber",
        "fit.priors={sparsity=0.1}",
        "fit.solver=dogleg",
    )
    job = build_fit(made)
    assert isinstance(job.keywords["settings"].adjoint, jvr.Rows)
    assert isinstance(job.scene.volume.interpolation, jvr.Nearest)
    assert job.keywords["loss"] == jvr.Huber(0.05)
    assert job.keywords["priors"] == (jvr.Sparsity(0.1),)
    assert job.keywords["unknowns"](job.scene)[0] is job.scene.transfer.sigma_t
    assert len(job.targets) == 1


@pytest.mark.slow
@pytest.mark.parametrize(("name", "hint"), [("transfer.sigma", "did you mean 'transfer.sigma_t'?"), ("light", "known:")])
def test_an_unknown_that_is_none_is_refused(name, hint):
    with pytest.raises(ConfigError, match=r"fit\.unknowns") as caught:
        build_fit(config(BASE + f"[truth]\nkind = 'window'\n[fit]\nunknowns = ['{name}']\n"))
    assert hint in str(caught.value)


@pytest.mark.slow
def test_held_out_views_are_new_views():
    text = BASE + "[truth]\nkind='window'\n[camera]\nkind='fibonacci'\ncount=4\nwidth=6\nheight=6\n"
    job = build_fit(config(text + "[fit]\nheld_out=3\n"))
    assert job.held_out is not None
    assert (len(job.cameras), len(job.held_out[0])) == (4, 3)
    eyes = [np.asarray(c.world_from_camera)[:3, 3] for c in (*job.cameras, *job.held_out[0])]
    gaps = [np.linalg.norm(a - b) for i, a in enumerate(eyes) for b in eyes[:i]]
    assert min(gaps) > 0.1 * np.linalg.norm(eyes[0])
    chosen = build_fit(config(text + "[fit]\nheld_out=[1]\n"))
    assert chosen.held_out is not None
    assert (len(chosen.cameras), len(chosen.held_out[0])) == (3, 1)


def random_transfers():
    rng = np.random.default_rng(0)
    exact = lambda *shape: rng.random(shape, np.float32) * np.float32(10.0) ** rng.integers(-8, 8, shape).astype(np.float32)
    grey, coloured = exact(40), exact(40, 3)
    colours = lambda n: np.minimum(exact(n, 3), 100)
    positions = np.unique(exact(60))[:40]
    yield jvr.LinearTransfer(positions, colours(40), grey)
    yield jvr.LutTransfer(colours(40), coloured, [-1024.7, 3071.3])
    yield jvr.GaussianTransfer(exact(5), exact(5) + np.float32(1e-9), exact(5, 3), colours(5))


@pytest.mark.parametrize("transfer", list(random_transfers()), ids=lambda t: type(t).__name__)
def test_a_transfer_function_survives_a_file_bit_by_bit(transfer, tmp_path):
    write_transfer(tmp_path / "t.toml", transfer)
    found = read_transfer(tmp_path / "t.toml")
    assert jax.tree.structure(found) == jax.tree.structure(transfer)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(transfer), strict=True):
        assert a.dtype == b.dtype
        assert jnp.array_equal(a, b)
    assert [p.name for p in tmp_path.iterdir()] == ["t.toml"]


def test_a_configuration_can_name_a_transfer_file(tmp_path):
    transfer = jvr.LinearTransfer([0.0, 0.5], [[0, 0, 0], [1, 0.5, 0.1]], [0.0, 0.3])
    write_transfer(tmp_path / "t.toml", transfer)
    made = config(BASE, f"transfer={{kind='file',path='{tmp_path / 't.toml'}'}}")
    assert jnp.array_equal(build_scene(made).transfer.rgb, transfer.rgb)


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        (
            "kind = 'linear'\npositions = [0, 1]\nrgb = [[1,1,1],[1,1,1]]\nsigma = [1, 1]",
            "sigma: unknown key; did you mean 'sigma_t'?",
        ),
        ("kind = 'window'", "needs window, level and sigma_t"),
        ("kind = 'file'\npath = 'x'", "cannot name another file"),
        ("kind =", "not valid TOML"),
    ],
)
def test_a_transfer_file_that_is_wrong_is_one_line(text, hint, tmp_path):
    (tmp_path / "t.toml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_transfer(tmp_path / "t.toml")
    assert str(caught.value).startswith(str(tmp_path / "t.toml"))
    assert hint in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a = " + "9" * 5000, "not valid TOML"),
        ("a = " + "[" * 5000, "not valid TOML"),
        (f"[settings]\nstep = {10**400}", "finite number"),
        ("[camera]\nwidth = 0x" + "f" * 5000, "camera.width.*whole number from 1 to 65536.*thousands of digits"),
        ("[camera]\nwidth = 99999999999", "whole number from 1 to 65536"),
        (BASE.replace('builtin = "demo"', "path = '~no-such-user/a.nii'"), "does not exist|is not in"),
    ],
    ids=["digits", "brackets", "float", "hexadecimal", "pixels", "home"],
)
def test_numbers_and_nesting_without_bound(tmp_path, text, said):
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(ConfigError, match=said) as caught:
        build_scene(read_config(tmp_path / "a.toml"))
    assert "\n" not in str(caught.value)
