"""Tetrahedra in an envelope, with a target count: fTetWild (Hu et al. 2020) through pytetwild.

Lengths are world units; `epsilon` and `margin` are shares of the object's bounding diagonal.

fTetWild has no setting for the count. Its surface tolerance steers it best (a tolerant surface
needs fewer tets), so a bounded search moves that, on a log scale, and builds the envelope farther
out as the
tolerance grows: the surface may come nearer than the envelope by the tolerance. fTetWild inserts
triangles
in a random order that cannot be seeded: equal input gives other tets, and counts that differ by
15%, from call to call. Keep a cage by saving it (`io.mesh_files.save_tets`).
"""

import dataclasses
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int

from nimpostor_jax.geometry.topology import adjacency
from nimpostor_jax.preprocess.validate import boundary_faces, orient_tets, signed_volumes

Log = Callable[[str], None]

BOX_TETS = 6
MAX_CALLS = 9
_CLOSE_ENOUGH = 0.08  # the search stops here
_TOLERATED = 0.2  # a result within this share of the target is what was asked for
_HOPELESS = 0.5
_EPSILON_RANGE = (0.0015, 0.08)
_CLEARANCE = 1.15  # offset of the envelope over epsilon
_SLOPE = 1.25  # the count goes about as epsilon**-slope
_STEP = 0.8  # triangle size of the envelope over its offset
# A process of its own: fTetWild can abort the one that it runs in.
_PROGRAM = Path(__file__).with_name("ftetwild_process.py")


@dataclasses.dataclass(frozen=True)
class _Attempt:
    epsilon: float
    vertices: Float[np.ndarray, "V 3"]
    tets: Int[np.ndarray, "T 4"]

    def error(self, target: int) -> float:
        """Distance from the target on a log scale."""
        return abs(math.log(len(self.tets) / target))


def tetrahedralize(
    envelope: Callable[[float, float], trimesh.Trimesh],
    target_tets: int,
    diagonal: float,
    margin: float,
    log: Log = print,
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "T 4"]]:
    """Mesh the inside of an envelope with about `target_tets` tets.

    Args:
        envelope: closed surface for an offset and a triangle size, both in world units.
        target_tets: met within 20% as a rule; the log says what was reached.
        diagonal: of the object's bounding box, in world units.
        margin: least offset of the envelope, as a share of the diagonal.
        log: called with a line per fTetWild call.

    Returns:
        Vertices and positively oriented tets; every vertex is used.

    Raises:
        ValueError: no attempt comes within 50% of the target.
    """
    # fTetWild cannot go below 50 to 90 tets; for a handful of them a box is as good.
    if target_tets <= 12:
        return box_tets(envelope(margin * diagonal, margin * diagonal).bounds)
    attempts: list[_Attempt] = []
    edge = 0.2 * min(1.0, (800.0 / target_tets) ** (1.0 / 3.0))
    epsilon = 0.027 * (350.0 / target_tets) ** (1.0 / _SLOPE)
    for call in range(MAX_CALLS):
        epsilon = min(max(epsilon, _EPSILON_RANGE[0]), _EPSILON_RANGE[1])
        offset = diagonal * max(margin, _CLEARANCE * epsilon)
        surface = envelope(offset, _STEP * offset)
        vertices, tets = run_ftetwild(surface, epsilon * diagonal, edge)
        log(f"fTetWild call {call + 1} (<= {MAX_CALLS}): epsilon {epsilon:.4f}, {len(tets)} tets")
        if len(tets) and is_sound(vertices, tets):
            attempts.append(_Attempt(epsilon, vertices, tets))
            if attempts[-1].error(target_tets) <= _CLOSE_ENOUGH:
                break
        tried, epsilon = epsilon, _next_epsilon(attempts, target_tets, epsilon)
        if (tried == _EPSILON_RANGE[0] > epsilon) or (tried == _EPSILON_RANGE[1] < epsilon):
            break
    if not attempts:
        raise ValueError(
            f"fTetWild returned no usable mesh in {MAX_CALLS} calls; enlarge CageConfig.margin"
        )
    best = min(attempts, key=lambda attempt: attempt.error(target_tets))
    share = len(best.tets) / target_tets - 1.0
    if abs(share) > _HOPELESS:
        raise ValueError(
            f"no cage with about {target_tets} tets: the nearest of {len(attempts)} attempts has "
            f"{len(best.tets)}; ask for about that many, or change CageConfig.margin"
        )
    if abs(share) > _TOLERATED:
        log(f"warning: {len(best.tets)} tets, {100 * share:+.0f}% off the target of {target_tets}")
    return best.vertices, best.tets


