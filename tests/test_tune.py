"""`jvr tune`: settings that meet a target on a scene, written into a copy of a configuration."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from scenes import OBLIQUE, lut_transfer, perspective, voxels
from typer.testing import CliRunner

import jvr
from jvr.cli.app import app
from jvr.cli.inputs import BadInput
from jvr.cli.tune import with_settings
from jvr.rendering import tune

CHOSEN = jvr.Settings(2.0, termination=0.01, quadrature=jvr.PreIntegrated())
KEYS = {"step": 2.0, "termination": 0.01, "quadrature": "pre-integrated"}
VOLUME = jvr.Volume(voxels(), OBLIQUE)
SCENE = jvr.Scene(VOLUME, lut_transfer(scale=0.3))
CAMERA = perspective(VOLUME, 17, 12)


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    monkeypatch.setattr(tune, "STEPS", (2.0, 0.5))


@pytest.mark.parametrize(
    "text",
    [
        "[volume]\nbuiltin = 'demo'\n",
        "[settings]\nstep = 0.5  # fine\ntile = 100\n[volume]\nbuiltin = 'demo'\n",
        "a = 1\n[settings] # how\n[settings_not]\nstep = 3",
        "[volume]\n[settings]\n\n# kept\ntermination=0\nquadrature = 'midpoint'",
    ],
)
def test_only_the_settings_change(text):
    before, after = tomllib.loads(text), tomllib.loads(with_settings(text, CHOSEN))
    assert after.pop("settings") == before.pop("settings", {}) | KEYS
    assert after == before
    assert ("# kept" in text) == ("# kept" in with_settings(text, CHOSEN))


def test_inline_settings_are_refused():
    with pytest.raises(ValueError, match="write them as a table"):
        with_settings("settings = { step = 1.0 }", CHOSEN)


@pytest.mark.slow
def test_cheapest_that_meets_an_error():
    """It does on the smaller picture, and on the whole one."""
    found = tune.tune(SCENE, CAMERA, error=5e-3)
    assert found.met
    assert found.measured.rmse <= 5e-3
    assert len(found.candidates) == 4
    assert found.predicted in [m for m in found.candidates if m.rmse <= 5e-3]
    image = jvr.render(SCENE, CAMERA, found.settings).rgb
    fine = jvr.render(SCENE, CAMERA, jvr.Settings(0.05, termination=0.0)).rgb
    assert np.sqrt(np.mean(np.square(image - fine))) == pytest.approx(found.measured.rmse, rel=0.2)


@pytest.mark.slow
def test_what_cannot_be_met_is_said(monkeypatch):
    monkeypatch.setattr(tune, "STEPS", (2.0,))
    assert not tune.tune(SCENE, CAMERA, seconds=1e-9).met


def test_one_target_is_asked_for():
    for wrong in ({}, {"error": 1e-3, "seconds": 1.0}, {"error": 0.0}, {"seconds": -1.0}):
        with pytest.raises(ValueError, match="either an error"):
            tune.tune(SCENE, CAMERA, **wrong)


@pytest.mark.slow
def test_command(tmp_path, monkeypatch):
    monkeypatch.setenv("JVR_CACHE", "0")
    monkeypatch.setattr(tune, "STEPS", (2.0,))
    given, output = Path(__file__).parents[1] / "configs" / "demo.toml", tmp_path / "tuned.toml"
    command = ["tune", str(given), "-o", str(output), "--set", "camera.width=20", "--set", "camera.height=16"]
    run = lambda *flags: CliRunner().invoke(app, [*command, *flags], catch_exceptions=False)
    with pytest.raises(BadInput, match=r"--time 1e-09 is out of reach on this scene: the least"):
        run("--time", "1e-9")
    for flags in ([], ["--error", "1e-3", "--time", "1"], ["--error", "0"]):
        with pytest.raises(BadInput, match=r"give either|must be a positive"):
            run(*flags)
    assert not list(tmp_path.iterdir())
    result = run("--time", "100")
    assert result.exit_code == 0
    assert "predicted:" in result.output
    assert "measured:" in result.output
    tables = tomllib.loads(output.read_text(encoding="utf-8"))
    assert tables["settings"]["step"] == 2.0
    assert tables["fit"] == tomllib.loads(given.read_text(encoding="utf-8"))["fit"]
