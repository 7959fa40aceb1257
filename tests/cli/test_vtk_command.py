"""Screenshots of VTK become a transfer function, and that a preset, by the commands of the documentation."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from jvr import cli
from jvr.io.config import build_scene, read_config

CONFIG = Path(__file__).parents[2] / "configs" / "vtk.toml"


@pytest.mark.slow
def test_screenshots_of_vtk_become_a_preset(tmp_path, monkeypatch):
    """In few steps of four times the length: the view that is kept aside at 45 dB, from 30 after the first step from a rough preset."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JVR_CACHE", "0")
    assert cli.run(f"fit {CONFIG} -o out --set settings.step=2 --set fit.max_steps=8".split()) == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert result["history"][0]["psnr"] < 35
    assert min(result["held_out"]["psnr"]) > 45
    assert cli.run(["preset", "out/transfer.toml", "-o", "found.vp.json"]) == 0
    fitted = tomllib.loads((tmp_path / "out" / "transfer.toml").read_text(encoding="utf-8"))
    back = build_scene(read_config(CONFIG, [f"transfer.path={tmp_path / 'found.vp.json'}"])).transfer
    for name in ("rgb", "sigma_t"):
        np.testing.assert_allclose(getattr(back, name), fitted[name], rtol=1e-3, atol=1e-5, err_msg=name)
