"""Rays that end at geometry, in the light of the scene."""

from jvr.march.medium import Medium
from jvr.march.steps import End, Rays
from jvr.rendering.medium import Prepared, absorbing, lighting_module


def lit_where_rays_end(prepared: Prepared, medium: Medium, rays: Rays) -> Rays:
    """Rays as `jvr.rendering.trace.enter` makes them, with the radiance of the geometry that they end at in place of its colour."""
    end, scene = rays.end, prepared.scene
    if end is None or end.face is None:
        return rays
    path = lambda graded: absorbing(scene, prepared.occupancy, graded)
    rgb = lighting_module().radiance_of_geometry(scene, path, prepared.search, medium, end)
    return rays._replace(end=End(rgb, end.opaque, end.distance))
