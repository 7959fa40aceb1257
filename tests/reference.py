"""A slow ray marcher in NumPy and float64, written from the conventions (docs of `jvr.types`, `Settings`, `Volume`) and not from
`jvr.march`: one ray, one segment, one voxel corner after the other. It never ends a ray early."""

import math

import numpy as np

import jvr


def camera_rays(camera):
    """Origin and unit direction of every pixel, row by row from the top left: two arrays `(height, width, 3)`."""
    pose = np.asarray(camera.world_from_camera, np.float64)
    width, height = camera.width, camera.height
    origins, directions = np.zeros((height, width, 3)), np.zeros((height, width, 3))
    for row in range(height):
        for column in range(width):
            # -1 ... 1 across the picture; y points up, rows count downwards.
            x = (2 * (column + 0.5) / width - 1) * width / height
            y = 1 - 2 * (row + 0.5) / height
            if isinstance(camera, jvr.PerspectiveCamera):
                half = math.tan(math.radians(float(camera.fov_y)) / 2)
                eye, ray = np.zeros(3), np.array([x * half, y * half, -1.0])
            else:
                half = float(camera.height_world) / 2
                eye, ray = np.array([x * half, y * half, 0.0]), np.array([0.0, 0.0, -1.0])
            origins[row, column] = pose[:3, :3] @ eye + pose[:3, 3]
            directions[row, column] = pose[:3, :3] @ ray / np.linalg.norm(ray)
    return origins, directions


def _slabs(origin, direction, lower, upper):
    """Largest entry and smallest exit distance of a ray and a box."""
    near, far = -math.inf, math.inf
    for o, d, a, b in zip(origin, direction, lower, upper, strict=True):
        if d == 0:
            if not a <= o <= b:
                return math.inf, -math.inf
            continue
        near, far = max(near, min((a - o) / d, (b - o) / d)), min(far, max((a - o) / d, (b - o) / d))
    return near, far


def _value(volume, p):
    """The scalar at grid position `p`."""
    voxels = np.asarray(volume.values, np.float64)
    if isinstance(volume.interpolation, jvr.Nearest):
        v = voxels[tuple(min(max(round(x), 0), n - 1) for x, n in zip(p, voxels.shape, strict=True))]
    else:
        v = 0.0
        cells = [0 if n == 1 else min(max(math.floor(x), 0), n - 2) for x, n in zip(p, voxels.shape, strict=True)]
        for corner in np.ndindex(2, 2, 2):
            weight, index = 1.0, []
            for x, n, cell, bit in zip(p, voxels.shape, cells, corner, strict=True):
                if n == 1:
                    weight *= 1.0 - bit
                    index.append(0)
                else:
                    weight *= x - cell if bit else 1 - (x - cell)
                    index.append(cell + bit)
            v += weight * voxels[tuple(index)]
    return float(volume.slope) * v + float(volume.intercept)


def classify(transfer, s):
    """Colour `(3,)` and extinction `(3,)` at a scalar."""
    rgb = np.asarray(transfer.rgb, np.float64)
    if isinstance(transfer, jvr.GaussianTransfer):
        center, width = np.asarray(transfer.center, np.float64), np.asarray(transfer.width, np.float64)
        height = np.asarray(transfer.height, np.float64)
        height = np.stack([height] * 3, 1) if height.ndim == 1 else height
        each = height * np.exp(-((s - center) ** 2) / (2 * width**2))[:, None]
        weight = each.mean(1)
        return weight @ rgb / weight.sum(), each.sum(0)
    if isinstance(transfer, jvr.LutTransfer):
        positions = np.linspace(*np.asarray(transfer.domain, np.float64), len(rgb))
    else:
        positions = np.asarray(transfer.positions, np.float64)
    sigma = np.asarray(transfer.sigma_t, np.float64)
    sigma = np.stack([sigma] * 3, 1) if sigma.ndim == 1 else sigma
    return tuple(np.array([np.interp(s, positions, table[:, c]) for c in range(3)]) for table in (rgb, sigma))


def march(scene, origin, direction, step):
    """Radiance `(3,)` without background, transmittance `(3,)` and the sum of `T (1 - exp(-dtau)) t` of one ray."""
    volume = scene.volume
    grid_from_world = np.linalg.inv(np.asarray(volume.world_from_grid, np.float64))
    lower = [0.0 if n > 1 else -0.5 for n in volume.values.shape]
    upper = [n - 1.0 if n > 1 else 0.5 for n in volume.values.shape]
    near, far = _slabs(
        grid_from_world[:3, :3] @ origin + grid_from_world[:3, 3], grid_from_world[:3, :3] @ direction, lower, upper
    )
    if scene.clipping is not None:
        box = _slabs(origin, direction, np.asarray(scene.clipping.lower, float), np.asarray(scene.clipping.upper, float))
        near, far = max(near, box[0]), min(far, box[1])
    near = max(near, 0.0)
    radiance, tau, depth = np.zeros(3), np.zeros(3), np.zeros(3)
    if far <= near:
        return radiance, np.ones(3), depth.mean()
    dt = step * np.linalg.norm(np.asarray(volume.world_from_grid, np.float64)[:3, :3], axis=0).min()
    for k in range(math.ceil((far - near) / dt)):
        start, end = near + k * dt, min(near + (k + 1) * dt, far)
        t = (start + end) / 2
        p = grid_from_world[:3, :3] @ (origin + t * direction) + grid_from_world[:3, 3]
        rgb, sigma = classify(scene.transfer, _value(volume, p))
        dtau = sigma * (end - start)
        if isinstance(scene.optical, jvr.EmissionOnly):
            radiance += rgb * dtau
            continue
        opacity = np.exp(-tau) * -np.expm1(-dtau)
        if isinstance(scene.optical, jvr.EmissionAbsorption):
            radiance += rgb * opacity
        depth += opacity * t
        tau += dtau
    return radiance, np.exp(-tau), depth.mean()


def render(scene, camera, step):
    """`rgb (h, w, 3)`, `alpha (h, w)` and `depth (h, w)`."""
    origins, directions = camera_rays(camera)
    background = np.zeros(3) if scene.background is None else np.asarray(scene.background, np.float64)
    rgb, alpha, depth = np.zeros(origins.shape), np.zeros(origins.shape[:2]), np.zeros(origins.shape[:2])
    for pixel in np.ndindex(origins.shape[:2]):
        radiance, transmittance, weighted = march(scene, origins[pixel], directions[pixel], step)
        rgb[pixel] = radiance + transmittance * background
        alpha[pixel] = 1 - transmittance.mean()
        depth[pixel] = weighted / alpha[pixel] if alpha[pixel] > 0 else 0.0
    return rgb, alpha, depth
