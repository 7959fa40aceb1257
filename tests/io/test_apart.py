"""Decoders in a process of their own: whatever becomes of it is one line about the file."""

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import tifffile

from jvr.io.volumes import VolumeError, apart, read_volume


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)", "crashed or took too long .status -11"),
        ("print('abc', end='')", "crashed or took too long .status 0"),
        ("import sys\nsys.exit('the third\\nchunk is odd')", "not supported: the third chunk is odd"),
        ("import time\ntime.sleep(60)", "crashed or took too long .status -9"),
    ],
    ids=["signal", "short", "message", "hangs"],
)
def test_a_decoder_that_fails(tmp_path, monkeypatch, script, said):
    (tmp_path / "decode.py").write_text(script)
    monkeypatch.setattr(apart, "SCRIPT", tmp_path / "decode.py")
    if "sleep" in script:
        monkeypatch.setattr(apart, "PATIENCE", 0.1)
    with pytest.raises(VolumeError, match=said) as caught:
        apart.decoded(Path("a.zarr"), {"kind": "zarr"}, 8)
    assert re.fullmatch(r"a\.zarr: its compressed data are damaged [^\n]*; copy or export it again", str(caught.value))


def test_what_a_decoder_says(tmp_path, monkeypatch):
    (tmp_path / "decode.py").write_text(
        "import sys\nsys.stdin.buffer.readline()\nsys.stdout.buffer.write(sys.stdin.buffer.read()[::-1])"
    )
    monkeypatch.setattr(apart, "SCRIPT", tmp_path / "decode.py")
    found = apart.decoded(Path("a"), {}, 1 << 20, [bytes(1 << 19), bytes([7]) * (1 << 19)])
    np.testing.assert_array_equal(found, np.repeat(np.array([7, 0], np.uint8), 1 << 19))


def test_lzw_pages_of_a_tiff_are_decoded_apart(tmp_path, monkeypatch):
    tifffile.imwrite(tmp_path / "a.tif", np.arange(60, dtype="u2").reshape(3, 4, 5), compression="lzw", photometric="minisblack")
    assert read_volume(tmp_path / "a.tif", spacing=1).shape == (5, 4, 3)
    (tmp_path / "decode.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)")
    monkeypatch.setattr(apart, "SCRIPT", tmp_path / "decode.py")
    with pytest.raises(VolumeError, match="status -11"):
        read_volume(tmp_path / "a.tif", spacing=1)


def test_lzw_slices_are_decoded_in_one_process(tmp_path, monkeypatch):
    voxels = np.random.default_rng(0).integers(0, 60, (7, 5, 4), "u2")
    for k, voxel in enumerate(voxels):
        tifffile.imwrite(tmp_path / f"slice{k}.tif", voxel, compression="lzw", photometric="minisblack")
    started, popen = [], subprocess.Popen
    monkeypatch.setattr(apart.subprocess, "Popen", lambda *a, **b: started.append(popen(*a, **b)) or started[-1])
    volume = read_volume(tmp_path, spacing=1)
    np.testing.assert_array_equal(volume.values, voxels.T)
    assert len(started) == 1
    assert started[0].returncode is not None


def test_a_decoder_goes_on_behind_a_failure(tmp_path, monkeypatch):
    script = (
        "import sys\nwhile line := sys.stdin.readline():\n    assert 'bad' not in line\n    print(end='12345678', flush=True)"
    )
    (tmp_path / "decode.py").write_text(script)
    monkeypatch.setattr(apart, "SCRIPT", tmp_path / "decode.py")
    with apart.Decoder() as decoder:
        for _ in range(3):
            assert decoder(Path("a"), {}, 8).tobytes() == b"12345678"
        with pytest.raises(VolumeError, match="AssertionError"):
            decoder(Path("b"), {"bad": 1}, 8)
        assert decoder(Path("c"), {}, 8).tobytes() == b"12345678"
        decoder._child.kill()
        decoder._child.wait()
        with pytest.raises(VolumeError, match="status -9"):
            decoder(Path("d"), {}, 8)
