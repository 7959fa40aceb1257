"""Groups of views: those that are lit alike are one problem, and a fit sums over all of them."""

import dataclasses
from collections.abc import Callable, Collection, Sequence
from typing import Any

import equinox as eqx

from jvr.fitting.losses import DSSIM
from jvr.fitting.observations import CHUNK, Observations, keep_samples, observe
from jvr.fitting.problem import Problem
from jvr.fitting.targets import Targets
from jvr.fitting.unknowns import ExposedModel, Unknowns
from jvr.model.camera import AbstractCamera
from jvr.model.environment import EnvironmentLight
from jvr.model.light import AbstractLight
from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTable

# Kept samples are given up where they would take more than this many bytes.
KEEP_LIMIT = 2**30
# The lights of each view.
Lights = tuple[tuple[AbstractLight, ...], ...]


class Group(eqx.Module):
    """Views under the same lights. The objective is a sum over groups, in which the first alone counts the priors."""

    problem: Problem
    observations: Observations


def groups_of(
    problem: Problem,
    choose: Callable[[ExposedModel], Unknowns],
    views: tuple[Sequence[AbstractCamera], Targets],
    lights: Lights | None,
    keep: bool | int,
    unknown: Collection[int],
) -> tuple[Group, ...]:
    """The groups of a fit, one without `lights`. `choose`: finds the unknowns in a model; `keep`: as in `jvr.fit`; `unknown`: cameras that
    the fit finds.

    **Raises** `ValueError` for lights that the scene cannot have, or that are unknown, and where no ray meets the volume.
    """
    cameras, (targets, weights) = views
    if lights is None:
        seen = observe(problem.model.scene, cameras, targets, weights, problem.settings, unknown=unknown)
        return (_kept(problem, seen, keep),)
    _check(problem, lights)
    groups, begin, alike = [], 0, _alike(lights)
    # All groups together take as much memory as one would.
    chunk, limit = -(-CHUNK // len(alike)), KEEP_LIMIT if keep is True else keep
    for those in alike:
        model = eqx.tree_at(lambda m: m.scene, problem.model, lit(problem.model.scene, lights[those[0]], those[0]))
        priors = () if groups else problem.priors
        own = Problem(model, choose(model), problem.settings, problem.loss, priors, None, problem.skips)
        among = lambda values, those=those: [values[i] for i in those]
        try:
            seen = observe(model.scene, among(cameras), among(targets), weights and among(weights), own.settings, chunk)
        except ValueError as error:
            raise ValueError(f"views under the lights of view {those[0]}: {error}") from error
        # Blocks of pixels are those of all images.
        seen = eqx.tree_at(lambda o: o.block, seen, seen.block + begin)
        begin = int(seen.block.max()) + 1
        groups.append(_kept(own, seen, keep if keep is False else max(limit // len(alike), 1)))
    return tuple(groups)


def lights_of(lights: Any, cameras: Sequence[AbstractCamera], whose: str = "view") -> Lights | None:
    """The lights of each view as tuples.

    **Raises** `ValueError` where their number is not that of the cameras, `TypeError` for what is no light.
    """
    if lights is None:
        return None
    if isinstance(lights, AbstractLight) or not isinstance(lights, Sequence):
        raise TypeError("lights must be a sequence with the lights of each view, such as [(jvr.PointLight(...),), ...]")
    if len(lights) != len(cameras):
        raise ValueError(
            f"there are lights for {len(lights)} {whose}s and {len(cameras)} cameras: give the lights of each {whose}"
        )
    found = tuple((one,) if isinstance(one, AbstractLight) else tuple(one) for one in lights)
    for i, one in enumerate(found):
        for light in one:
            if not isinstance(light, AbstractLight):
                raise TypeError(f"lights of {whose} {i} must be jvr's lights, such as jvr.PointLight(...), not {light!r:.60}")
    return found


def lit(scene: Scene, lights: Sequence[AbstractLight], view: int) -> Scene:
    """A scene under the lights of a view in place of its own. **Raises** `ValueError` where they do not go together."""
    try:
        return dataclasses.replace(scene, lights=tuple(lights))
    except ValueError as error:
        raise ValueError(f"lights of view {view}: {error}") from error


def _check(problem: Problem, lights: Lights) -> None:
    """Refuses what lights of single views do not go together with."""
    scene = problem.model.scene
    if problem.model.views is not None:
        raise ValueError("cameras are unknown, and lights of single views know where these are: leave one of the two out")
    if problem.unknowns.among(problem.model, lambda m: m.scene.lights):
        raise ValueError("lights of single views are known and take the place of scene.lights: leave these out of the unknowns")
    if isinstance(problem.loss, DSSIM):
        raise ValueError("DSSIM does not know lights of single views: use loss=jvr.AbsoluteError()")
    surrounding = any(isinstance(light, EnvironmentLight) for one in lights for light in one)
    if surrounding and scene.radiance_transfer is not None:
        raise ValueError("environment lighting of single views knows no radiance transfer: leave one of the two out")
    if not (scene.shows_lights or surrounding):
        raise ValueError("nothing shows the lights of the views: set shading=jvr.Lambert() or scattering=jvr.SingleScattering()")


def _alike(lights: Lights) -> list[list[int]]:
    """Views under equal lights, by their indices."""
    groups: list[list[int]] = []
    for i, one in enumerate(lights):
        same = next((group for group in groups if eqx.tree_equal(lights[group[0]], one)), None)
        if same is None:
            groups.append([i])
        else:
            same.append(i)
    return groups


def _kept(problem: Problem, observations: Observations, keep: bool | int) -> Group:
    """With samples along the rays, where the volume and its clipping are known and memory allows."""
    among = lambda select: problem.unknowns.among(problem.model, select)
    moving = problem.model.views is not None or among(lambda m: (m.scene.volume, m.scene.clipping))
    # What is kept is the scalar alone.
    only_scalars = problem.marches and not problem.model.scene.needs_gradient
    if keep is False or moving or not only_scalars or isinstance(problem.loss, DSSIM):
        return Group(problem, observations)
    limit = KEEP_LIMIT if keep is True else keep
    # Entries of a table leave its ends where they are; whatever else it has may move them.
    entries = lambda transfer: tuple(transfer.entries.values()) if isinstance(transfer, AbstractTable) else ()
    clamped = among(lambda m: m.scene.transfer) == among(lambda m: entries(m.scene.transfer))
    kept = keep_samples(problem.model.scene, observations, problem.settings, limit, clamped=clamped)
    return Group(problem, observations) if kept is None else Group(problem.with_samples(kept[0]), kept[1])