def run_ftetwild(
    surface: trimesh.Trimesh, epsilon: float, edge_length_factor: float = 0.2
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "T 4"]]:
    """One call of fTetWild: positively oriented tets without unused vertices; none if it crashes.

    `epsilon` is the tolerance of the surface in world units; `edge_length_factor` the ideal edge
    over the diagonal of the surface's box.
    """
    with tempfile.TemporaryDirectory() as folder:
        given, result = Path(folder, "surface.npz"), Path(folder, "tets.npz")
        np.savez(
            given,
            vertices=np.asarray(surface.vertices, np.float64),
            faces=np.asarray(surface.faces, np.int32),
            edge=edge_length_factor,
            epsilon=epsilon / float(np.linalg.norm(surface.extents)),
        )
        # -P: this folder's modules must not shadow installed ones.
        command = [sys.executable, "-P", str(_PROGRAM), str(given), str(result)]
        child = subprocess.run(command, capture_output=True, text=True, errors="replace", cwd=folder)
        if child.returncode > 0:  # a Python error; a crash of fTetWild ends by a signal
            raise RuntimeError(f"pytetwild failed: {child.stderr.strip()[-500:]}")
        if child.returncode < 0 or not result.is_file():
            return np.zeros((0, 3)), np.zeros((0, 4), np.int32)
        with np.load(result) as data:
            vertices, tets = data["vertices"], data["tets"]
    used, compact = np.unique(tets, return_inverse=True)
    vertices = vertices[used]
    return vertices, orient_tets(
        compact.reshape(-1, 4).astype(np.int32), vertices
    )  # pytetwild 0.4 returns them inverted


def box_tets(
    bounds: Float[np.ndarray, "2 3"],
) -> tuple[Float[np.ndarray, "8 3"], Int[np.ndarray, "6 4"]]:
    """Six tets around a diagonal of a box (Kuhn's subdivision of the cube)."""
    corners = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1)
    vertices = np.where(corners == 1, bounds[1], bounds[0]).astype(np.float64)
    paths = [(4, 6), (4, 5), (2, 6), (2, 3), (1, 5), (1, 3)]
    tets = np.array([(0, middle, after, 7) for middle, after in paths], np.int32)
    return vertices, orient_tets(tets, vertices)


def is_sound(vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"]) -> bool:
    """No tet without volume, none beside another on one side of a face, a closed boundary without seams."""
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if signed_volumes(vertices, tets).min() <= 1e-10 * size**3:
        return False
    try:
        adjacency(tets)
    except ValueError:
        return False
    faces = boundary_faces(tets)
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all())


def _next_epsilon(attempts: list[_Attempt], target: int, epsilon: float) -> float:
    """Where a power law through the attempts around the target, or the nearest, puts it."""
    if not attempts:
        return 0.8 * epsilon
    few = [a for a in attempts if len(a.tets) <= target]
    many = [a for a in attempts if len(a.tets) > target]
    if few and many:
        below = min(few, key=lambda a: a.error(target))
        above = min(many, key=lambda a: a.error(target))
        if below.epsilon > 1.02 * above.epsilon:
            share = above.error(target) / max(above.error(target) + below.error(target), 1e-9)
            share = min(max(share, 0.15), 0.85)
            return above.epsilon * (below.epsilon / above.epsilon) ** share
    nearest = min(attempts, key=lambda a: a.error(target))
    return nearest.epsilon * (len(nearest.tets) / target) ** (1.0 / _SLOPE)
