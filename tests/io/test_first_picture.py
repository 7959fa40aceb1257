"""The first picture of a volume that nobody has said anything about."""

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import jvr
from jvr.cli.first import Wishes, configured
from jvr.cli.inputs import BadInput
from jvr.io.animation import write_animation
from jvr.io.config import build_cameras, build_scene, config_from
from jvr.io.first_picture import first_picture, what_is_seen

N = 24


def ball(inside: float, outside: float, radius: float = 0.6, noise: float = 0.0) -> np.ndarray:
    x = np.linspace(-1, 1, N)
    r = np.sqrt(sum(np.square(c) for c in np.meshgrid(x, x, x, indexing="ij")))
    return np.where(r < radius, inside, outside) + noise * np.random.default_rng(0).normal(size=r.shape)


def ct() -> np.ndarray:
    body = ball(40.0, -1000.0, noise=8.0)
    body[10:14, 10:14] = 600
    return body.astype(np.int16)


@pytest.mark.parametrize(
    ("volume", "kind", "why"),
    [
        (lambda: jvr.Volume(ct()), "ct", "look like Hounsfield units"),
        (lambda: jvr.Volume(ball(5.0, 0.0, noise=0.1), unit="HU"), "ct", "the unit is HU"),
        (lambda: jvr.Volume((ball(1.0, 0.0) + 2 * (ball(1.0, 0.0, 0.3) > 0)).astype(np.uint8)), "labels", "whole numbers"),
        (lambda: jvr.Volume(np.abs(ball(200.0, 10.0, noise=9.0)).astype(np.uint8)), "scan", "without a unit"),
        (lambda: jvr.Volume(ball(1e-12, 0.0, noise=1e-14)), "scan", "without a unit"),
        # From -1000 to 1000 like a CT, but nothing is air and nothing is water.
        (lambda: jvr.Volume(np.linspace(-500, 1000, N**3).reshape((N,) * 3)), "scan", "without a unit"),
    ],
)
def test_what_a_volume_holds_decides(volume, kind, why, tmp_path):
    tables, notes = first_picture(volume(), tmp_path / "a.nii")
    assert tables["transfer"] == {"kind": "preset", "preset": kind}
    assert len(notes) == 1
    assert why in notes[0]
    assert "--preset" in notes[0]
    assert ("interpolation" in tables.get("volume", {})) == (kind == "labels")


def test_what_is_up_is_said_where_a_file_does_not(tmp_path):
    volume = jvr.Volume(ct())
    assert "z is taken for it" in first_picture(volume, tmp_path / "a.npy").notes[-1]
    assert first_picture(volume, tmp_path / "a.nrrd", "ct").notes == []


def test_unlit_pictures_have_no_light(tmp_path):
    assert "lights" not in first_picture(jvr.Volume(ct()), tmp_path / "a.nii", lit=False).tables


@pytest.mark.parametrize(("low", "high", "says"), [(2000, 3000, "shows nothing"), (-5000, 5000, "shows everything")])
def test_a_transfer_function_that_shows_nothing_or_everything_says_so(low, high, says):
    transfer = jvr.LinearTransfer([low, high], [[1.0, 1.0, 1.0]] * 2, [0.0, 1.0])
    note = what_is_seen(jvr.Volume(ct()), transfer)
    assert note is not None
    assert says in note
    # From where the air ends up to the bone.
    first, last = (float(x) for x in note.split("of which ")[1].split(" is not")[0].split(" ... "))
    assert -1000 < first < 0 < last < 700


def test_a_preset_that_fits_says_nothing():
    assert what_is_seen(jvr.Volume(ct()), jvr.presets.ct()) is None


@pytest.mark.slow
def test_pictures_are_framed_on_what_is_visible():
    """A small ball in the corner of a large volume fills the picture; the box would leave it a few pixels."""
    values = np.zeros((4 * N,) * 3, np.float32)
    values[:N, :N, :N] = ball(1.0, 0.0)
    tables = {
        "volume": {"builtin": "demo"},
        "transfer": {"kind": "window", "window": 0.5, "level": 0.5, "sigma_t": 5.0},
        "camera": {"frame": "visible", "width": 32, "height": 32},
    }
    volume = jvr.Volume(values)
    share = []
    for frame in ("visible", "box"):
        tables["camera"]["frame"] = frame
        config = config_from(dict(tables), "test")
        scene = build_scene(config, volume)
        (camera,) = build_cameras(config, volume, scene.transfer)
        share.append(float(np.mean(np.asarray(jvr.render(scene, camera).alpha) > 0.1)))
    # Bricks of four voxels about a ball of seven: a little is left around it.
    assert share[0] > 0.2
    assert share[1] < 0.05


