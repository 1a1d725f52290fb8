"""Records that cross stage boundaries: pytrees of arrays, built and validated on the host.

Axes: V vertices, T tets, R rays, N segments, S samples per ray, L levels, F features per level.
Units: `TetMesh.vertices` are in the cage's own frame (centre 0, half diagonal 1); `Rays` are in world units
until `render.camera.to_local`. Barycentric coordinates and weights have no unit.

Nothing is checked in here: `__post_init__` of a pytree class runs at every unflatten.
"""

from collections.abc import Callable
from typing import Any

from flax import struct
from jaxtyping import Array, Bool, Float, Int, UInt

from nimpostor_jax.config import ImpostorConfig


@struct.dataclass
class BoundaryFaces:
    """The cage's boundary faces in small clusters of neighbours, for culling; -1 fills unused slots.

    `tets[c, i]` is the face's tet, `corners[c, i]` the local index of the corner opposite the face. Geometry
    is not stored, so a deformed mesh keeps its clusters.
    """

    tets: Int[Array, "clusters width"]
    corners: Int[Array, "clusters width"]


@struct.dataclass
class TetMesh:
    """A tetrahedral cage in its own frame; `world = center + scale * vertices`."""

    vertices: Float[Array, "V 3"]
    tets: Int[Array, "T 4"]  # positively oriented
    neighbors: Int[Array, "T 4"]  # across the face opposite corner i; -1 outside
    object_ids: Int[Array, " T"]
    boundary: BoundaryFaces
    tet_leaves: Int[Array, "leaves width"]  # tets in the leaves of a complete binary tree; -1 pads
    center: Float[Array, " 3"]
    scale: Float[Array, ""]


@struct.dataclass
class Camera:
    """A pinhole camera, OpenGL axes (looks down -z, y up); pixel centres at half integers."""

    camera_to_world: Float[Array, "*batch 4 4"]
    focal: Float[Array, "*batch 2"]  # fx, fy in pixels
    principal: Float[Array, "*batch 2"]  # cx, cy in pixels
    width: int = struct.field(pytree_node=False)
    height: int = struct.field(pytree_node=False)


@struct.dataclass
class Rays:
    """Points `origins + t * directions`; directions have length 1."""

    origins: Float[Array, "*batch 3"]
    directions: Float[Array, "*batch 3"]


@struct.dataclass
class TetSegments:
    """The tets that rays cross (Fig. 4), packed: by ray, then along each ray. Slots may be empty anywhere.

    Barycentric coordinates are affine along a ray, so the two ends give every point between (Eq. 3).
    """

    rays: Int[Array, " N"]  # ascending, in empty slots too
    tet_ids: Int[Array, " N"]  # -1 marks an empty slot
    t_enter: Float[Array, " N"]
    t_exit: Float[Array, " N"]  # never before t_enter
    lambda_enter: Float[Array, "N 4"]
    lambda_exit: Float[Array, "N 4"]
    overflow: Bool[Array, " R"]  # more tets or entries than slots: the tail is missing
    disordered: Bool[Array, " R"]  # the ray's segments overlap, or go back
    mesh_tets: Int[Array, " N"] | None = None  # the mesh's tets, where `tet_ids` are a field's cells


@struct.dataclass
class HashLayout:
    """Which table entries a tet's grid nodes own (`docs/choices.md`, Encoding: per_tet and per_simplex).

    `regions[l, t, m]` packs offset * 32 + log2(size) of the region of level l in which tet t keeps the nodes
    whose set of nonzero coordinates is the 4-bit mask m (one column where all masks share a region).
    `dense_ranks` holds, for the coarsest levels one after another, a collision-free number for every node of
    the grid; the others hash.
    """

    starts: Int[Array, " L+1"]  # first entry of each level, and the number of entries
    regions: Int[Array, "L T masks"]
    multipliers: UInt[Array, "T 4"]  # hash factor of each corner
    corner_order: Int[Array, "T 4"]  # the tet's corners by ascending vertex id
    dense_ranks: Int[Array, " nodes"]
    rank_starts: Int[Array, " D+1"]  # where the D dense levels begin in `dense_ranks`
    num_mixed: int = struct.field(pytree_node=False, default=0)  # of these the last: hashed in some tets


@struct.dataclass
class BoxLayout:
    """Instant-NGP's tables: one grid over the bounding cube of the cage at rest, for all tets."""

    starts: Int[Array, " L+1"]  # first entry of each level, and the number of entries
    corners: Float[Array, "T 4 3"]  # of the tets at rest, in units of the cube


@struct.dataclass
class FaceLayout:
    """Triangular textures, one for each face of each tet: n + 1 texels along an edge, (n + 1)(n + 2) / 2."""

    starts: Int[Array, "T 4"]  # first texel of the face opposite each corner
    resolutions: Int[Array, "T 4"]  # n
    rows: Int[Array, " texels"] | None = None  # of texels in a table that holds some of them only


@struct.dataclass
class HashTables:
    """Trainable features of all levels in one packed array, and the layout that addresses them."""

    features: Float[Array, "entries F"]
    layout: HashLayout | BoxLayout | FaceLayout


