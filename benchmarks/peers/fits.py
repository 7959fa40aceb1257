"""The fit of the CT head protocol (`experiments/protocols.py`), or of a volume from a formula where the head is absent."""

import dataclasses

import jax
import numpy as np

import jvr
from benchmarks.peers import scenes, shapes
from experiments.protocols import Protocol, ct_head, head_volume

GOAL = 60.0
MOST_STEPS = 100


def version() -> str:
    return jvr.__version__


class Fit:
    """A Levenberg-Marquardt fit of the transfer function to 8 views of `size` x `size`; with `boxed`, of the same object in a box of
    8 times the volume."""

    def __init__(self, size: int, boxed: bool = False):
        head = head_volume()
        protocol = ct_head(size=size, volume=head or _phantom())
        assert protocol is not None
        self.data = "CT of a head" if head else "phantom"
        self.protocol = _boxed(protocol) if boxed else protocol
        self.max_steps, self.found = MOST_STEPS, {}

    def run(self) -> None:
        """Fits, the first time to the end, from then on for as many steps as it took to 60 dB."""
        protocol = self.protocol
        unknowns = lambda s: (s.transfer.rgb, s.transfer.sigma_t)
        self.result = jvr.fit(
            protocol.start,
            protocol.cameras,
            protocol.images,
            settings=protocol.settings,
            unknowns=unknowns,
            max_steps=self.max_steps,
            progress=False,
        )
        if not self.found:
            self.max_steps, self.found = self._steps_to_goal(), self._outcome()

    def seconds_to_goal(self) -> float:
        """Of the latest run, until 60 dB."""
        return self.result.history[self._steps_to_goal() - 1].seconds

    def outcome(self) -> dict:
        """Of the run to the end."""
        return self.found

    def _steps_to_goal(self) -> int:
        history = self.result.history
        if all(entry.psnr < GOAL for entry in history):
            raise RuntimeError(f"the fit ended at {history[-1].psnr:.1f} dB, below {GOAL:g}")
        return next(entry.step for entry in history if entry.psnr >= GOAL)

    def _outcome(self) -> dict:
        history = self.result.history
        return {
            "data": self.data,
            "psnr": history[-1].psnr,
            "iterations": len(history),
            "iterations_to_60_db": self._steps_to_goal(),
        }

    def views(self) -> tuple[list[scenes.Scene], list[np.ndarray], float]:
        """The start seen by each camera, the pictures to fit, and the step, for other renderers."""
        protocol = self.protocol
        return [_plain(protocol.start, camera) for camera in protocol.cameras], protocol.images, protocol.settings.step


def _phantom() -> jvr.Volume:
    """Scaled as the head is: skin near 0.4, bone above 0.47."""
    voxels, _ = shapes.phantom(64)
    return jvr.Volume(np.clip((voxels.astype(np.float32) + 1000) / 2500, 0, 1), np.diag([3.2, 3.2, 3.2, 1.0]))


def _boxed(protocol: Protocol) -> Protocol:
    """The cameras stay; the pictures are rendered anew, since at the faces of the small box the object was cut."""
    inner = _plain(protocol.start, protocol.cameras[0])
    outer = scenes.boxed(inner)
    world_from_grid = np.diag([*outer.spacing, 1.0])
    world_from_grid[:3, 3] = outer.origin
    volume = jvr.Volume(outer.voxels, world_from_grid)
    put = lambda scene: dataclasses.replace(scene, volume=volume)
    render = jax.jit(jvr.render)
    images = [np.asarray(render(put(protocol.truth), camera, protocol.settings).rgb) for camera in protocol.cameras]
    return dataclasses.replace(protocol, truth=put(protocol.truth), start=put(protocol.start), images=images)


def _plain(scene: jvr.Scene, camera: jvr.PerspectiveCamera) -> scenes.Scene:
    """A scene of `jvr` as plain arrays. The volume's axes must be the world's."""
    affine, pose = np.asarray(scene.volume.world_from_grid, float), np.asarray(camera.world_from_camera, float)
    spacing = np.diag(affine)[:3]
    assert np.array_equal(affine[:3, :3], np.diag(spacing))
    assert isinstance(scene.transfer, jvr.LutTransfer)
    low, high = np.asarray(scene.transfer.domain, float)
    eye, back, up = pose[:3, 3], pose[:3, 2], pose[:3, 1]
    view = scenes.View(tuple(eye), tuple(eye - back), tuple(up), float(camera.fov_y), camera.width, camera.height)
    rgb, sigma_t = np.asarray(scene.transfer.rgb), np.asarray(scene.transfer.sigma_t)
    voxels = np.asarray(scene.volume.values)
    return scenes.Scene("fit", "", voxels, tuple(spacing), tuple(affine[:3, 3]), rgb, sigma_t, (low, high), view)
