"""`jvr tune`: choices that meet a target on a scene, written into a copy of a configuration."""

import dataclasses
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scenes import OBLIQUE, lut_transfer, perspective, voxels
from typer.testing import CliRunner

import jvr
from jvr.cli.app import app
from jvr.cli.inputs import BadInput
from jvr.cli.tune import tables_of, with_tables
from jvr.rendering import settings, tune
from jvr.rendering.foretelling import turned, turns_of

TABLES = {"settings": {"step": 2.0, "termination": 0.01, "quadrature": "pre-integrated"}}
VOLUME = jvr.Volume(voxels(), OBLIQUE)
SCENE = jvr.Scene(VOLUME, lut_transfer(scale=0.3))
CAMERA = perspective(VOLUME, 17, 12)


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    monkeypatch.setattr(settings, "STEPS", (2.0, 0.5))


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
    before, after = tomllib.loads(text), tomllib.loads(with_tables(text, TABLES))
    assert after.pop("settings") == before.pop("settings", {}) | TABLES["settings"]
    assert after == before
    assert ("# kept" in text) == ("# kept" in with_tables(text, TABLES))


def test_inline_settings_are_refused():
    with pytest.raises(ValueError, match="settings: write it as a table"):
        with_tables("settings = { step = 1.0 }", TABLES)


def test_choices_are_written_where_the_scene_says_them():
    """As keys of a table, of a name alone that becomes one, and as another name."""
    choice = {
        "step": 0.5,
        "quadrature": jvr.Midpoint(),
        "shadows.resolution": 1 / 6,
        "normals.estimator": jvr.CentralDifferences(),
        "radiance transfer.exact": False,
    }
    text = 'shadows = "volume"\nnormals = "sobel"\n[settings]\nstep = 2\n[radiance_transfer]\nexact = true\nrays = 5\n'
    after = tomllib.loads(with_tables(text, tables_of(choice)))
    assert after == {
        "shadows": {"kind": "volume", "resolution": pytest.approx(1 / 6)},
        "normals": {"kind": "central"},
        "settings": {"step": 0.5, "quadrature": "midpoint"},
        "radiance_transfer": {"exact": False, "rays": 5},
    }


LIT = jvr.Scene(
    VOLUME,
    lut_transfer(scale=0.3),
    lights=(jvr.DirectionalLight((1.0, -0.3, -0.5)),),
    shading=jvr.Lambert(),
    normals=jvr.SobelDifferences(),
    shadows=jvr.OpacityShadowMap(8, 4),
)


def test_every_knob_is_turned():
    turns = turns_of(LIT, jvr.Settings(), 1e-3)
    names = [turn.name for turn in turns]
    assert names[:4] == ["step", "quadrature", "termination", "negligible"]
    assert set(names[4:]) == {"shadows.texels", "shadows.layers", "normals.estimator"}
    # What bounds the error is not searched for.
    assert turns[2].knob.values == (1e-3,)
    coarsest = {turn.name: turn.knob.values[0] for turn in turns}
    scene, chosen = turned((LIT, jvr.Settings()), turns, coarsest)
    assert (scene.shadows, scene.normals) == (jvr.OpacityShadowMap(4, 2), jvr.AnalyticGradient())
    assert chosen == jvr.Settings(2.0, termination=1e-3, negligible=1e-2)
    with pytest.raises(ValueError, match="negligible"):
        turned((LIT, jvr.Settings()), turns, {"negligible": 1e-2, "quadrature": jvr.PreIntegrated()})


@pytest.mark.slow
def test_errors_are_measured_against_what_is_finer_in_every_knob():
    """The picture that is asked for, drawn once more, is as far from a finer one by the same kind of shadows as was measured."""
    lit = dataclasses.replace(LIT, normals=jvr.AnalyticGradient(), shadows=jvr.ShadowVolume(0.5))
    found = tune.tune(lit, CAMERA, error=6e-3)
    assert found.met
    assert found.measured.rmse <= 6e-3
    assert set(found.turned) == {turn.name for turn in turns_of(lit, jvr.Settings(), 1.0)}
    image = jvr.render(found.scene, CAMERA, found.settings).rgb
    finest = dataclasses.replace(lit, shadows=jvr.ShadowVolume(2.0))
    fine = jvr.render(finest, CAMERA, jvr.Settings(0.1, termination=0.0, skipping=False)).rgb
    # The reference of tune has a sixteenth of the error of the finest step itself.
    assert np.sqrt(np.mean(np.square(image - fine))) == pytest.approx(found.measured.rmse, rel=0.2)


@pytest.mark.slow
def test_cheapest_that_meets_an_error():
    """It does on the whole picture, where nothing that is faster was foretold to."""
    found = tune.tune(SCENE, CAMERA, error=5e-3)
    assert found.met
    assert found.measured.rmse <= 5e-3
    assert found.scene is SCENE
    image = jvr.render(SCENE, CAMERA, found.settings).rgb
    fine = jvr.render(SCENE, CAMERA, jvr.Settings(0.05, termination=0.0)).rgb
    assert np.sqrt(np.mean(np.square(image - fine))) == pytest.approx(found.measured.rmse, rel=0.2)


@pytest.mark.slow
def test_what_cannot_be_met_is_said(monkeypatch):
    monkeypatch.setattr(settings, "STEPS", (2.0,))
    assert not tune.tune(SCENE, CAMERA, seconds=1e-9).met


def test_one_target_is_asked_for():
    for wrong in ({}, {"error": 1e-3, "seconds": 1.0}, {"error": 0.0}, {"seconds": -1.0}):
        with pytest.raises(ValueError, match="either an error"):
            tune.tune(SCENE, CAMERA, **wrong)


@pytest.mark.slow
def test_command(tmp_path, monkeypatch):
    monkeypatch.setenv("JVR_CACHE", "0")
    monkeypatch.setattr(settings, "STEPS", (2.0,))
    given, output = Path(__file__).parents[2] / "configs" / "demo.toml", tmp_path / "tuned.toml"
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


@pytest.mark.slow
def test_a_small_picture_without_an_error_says_nothing_of_a_whole_one():
    """An isosurface of one colour: in the small picture rays meet it at every step, in the whole one not."""
    volume = jvr.Volume(np.random.default_rng(2).random((6, 6, 6)))
    scene = jvr.Scene(volume, surfaces=jvr.Isosurfaces([0.5], np.ones((1, 3))))
    camera = jvr.fibonacci_sphere(np.asarray(volume.center), 20.0, 2, 30.0, 8, 8)[0]
    assert jvr.tune(scene, camera, error=1e-2).predicted.rmse == 0
