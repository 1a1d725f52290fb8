"""Every comparison of `benchmark.py --peers`, by the name of its row."""

from collections.abc import Iterator, Sequence
from functools import partial

import peers_encoding as encoding
import peers_geometry as geometry
from peers_match import CORES, Comparison, Row, Work, compare

PACKAGES = ("scipy", "vtk", "pyvista", "open3d", "embreex", "drjit", "torch")

COMPARISONS: dict[str, Comparison] = {
    comparison.__name__: comparison
    for comparison in (
        geometry.locate_vs_scipy,
        geometry.locate_vs_vtk,
        geometry.traverse_vs_open3d,
        geometry.traverse_random_vs_open3d,
        geometry.traverse_vs_embree,
        geometry.traverse_ball_frame,
        geometry.traverse_ball_frame_one_thread,
        geometry.frame_vs_vtk,
        geometry.frame_trained_vs_vtk,
        encoding.encode_fwd_vs_drjit,
        encoding.encode_bwd_vs_drjit,
        encoding.encode_simplex_fwd_vs_drjit,
        encoding.encode_simplex_bwd_vs_drjit,
        encoding.encode_simplex_fwd_vs_drjit_3d,
        encoding.encode_simplex_bwd_vs_drjit_3d,
        encoding.encode_fwd_vs_torch,
        encoding.encode_bwd_vs_torch,
    )
}


def compare_all(work: Work, only: Sequence[str] = ()) -> Iterator[Row]:
    """Rows in order, of the comparisons whose names contain one of `only` (of all where it is empty)."""
    batches = {
        f"traverse_batch_{count}{name}": partial(geometry.traverse_batch, count, threads)
        for name, threads in (("", CORES), ("_one_thread", 1))
        for count in work.batches
    }
    for name, comparison in (COMPARISONS | batches).items():
        if not only or any(part in name for part in only):
            yield compare(name, comparison, work)
