"""Yardsticks compute what they are measured against."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from benchmarks import accelerator, scenes
from benchmarks.peers.compiled import compiler


@pytest.mark.slow
@pytest.mark.parametrize("transfer", [scenes.translucent(), scenes.opaque()], ids=["translucent", "opaque"])
def test_the_march_by_hand_is_that_of_jvr(transfer):
    """On the host, where every machine can run it: the same samples, but for those of jvr that a skip ends with in an empty brick. (A
    picture of whole blocks: beyond its border rays are marched again.)"""
    volume = scenes.gyroid(24).bricked()
    try:
        compiler()
    except ImportError as error:
        pytest.skip(str(error))
    scene, camera, settings = jvr.Scene(volume, transfer), scenes.camera(volume, 20), jvr.Settings(0.5, termination=1e-3)
    by_hand, picture = accelerator.HandWritten(scene, camera, settings, device=False), jvr.render(scene, camera, settings)
    samples, ours = by_hand.on_host(), int(picture.stats.samples)
    assert 0.9 * ours < samples <= ours
    np.testing.assert_allclose(by_hand.picture(), picture.rgb, atol=1e-5)
    assert float(picture.rgb.max()) > 0.1
