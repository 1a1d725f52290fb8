"""Static configuration: frozen, hashable dataclasses, checked when they are built.

A config is an argument of `jax.jit` by value (static): a new value recompiles, an equal one does not.
Arrays never live here. Each class is small and belongs to one stage of the pipeline.
"""

import dataclasses
import math
import typing
from typing import Literal

Layout = Literal["per_simplex", "per_tet", "box"]
Interpolation = Literal["grid", "simplex"]
Measure = Literal["barycentric", "alpha", "euclidean"]
Background = Literal["white", "black", "random"]


def _require(condition: bool, owner: object, name: str, rule: str) -> None:
    if not condition:
        value = getattr(owner, name)
        raise ValueError(f"{type(owner).__name__}.{name} must be {rule}, got {value!r}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class EncodingConfig:
    """Multi-resolution hash encoding of barycentric coordinates (Sec. 3.3).

    `layout` says who owns a grid node: `per_simplex` shares nodes on common vertices, edges and faces
    (continuous field), `per_tet` gives each tet its own table (the paper's). `interpolation` is the
    16-corner 4D `grid` of the paper or the 4-corner `simplex` of the edgewise subdivision. The layout `box`
    is Instant-NGP's grid of Cartesian coordinates in the cage's bounding cube, with 8 or 4 corners.

    Resolutions are 1, 2, 3, 4, 6, 8, 12, ... times the base, each twice the one two levels before, or grow by
    a constant factor (the paper's "progressively subdividing": 2).
    """

    layout: Layout = "per_simplex"
    interpolation: Interpolation = "simplex"
    num_levels: int = 13  # at most: training leaves out levels with cells below half a pixel
    features_per_level: int = 2
    base_resolution: int = 1
    growth: float | None = None  # None: two levels an octave
    log2_table_size: int = 19  # H, the whole mesh's budget a level
    min_log2_tet_table: int = 8
    max_log2_tet_table: int = 11
    log2_tet_table: int | None = None  # H' of each tet, in the place of the three above
    init_scale: float = 1e-2

    def __post_init__(self) -> None:
        layouts = typing.get_args(Layout)
        _require(self.layout in layouts, self, "layout", f"one of {layouts}")
        _require(
            self.interpolation in typing.get_args(Interpolation),
            self,
            "interpolation",
            f"one of {typing.get_args(Interpolation)}",
        )
        _require(self.num_levels >= 1, self, "num_levels", ">= 1")
        _require(self.features_per_level >= 1, self, "features_per_level", ">= 1")
        _require(self.base_resolution >= 1, self, "base_resolution", ">= 1")
        _require(self.growth is None or self.growth >= 1.0, self, "growth", "None or >= 1")
        _require(
            max(self.resolutions) <= 4096,
            self,
            "num_levels",
            "such that the finest resolution is <= 4096",
        )
        _require(1 <= self.log2_table_size <= 26, self, "log2_table_size", "in [1, 26]")
        _require(
            1 <= self.min_log2_tet_table <= self.max_log2_tet_table <= 20,
            self,
            "min_log2_tet_table",
            "in [1, max_log2_tet_table <= 20]",
        )
        _require(
            self.log2_tet_table is None or 1 <= self.log2_tet_table <= 20,
            self,
            "log2_tet_table",
            "None or in [1, 20]",
        )

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Grid resolution N_l = round(base * growth**l) of each level, or two of them an octave."""
        base, growth = self.base_resolution, self.growth
        if growth is not None:
            return tuple(round(base * growth**level) for level in range(self.num_levels))
        return tuple(base * (((2 + n % 2) << n // 2) // 2) for n in range(1, self.num_levels + 1))

    @property
    def feature_dim(self) -> int:
        """Length of the concatenated feature vector f_p (L * F)."""
        return self.num_levels * self.features_per_level

    def level_budget(self, num_tets: int) -> int:
        """Entries of a level of all tets: 2**H, but from 2**min to 2**max for each tet (Sec. 3.3, 5.1)."""
        if self.log2_tet_table is not None:
            return num_tets << self.log2_tet_table
        least, most = num_tets << self.min_log2_tet_table, num_tets << self.max_log2_tet_table
        return min(max(1 << self.log2_table_size, least), most)

    def tet_table_size(self, num_tets: int) -> int:
        """Entries 2**H' a level of each tet's own table (Sec. 3.3, corrected to stay in Sec. 5.1's range)."""
        if self.log2_tet_table is not None:
            return 1 << self.log2_tet_table
        log2 = self.log2_table_size - math.floor(math.log2(num_tets) + 1)
        return 1 << min(max(log2, self.min_log2_tet_table), self.max_log2_tet_table)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DecoderConfig:
    """The two small MLPs of Eq. 7 (widths of Sec. 5.1) and the direction encoding of Eq. 6."""

    density_hidden: int = 16
    appearance_hidden: int = 64
    appearance_layers: int = 2
    sh_degree: int = 4  # D: D**2 spherical harmonics; 0 leaves the view direction out
    density_bias: float = -1.0

    def __post_init__(self) -> None:
        _require(self.density_hidden >= 1, self, "density_hidden", ">= 1")
        _require(self.appearance_hidden >= 1, self, "appearance_hidden", ">= 1")
        _require(self.appearance_layers >= 1, self, "appearance_layers", ">= 1")
        _require(0 <= self.sh_degree <= 4, self, "sh_degree", "in [0, 4]")


@dataclasses.dataclass(frozen=True, kw_only=True)
class MarchConfig:
    """Fixed sizes of the tet traversal (Sec. 3.4, Fig. 4). A change recompiles."""

    max_tets_per_ray: int = 64  # K
    capacity_per_ray: int | None = None  # mean tets a ray in the packed buffer; None: K
    max_entries_per_ray: int = 4  # times that a ray enters the cage from outside
    tile_size: int | None = (
        None  # rays marched together; None: 256 on CPU, the whole batch elsewhere
    )

    def __post_init__(self) -> None:
        _require(self.max_tets_per_ray >= 1, self, "max_tets_per_ray", ">= 1")
        _require(
            self.capacity_per_ray is None or 1 <= self.capacity_per_ray <= self.max_tets_per_ray,
            self,
            "capacity_per_ray",
            "None or in [1, max_tets_per_ray]",
        )
        _require(self.max_entries_per_ray >= 1, self, "max_entries_per_ray", ">= 1")
        _require(self.tile_size is None or self.tile_size >= 1, self, "tile_size", "None or >= 1")


@dataclasses.dataclass(frozen=True, kw_only=True)
class SamplerConfig:
    """Placement of samples along a ray (Eqs. 3 to 5).

    `step` is in units of `measure`: L1 barycentric distance (2 is a whole crossing, vertex to face), tets
    crossed (`alpha`, Eq. 4 as printed), or length (`euclidean`, in units of the cage's own frame). Without
    one, steps cross about two cells of the field's finest level (`render.sampling.with_step`).
    """

    measure: Measure = "barycentric"
    step: float | None = None
    cone_angle: float = 0.0  # theta of Eq. 4: step growth per unit of measure travelled
    max_samples_per_ray: int = 256  # S; a longer ray gets larger steps and is reported
    capacity_per_ray: int | None = (
        None  # mean samples a ray in the packed buffer; None: S, no packing
    )
    occupied_per_ray: int | None = None  # of these, mean samples a ray in occupied cells; None: all

    def __post_init__(self) -> None:
        _require(
            self.measure in typing.get_args(Measure),
            self,
            "measure",
            f"one of {typing.get_args(Measure)}",
        )
        _require(
            self.step is None or (self.step > 0 and math.isfinite(self.step)), self, "step", "None or > 0"
        )
        _require(self.cone_angle >= 0, self, "cone_angle", ">= 0")
        _require(self.max_samples_per_ray >= 1, self, "max_samples_per_ray", ">= 1")
        _require(
            self.capacity_per_ray is None or 1 <= self.capacity_per_ray <= self.max_samples_per_ray,
            self,
            "capacity_per_ray",
            "None or in [1, max_samples_per_ray]",
        )
        _require(
            self.occupied_per_ray is None or self.occupied_per_ray >= 1,
            self,
            "occupied_per_ray",
            "None or >= 1",
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """What the renderer does with the samples (Eqs. 1, 8, 9)."""

    march: MarchConfig = MarchConfig()
    sampler: SamplerConfig = SamplerConfig()
    density_measure: Literal["barycentric", "euclidean"] = "barycentric"  # Eq. 9 or Eq. 8
    near: float = 0.0  # in world units
    min_weight: float = 1e-3  # samples of less get no colour and no gradient; 0: all do
    skip_empty: bool = True  # leave out samples in cells that training found empty or hidden
    skip_sorting: bool = True  # sort samples along rays only where tets overlap
    explore: float = 1 / 16  # share of training's rays that look into all cells nevertheless
    integrate: Literal["color", "features"] = "color"  # Eq. 9, or Eq. 10: one decoded colour a ray
    directions: Literal["world", "rest"] = "world"  # of view; rest: turned back with the tet
    frame_refinement: float = 1.25  # divides the steps of frames; in training, jitter makes up for long steps

    def __post_init__(self) -> None:
        _require(0 <= self.min_weight < 1, self, "min_weight", "in [0, 1)")
        _require(self.frame_refinement >= 1, self, "frame_refinement", ">= 1")
        _require(0 <= self.explore <= 1, self, "explore", "in [0, 1]")
        _require(
            self.integrate in ("color", "features"), self, "integrate", "'color' or 'features'"
        )
        _require(self.directions in ("world", "rest"), self, "directions", "'world' or 'rest'")
        _require(
            self.density_measure in ("barycentric", "euclidean"),
            self,
            "density_measure",
            "'barycentric' or 'euclidean'",
        )
        _require(self.near >= 0, self, "near", ">= 0")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImpostorConfig:
    """Everything static about a Neural Impostor's field."""

    encoding: EncodingConfig = EncodingConfig()
    decoder: DecoderConfig = DecoderConfig()


@dataclasses.dataclass(frozen=True, kw_only=True)
class DataConfig:
    """How posed images are read."""

    resolution: int | None = None  # target image width in pixels; None: as stored
    background: Literal["white", "black"] = "white"  # of the reference images in evaluation
    test_every: int = 8  # every n-th view is held out where there is no test split

    def __post_init__(self) -> None:
        _require(
            self.resolution is None or self.resolution >= 8, self, "resolution", "None or >= 8"
        )
        _require(self.background in ("white", "black"), self, "background", "'white' or 'black'")
        _require(self.test_every >= 2, self, "test_every", ">= 2")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CageConfig:
    """Cage construction from masks or from a surface mesh (Sec. 5.1).

    `shape` is an `envelope` of the object, or its bounding `box` of 6 tets (NGP-Bounded).
    """

    shape: Literal["envelope", "box"] = "envelope"
    target_tets: int = 350
    grid_resolution: int = 128  # voxels along the longest side of the visual hull
    margin: float = 0.02  # offset of the envelope from the object, as a share of its diagonal
    max_missed_share: float = 0.001  # foreground pixels whose rays may miss the cage

    def __post_init__(self) -> None:
        _require(self.shape in ("envelope", "box"), self, "shape", "'envelope' or 'box'")
        _require(self.target_tets >= 6, self, "target_tets", ">= 6")
        _require(self.grid_resolution >= 16, self, "grid_resolution", ">= 16")
        _require(0 < self.margin < 0.5, self, "margin", "in (0, 0.5)")
        _require(0 <= self.max_missed_share < 1, self, "max_missed_share", "in [0, 1)")


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Optimisation of tables and decoders.

    `occupancy` says which cells hold something: those that rays have `seen` of late, or those whose
    `density`, evaluated now and then, is not negligible (Instant-NGP's).
    """

    steps: int = 2000
    rays_per_batch: int = 4096
    learning_rate: float = 1e-2
    final_learning_rate: float = 1e-3
    warmup_steps: int = 50
    background: Background = "random"
    occupancy: Literal["seen", "density"] = "seen"
    cells_per_edge: int = 16  # of the occupancy grid in each tet; 0: no sample is left out
    forget_rays: int = 2_000_000  # rays after which a cell that none has seen counts as empty
    seed: int = 0
    log_every: int = 50
    eval_every: int = 0  # steps between measurements of held-out PSNR; 0: only at the end
    checkpoint_every: int = 500

    def __post_init__(self) -> None:
        _require(self.steps >= 1, self, "steps", ">= 1")
        _require(self.rays_per_batch >= 1, self, "rays_per_batch", ">= 1")
        _require(self.learning_rate > 0, self, "learning_rate", "> 0")
        _require(self.final_learning_rate > 0, self, "final_learning_rate", "> 0")
        _require(self.warmup_steps >= 0, self, "warmup_steps", ">= 0")
        _require(
            self.background in typing.get_args(Background),
            self,
            "background",
            f"one of {typing.get_args(Background)}",
        )
        _require(
            self.occupancy in ("seen", "density"), self, "occupancy", "'seen' or 'density'"
        )
        _require(0 <= self.cells_per_edge <= 64, self, "cells_per_edge", "in [0, 64]")
        _require(self.forget_rays >= 1, self, "forget_rays", ">= 1")
        _require(self.log_every >= 1, self, "log_every", ">= 1")
        _require(self.eval_every >= 0, self, "eval_every", ">= 0")
        _require(self.checkpoint_every >= 1, self, "checkpoint_every", ">= 1")

    @property
    def forget_after(self) -> int:
        """`forget_rays` in steps."""
        return -(-self.forget_rays // self.rays_per_batch)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BakeConfig:
    """Baking onto face textures (Sec. 3.4).

    The cage's tets are first halved, where something is seen, until their edges are about `tet_pixels` long
    in the training views: a texture blurs what lies deep behind its face. After the fit to what single tets
    show, `refine_steps` of training improve the textures (and with `refine_decoders` the decoders) on whole
    pictures: the training views, and `novel_views` that the impostor renders from between them.
    """

    tet_pixels: float = 10.0
    texels_per_pixel: float = 0.7  # along an edge, at the training views' distance
    channels: int = 8  # that a texel keeps of the features, as the colour decoder takes them
    max_resolution: int = 256  # texels along an edge
    min_opacity: float = 2e-3  # of a tet, on average over the light that reaches it; less is left out
    max_megabytes: int = 1024  # of textures; more is refused. Baking them may take 14 times as much
    fit_rays: int = 1_000_000
    novel_views: int = 300
    refine_steps: int = 3000
    refine_decoders: bool = True
    learning_rate: float = 2e-2  # falls to a tenth

    def __post_init__(self) -> None:
        _require(self.tet_pixels > 0, self, "tet_pixels", "> 0")
        _require(self.texels_per_pixel > 0, self, "texels_per_pixel", "> 0")
        _require(0 <= self.min_opacity < 1, self, "min_opacity", "in [0, 1)")
        _require(1 <= self.max_resolution <= 4096, self, "max_resolution", "in [1, 4096]")
        _require(self.max_megabytes >= 1, self, "max_megabytes", ">= 1")
        _require(self.channels >= 1, self, "channels", ">= 1")
        _require(self.fit_rays >= 1, self, "fit_rays", ">= 1")
        _require(self.novel_views >= 0, self, "novel_views", ">= 0")
        _require(self.refine_steps >= 0, self, "refine_steps", ">= 0")
        _require(self.learning_rate > 0, self, "learning_rate", "> 0")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RetrainConfig:
    """Local retraining of the tets that an edit has changed (Sec. 4.2, Eq. 12).

    Stage 1 fits tables to the old features at points, stage 2 tables and decoders to rays. Lost is what the
    old field shows outside of the new cage.
    """

    feature_steps: int = 100
    points_per_batch: int = 1 << 16  # of a step; four times as many at once for the start
    render_steps: int = 100
    rays_per_batch: int = 4096
    views: int = 24  # pictures of the old impostor, from all around the region, that stage 2 trains on
    view_width: int = 200
    feature_rate: float = 1e-2  # of both stages' tables; in the second it rises first, and falls to a tenth
    decoder_rate: float = 2e-3
    max_lost_share: float = 0.001
    seed: int = 0

    def __post_init__(self) -> None:
        _require(self.feature_steps >= 0, self, "feature_steps", ">= 0")
        _require(self.points_per_batch >= 1, self, "points_per_batch", ">= 1")
        _require(self.render_steps >= 0, self, "render_steps", ">= 0")
        _require(self.rays_per_batch >= 1, self, "rays_per_batch", ">= 1")
        _require(self.views >= 1, self, "views", ">= 1")
        _require(self.view_width >= 8, self, "view_width", ">= 8")
        _require(self.feature_rate > 0, self, "feature_rate", "> 0")
        _require(self.decoder_rate >= 0, self, "decoder_rate", ">= 0")
        _require(0 <= self.max_lost_share <= 1, self, "max_lost_share", "in [0, 1]")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExperimentConfig:
    """One run: what the scripts read from gin files and save beside the checkpoint."""

    data: DataConfig = DataConfig()
    cage: CageConfig = CageConfig()
    impostor: ImpostorConfig = ImpostorConfig()
    render: RenderConfig = RenderConfig()
    train: TrainConfig = TrainConfig()
    bake: BakeConfig = BakeConfig()
    retrain: RetrainConfig = RetrainConfig()
