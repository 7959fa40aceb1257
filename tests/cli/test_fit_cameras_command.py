"""`jvr fit` of cameras, and `jvr render` of what it found."""

import json
import tomllib

import numpy as np
import pytest

from jvr.io.config import build_cameras, build_scene, config_from, read_config
from jvr.io.config.cameras import write_cameras
from jvr.io.config.errors import ConfigError
from jvr.model.camera import OrthographicCamera, PerspectiveCamera, PinholeCamera
from jvr.model.exact import in_double

EYES = ((31.0, -22.0, 7.0), (1000.0, 3.0, 40.0), (0.0, 0.0, 50.0))


def _pose(camera):
    return in_double(camera.world_from_camera, camera.remainder)


def test_cameras_that_were_written_are_read_again(tmp_path):
    given = [PerspectiveCamera.look_at(EYES[0], (1, 2, 3), (0, 0.3, 1), 27.125, 8, 6)]
    given += [OrthographicCamera.look_at(EYES[1], (0, 0, 0), (0, 0, 1), 41.5, 5, 7)]
    given += [PinholeCamera(_pose(PerspectiveCamera.look_at(EYES[2], (0, 1, 0), (0, 1, 0), 30.0, 4, 4)), (9.5, 8.0), 4, 4)]
    write_cameras(tmp_path / "cameras.toml", given)
    tables = {"volume": {"builtin": "demo"}, "transfer": {"kind": "window"}, "camera": "cameras.toml"}
    config = config_from(tables, "config", tmp_path)
    found = build_cameras(config, build_scene(config).volume)
    for one, other in zip(found, given, strict=True):
        assert type(one) is type(other)
        np.testing.assert_allclose(_pose(one), _pose(other), rtol=3e-7, atol=3e-7 * np.abs(_pose(other)).max())
    np.testing.assert_array_equal(found[2].focal_lengths, given[2].focal_lengths)
    assert float(found[1].height_world) == 41.5
    (tmp_path / "other.toml").write_text("[fit]\n")
    with pytest.raises(ConfigError, match="has tables"):
        config_from({**tables, "camera": "other.toml"}, "config", tmp_path)
    with pytest.raises(ConfigError, match="does not exist"):
        config_from({**tables, "camera": "none.toml"}, "config", tmp_path)


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("cameras.focal_lengths", "not an array of a PerspectiveCamera; known: world_from_camera, fov_y"),
        ("cameras[2].fov_y", "the views that do are 0 to 1"),
        ("shared(transfer.rgb)", "is no array of cameras; they are named as"),
    ],
)
def test_names_of_no_camera_are_refused(name, problem):
    from jvr.io.config import build_fit

    small = [f"camera.{i}.{side}=2" for i in range(2) for side in ("width", "height")]
    config = read_config("configs/pose_recovery.toml", [f'fit.unknowns=["{name}"]', "settings.step=16", *small])
    with pytest.raises(ConfigError, match=problem.replace("(", r"\(").replace(")", r"\)")):
        build_fit(config)


@pytest.mark.slow
def test_the_configuration_finds_its_cameras_and_renders_from_there(tmp_path, monkeypatch):
    from typer.testing import CliRunner

    from jvr.cli.app import app

    sizes = [part for i in range(2) for side in ("width", "height") for part in ("--set", f"camera.{i}.{side}=36")]
    starts = [part for i in range(2) for side in ("width", "height") for part in ("--set", f"fit.initial.camera.{i}.{side}=36")]
    folder = tmp_path / "fit"
    done = CliRunner().invoke(app, ["fit", "configs/pose_recovery.toml", "-o", str(folder), *sizes, *starts])
    assert done.exit_code == 0, done.output
    result = json.loads((folder / "result.json").read_text())
    truth = build_cameras(config := read_config("configs/pose_recovery.toml"), build_scene(config).volume)
    np.testing.assert_allclose(result["cameras"], [_pose(camera) for camera in truth], atol=0.02)
    assert set(result["standard_errors"]) == {"cameras[0].world_from_camera", "cameras[1].world_from_camera"}
    assert "<h2>Cameras</h2>" in (folder / "report.html").read_text()
    assert len(tomllib.loads((folder / "cameras.toml").read_text())["camera"]) == 2
    refused = CliRunner().invoke(app, ["next-view", str(folder)])
    assert refused.exit_code != 0
    assert "cameras alone, of which another view says nothing: give it unknowns of the scene" in str(refused.exception)
    picture = tmp_path / "picture.png"
    arguments = ["render", "configs/pose_recovery.toml", "--set", f"camera={folder / 'cameras.toml'}", "-o", str(picture)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert len(list(tmp_path.glob("picture*.png"))) == 2