@struct.dataclass
class MergedTables:
    """Chains of levels as one each, for rendering: features of all nodes of a chain's finest grid.

    `encoding.merged` numbers the n nodes of a tet. A point's features are those of the first chain's levels,
    of the second's, ..., and of the finer levels that are not merged.
    """

    nodes: tuple[Float[Array, "T*n C"], ...]
    corner_order: Int[Array, "T 4"]  # in which the encoding takes a tet's corners
    finer: HashTables | None  # all tables, for the levels that are not in chains
    chains: tuple[tuple[int, ...], ...] = struct.field(pytree_node=False)  # levels


@struct.dataclass
class Embedding:
    """Where a mesh's tets lie in the cells of its field: the tets for which the field's tables were made.

    A cage that has been cut finer, put together or built anew moves freely while its field stays as it is.
    """

    cells: Int[Array, " T"]
    lambdas: Float[Array, "T 4 4"]  # of the tets' corners, in their cells: [tet, corner, :]


@struct.dataclass
class GridSolid:
    """A solid by values on a regular grid, interpolated: inside where they are positive."""

    values: Float[Array, "X Y Z"]  # at the voxels' centres; outside of the grid nothing is inside
    world_to_grid: Float[Array, "3 4"]  # to indices of the array


@struct.dataclass
class FunctionSolid:
    """A solid by a function of world points [M, 3], positive inside. Lives in memory only."""

    function: Callable[[Float[Array, "M 3"]], Float[Array, " M"]] = struct.field(pytree_node=False)


@struct.dataclass
class ImpostorSolid:
    """What an impostor fills: where its density exceeds a threshold (Eq. 13), object by object."""

    impostor: "NeuralImpostor"
    objects: tuple[TetMesh, ...]  # its mesh, one for each object
    tet_ids: tuple[Int[Array, " tets"], ...]  # their tets, in its mesh
    threshold: Float[Array, ""]


Solid = GridSolid | FunctionSolid | ImpostorSolid


@struct.dataclass
class Gate:
    """A solid that hides what is inside it, or outside of it (Eqs. 13 to 15).

    It is fixed to the impostor, not to the world: it follows when the cage moves. `corners` are those of each
    tet's cell, in world units, as the tet placed them when the gate was made.
    """

    solid: Solid
    corners: Float[Array, "T 4 3"]
    states: Int[Array, " T"]  # of tets: OPEN, CLOSED, or MIXED where single points must be tested
    inside: bool = struct.field(pytree_node=False)  # what is kept


@struct.dataclass
class NeuralImpostor:
    """An editable radiance field: cage, tables, decoders (Sec. 3). A pytree of arrays and a static config.

    The field's T cells are the mesh's tets unless there is an `embedding`.
    """

    mesh: TetMesh
    tables: HashTables  # `field.merge_levels` puts `MergedTables` here, for rendering only
    decoders: dict[str, Any]  # every leaf has a leading axis: the stack of decoder sets
    decoder_index: Int[Array, " T"]  # which decoder set a cell uses
    config: ImpostorConfig = struct.field(pytree_node=False)
    occupied: Bool[Array, "T parts"] | None = None  # parts of `render.occupancy` that may be seen; None: all
    embedding: Embedding | None = None
    rest_vertices: Float[Array, "V 3"] | None = None  # in the mesh's frame, before it moved; None: it has not
    gates: tuple[Gate, ...] = ()  # a point is seen where all let it
    paints: tuple["Paint", ...] = ()  # one after another


@struct.dataclass
class Paint:
    """Changes colours inside a solid (Sec. 4.3, blending); fixed to the impostor as a `Gate` is.

    The field's colour is multiplied by `color`; where there is a `source`, a share of it is that field's.
    """

    solid: Solid
    corners: Float[Array, "T 4 3"]
    states: Int[Array, " T"]  # of tets: OPEN is left alone, CLOSED is painted all over, MIXED by points
    color: Float[Array, " 3"]
    source: NeuralImpostor | None  # a material, where it stood when the paint was made
    share: Float[Array, ""]  # of the source's colour


@struct.dataclass
class BakedImpostor:
    """An impostor whose tets are reduced to textures on their faces (Sec. 3.4): nothing is sampled any more.

    A texel has four coefficients for each number, of the barycentric coordinates at which the ray leaves.
    """

    mesh: TetMesh
    depths: HashTables  # features [texels, 4]: where on the way through the tet something is seen
    opacities: HashTables  # features [texels, 4], and the same FaceLayout
    textures: HashTables  # features [texels, 4 * K]: mean features as the decoder takes them; same FaceLayout
    decoders: dict[str, Any]
    decoder_index: Int[Array, " T"]
    config: ImpostorConfig = struct.field(pytree_node=False)


@struct.dataclass
class RenderOutput:
    """What a ray sees. `overflow`: its tets did not fit; `coarsened`: it got larger steps than asked for."""

    color: Float[Array, "*batch 3"]  # premultiplied by opacity, without background
    opacity: Float[Array, "*batch"]
    depth: Float[Array, "*batch"]  # expected distance in world units; 0 where opacity is 0
    overflow: Bool[Array, "*batch"]
    coarsened: Bool[Array, "*batch"]
