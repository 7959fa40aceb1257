"""What a command computes before its pictures: projected materials, radiance transfer, occlusion; kept in the user's cache."""

from typing import TYPE_CHECKING, Any

from jvr.cli.runtime import bar, cache_folder

if TYPE_CHECKING:
    from jvr.model.scene import Scene


class Beforehand:
    """`jvr.precompute` with a bar on the terminal and a cache folder; `report` holds an object for each part, for the command's JSON."""

    def __init__(self) -> None:
        self.report: list[dict[str, Any]] = []

    def __call__(self, scene: "Scene", **keywords: Any) -> "Scene":
        if not scene.is_precomputable:
            return scene
        from jvr.io.precompute import precompute

        note = lambda part: self.report.append(part._asdict())
        with bar("environment lighting" if scene.environment_light is not None else "light") as show:
            return precompute(scene, cache=cache_folder("precomputed"), progress=show, report=note, **keywords)


def lines_of(report: list[dict[str, Any]]) -> list[str]:
    """`Beforehand.report` in words."""
    how = lambda part: "read from the cache" if part["cached"] else "computed"
    return [f"{part['part']}: {how(part)} in {part['seconds']:.2f} s, {part['nbytes'] / 1e6:.2g} MB" for part in report]