@pytest.mark.parametrize(
    ("view", "axis", "sign", "up"),
    [
        ("front", 1, -1, (0, 0, 1)),
        ("back", 1, 1, (0, 0, 1)),
        ("left", 0, 1, (0, 0, 1)),
        ("right", 0, -1, (0, 0, 1)),
        ("top", 2, 1, (0, -1, 0)),
        ("bottom", 2, -1, (0, -1, 0)),
    ],
)
def test_views_look_from_the_side_that_they_name(view, axis, sign, up):
    """In LPS: x to the patient's left, y to the back, z to the head."""
    tables = {"volume": {"builtin": "demo"}, "transfer": {"kind": "window"}, "camera": {"view": view}}
    volume = jvr.Volume(np.zeros((5, 6, 7), np.float32))
    (camera,) = build_cameras(config_from(tables, "test"), volume)
    matrix = np.asarray(camera.world_from_camera)
    wanted = np.zeros(3)
    wanted[axis] = sign
    away = matrix[:3, 3] - np.asarray(volume.center)
    np.testing.assert_allclose(away / np.linalg.norm(away), wanted, atol=1e-5)
    np.testing.assert_allclose(matrix[:3, 1], up, atol=1e-5)


def test_wishes_become_tables(tmp_path):
    np.save(tmp_path / "a.npy", ct())
    wishes = Wishes(preset="ct_bone", orbit=5, up=[0.0, 1.0, 0.0], background="#ff0000", lit=False)
    config, volume, notes = configured(tmp_path / "a.npy", ["camera.width=20"], {"spacing": [2.0, 2.0, 2.0]}, wishes)
    assert volume is not None
    assert np.allclose(volume.spacing, 2)
    assert config.tables.background == [1.0, 0.0, 0.0]
    cameras = build_cameras(config, volume)
    assert [camera.width for camera in cameras] == [20] * 5
    # All around the axis that was asked for.
    eyes = np.stack([np.asarray(camera.world_from_camera)[:3, 3] for camera in cameras])
    np.testing.assert_allclose(eyes[:, 1], eyes[0, 1], atol=1e-3)
    assert len(notes) == 1


@pytest.mark.parametrize(
    ("wishes", "says"),
    [
        (Wishes(orbit=1), "--orbit 1: must be at least 2"),
        (Wishes(orbit=4, view="top"), "leave --view or --orbit out"),
        (Wishes(background="no such colour"), "--background no such colour: must be a colour"),
        (Wishes(background="0.5"), "--background 0.5: must be a colour"),
        (Wishes(background="#ff000080"), "must be a colour"),
        (Wishes(background="none"), "must be a colour"),
        (Wishes(view="above"), "view"),
        (Wishes(preset="ct_heart"), "preset"),
    ],
)
def test_wishes_that_cannot_be_granted(wishes, says, tmp_path):
    np.save(tmp_path / "a.npy", ct())
    with pytest.raises((BadInput, ValueError), match=says):
        configured(tmp_path / "a.npy", [], {}, wishes)


def test_wishes_are_for_volumes(tmp_path):
    (tmp_path / "a.toml").write_text("[transfer]\nkind = 'window'\n")
    with pytest.raises(BadInput, match="--view is for a volume file"):
        configured(tmp_path / "a.toml", [], {}, Wishes(view="top"))


def test_animations_are_written_whole(tmp_path):
    frames = [np.full((6, 8, 3), level) for level in (0.0, 0.2, 1.0)]
    write_animation(tmp_path / "a.gif", frames, seconds=3.0)
    with Image.open(tmp_path / "a.gif") as picture:
        assert (picture.n_frames, picture.size, picture.info["duration"]) == (3, (8, 6), 1000)
        picture.seek(1)
        np.testing.assert_allclose(np.asarray(picture.convert("RGB"))[0, 0], 255 * float(jvr.srgb_from_linear(0.2)), atol=2)
    assert [path.name for path in tmp_path.iterdir()] == ["a.gif"]


@pytest.mark.parametrize("preset", [jvr.presets.scan, jvr.presets.mr, jvr.presets.micro_ct])
def test_presets_for_a_range(preset):
    transfer = preset(-3.0, 5.0, sigma_t=0.7)
    assert float(transfer.evaluate(jnp.float32(-3.0)).sigma_t[0]) == 0
    np.testing.assert_allclose(float(transfer.evaluate(jnp.float32(5.0)).sigma_t[0]), 0.7, rtol=1e-6)
    with pytest.raises(ValueError, match="low < high"):
        preset(1.0, 1.0, sigma_t=0.7)


def test_labels_have_colours_of_their_own():
    transfer = jvr.presets.labels(20, sigma_t=3.0)
    colours = np.asarray(transfer.rgb)[1:]
    apart = np.linalg.norm(colours[:, None] - colours, axis=-1) + 9 * np.eye(20)
    assert apart.min() > 0.05
    assert np.linalg.norm(np.diff(colours, axis=0), axis=1).min() > 0.4
    assert np.asarray(transfer.sigma_t)[0] == 0
