"""ClimateGS: weather for driving scenes made of 3D Gaussians.

The names below are the library's public face, loaded when first used; other modules can be imported
but promise nothing between versions.
"""

from importlib import import_module

__version__ = "0.6.0"

_PUBLIC = {
    "augment.view.render_view": ("render_buffers", "render_view", "render_views"),
    "augment.view.results": ("WeatheredView",),
    "augment.jobs.render_job": ("JobResult", "RenderJob", "run_job"),
    "augment.output.manifest": ("read_manifest",),
    "augment.scene.cameras": ("Camera", "Frame"),
    "augment.dataset": ("SceneDataset", "WeatherDataset", "collate_frames", "split_by_scene"),
    "augment.errors": ("ClimateGSError",),
    "augment.jobs.generate": ("GenerateJob", "GenerateResult", "run_generate"),
    "augment.scene.labels": ("Boxes", "LidarSweep"),
    "augment.view.plan": ("make_plan",),
    "augment.render.buffers": ("RenderOutput",),
    "augment.render.constants": ("RasterSettings",),
    "augment.render.rasterize": ("rasterize",),
    "augment.scene.scene": ("Actor", "Gaussians", "PosedGaussians", "Scene", "Track"),
    "augment.scene.semantics": ("SemanticClass",),
    "augment.scene.sky": ("ConstantSky", "CubemapSky", "LatLongSky"),
    "augment.files.formats": ("read_splats",),
    "augment.files.ply": ("write_ply",),
    "augment.files.splat": ("write_splat",),
    "augment.render.fog": ("Fog",),
}
_HOMES = {name: module for module, names in _PUBLIC.items() for name in names}

__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'augment' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
