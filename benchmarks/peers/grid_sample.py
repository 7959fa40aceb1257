"""PyTorch: the loop over `grid_sample` that a researcher writes in an afternoon, with autograd."""

from collections.abc import Sequence

import numpy as np
import torch  # pyright: ignore[reportMissingImports]

from benchmarks.peers.errors import relative, rmse
from benchmarks.peers.rays import enter
from benchmarks.peers.scenes import Scene
from benchmarks.peers.settings import THREADS

torch.set_num_threads(THREADS)


def version() -> str:
    return torch.__version__


class Renderer:
    """One scene, all rays of the picture that hit the volume at once."""

    def __init__(self, scene: Scene):
        # grid_sample counts the last axis first.
        self.volume = torch.tensor(scene.voxels.astype(np.float32))[None, None]
        self.table = torch.tensor(np.concatenate([scene.rgb, scene.sigma_t[:, None]], axis=1), dtype=torch.float32)
        self.domain, self.spacing = scene.domain, min(scene.spacing)
        self.shape = (scene.view.height, scene.view.width, 3)
        entry, along, length = enter(scene)
        self.hit = torch.tensor(length > 0)
        tensor = lambda x: torch.tensor(x[length > 0], dtype=torch.float32)
        # From grid coordinates 0 ... n-1 to -1 ... 1.
        half = (np.asarray(scene.voxels.shape) - 1) / 2
        self.entry, self.along, self.length = tensor(entry / half - 1), tensor(along / half), tensor(length)

    def prepare(self, step: float) -> None:
        self.dt = step * self.spacing
        self.steps = int(np.ceil(float(self.length.max()) / self.dt))

    def draw(self) -> None:
        with torch.no_grad():
            self.drawn = self.render(self.table)

    def differentiate(self) -> None:
        """The picture, and the gradient of `mean((rgb - 0.5)^2)` in the entries of the transfer function."""
        table = self.table.clone().requires_grad_()
        self.drawn = self.render(table)
        (self.drawn - 0.5).square().mean().backward()
        self.slope = table.grad

    def picture(self) -> np.ndarray:
        return self.drawn.detach().numpy()

    def error(self, reference: np.ndarray) -> float:
        return rmse(self.picture(), reference)

    def gradient_error(self, reference: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
        """Relative errors in the colours and in the extinctions."""
        assert self.slope is not None
        return relative(self.slope[:, :3].numpy(), reference[0]), relative(self.slope[:, 3].numpy(), reference[1])

    def render(self, table: torch.Tensor) -> torch.Tensor:
        """The picture under a table of colours and extinction; rays that miss are black."""
        picture = torch.zeros(self.hit.shape[0], 3)
        return picture.masked_scatter(self.hit[:, None], self._march(table)).reshape(self.shape)

    def _march(self, table: torch.Tensor) -> torch.Tensor:
        low, high = self.domain
        last = table.shape[0] - 1
        radiance, clear = torch.zeros(len(self.length), 3), torch.ones(len(self.length), 1)
        for k in range(self.steps):
            extent = (self.length - k * self.dt).clamp(0, self.dt)[:, None]
            position = self.entry + (k * self.dt + extent / 2) * self.along
            grid = position.flip(-1)[None, None, None]
            s = torch.nn.functional.grid_sample(self.volume, grid, align_corners=True).reshape(-1)
            u = ((s - low) / (high - low) * last).clamp(0, last)
            i = u.floor().clamp(max=last - 1)
            below = i.long()
            sample = torch.lerp(table[below], table[below + 1], (u - i)[:, None])
            alpha = 1 - torch.exp(-sample[:, 3:] * extent)
            radiance = radiance + clear * alpha * sample[:, :3]
            clear = clear * (1 - alpha)
        return radiance


class Views:
    """Several views of one scene, and the pictures to compare with."""

    def __init__(self, scenes: Sequence[Scene], targets: Sequence[np.ndarray], step: float):
        self.views = [Renderer(scene) for scene in scenes]
        self.targets = [torch.tensor(target) for target in targets]
        # One volume serves all views.
        for view in self.views:
            view.volume = self.views[0].volume
            view.prepare(step)

    def gradient_step(self) -> None:
        """What one step of a first-order fit needs: the gradient over all views, one view at a time to bound the memory."""
        table = self.views[0].table.clone().requires_grad_()
        for view, target in zip(self.views, self.targets, strict=True):
            (view.render(table) - target).square().mean().backward()
        self.slope = table.grad
