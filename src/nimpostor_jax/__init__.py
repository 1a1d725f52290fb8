"""Neural Impostor in JAX: editable radiance fields on tetrahedral cages.

The names below are the public interface; each is imported from its module on first use.
"""

import importlib
from typing import Any

_MODULES = {
    "config": (
        "BakeConfig",
        "CageConfig",
        "DataConfig",
        "DecoderConfig",
        "EncodingConfig",
        "ExperimentConfig",
        "ImpostorConfig",
        "MarchConfig",
        "RenderConfig",
        "RetrainConfig",
        "SamplerConfig",
        "TrainConfig",
    ),
    "types": (
        "BakedImpostor",
        "Camera",
        "FunctionSolid",
        "GridSolid",
        "NeuralImpostor",
        "Rays",
        "RenderOutput",
        "TetMesh",
    ),
    "edit.cage_fit": ("fit_cage", "make_handles"),
    "edit.appearance": ("recolored", "uniform", "with_material"),
    "edit.boolean": ("difference", "gated", "intersection", "solid_of", "symmetric_difference", "union"),
    "edit.deform": ("bend", "deform", "deformation_report", "drag", "rigid", "stretch", "twist"),
    "edit.compose": ("compose",),
    "edit.remesh": ("consolidate", "transfer"),
    "edit.subdivide": ("subdivide",),
    "field.impostor": ("init_impostor",),
    "geometry.locate": ("locate",),
    "gin_flags": ("load_config",),
    "io.blender": ("PosedImages", "load_scene"),
    "io.impostor_file": ("load_baked", "load_impostor", "save_impostor"),
    "pipeline.bake": ("bake",),
    "pipeline.evaluate": ("camera_of", "evaluate", "orbit"),
    "pipeline.fit": ("fit",),
    "pipeline.prepare": ("Scene", "prepare", "use_all_cores"),
    "pipeline.ray_bending": ("BentField",),
    "preprocess.cage": ("cage_from_images", "cage_from_surface"),
    "geometry.topology": ("build_tet_mesh", "world_vertices"),
    "preprocess.patterns": ("solid_from_image", "solid_from_surface"),
    "render.camera": ("image_pixels", "pixel_rays"),
    "render.frame": ("for_frames", "frame_config", "render_frame", "to_image"),
    "render.raster_frame": ("rasterize_frame",),
    "render.renderer": ("render_rays",),
    "train.pool": ("draw_batch",),
    "train.step": (
        "RayBatch",
        "TrainState",
        "init_state",
        "make_optimizer",
        "train_step",
        "trainable",
        "with_parameters",
    ),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
