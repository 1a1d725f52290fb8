"""The encoding beside Dr.Jit's hash grid and permutohedral lattice and a PyTorch hash grid.

All encode the same random points, barycentric coordinates of one tet, in tables of one size at the same
resolutions. Gradients are those in the tables, for one random cotangent. Ours adds them up on one device:
several would each fill a table, and adding these costs more than is gained.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P
from peers_match import CORES, Absent, Match, Row, Work, spread

from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.encoding.hash_grid import encode, init_features
from nimpostor_jax.encoding.layout import NGP_PRIMES, build_layout
from nimpostor_jax.types import HashTables

BASE, FINEST = 16, 4096  # resolutions of the first and the last level
FEATURES = 2
CLOSE = 1e-4  # features and their gradients are of size 1, and float32 sums of some of them


class Problem(NamedTuple):
    """What both sides are given."""

    config: EncodingConfig
    tables: HashTables
    lambdas: np.ndarray  # [M, 4]
    cotangent: np.ndarray  # [M, L, F]

    @property
    def table_size(self) -> int:
        """Entries of a hashed level."""
        return self.config.tet_table_size(1)

    def hashed_levels(self) -> list[int]:
        """The levels that ours hashes; it numbers the nodes of coarser ones."""
        return list(range(len(self.tables.layout.rank_starts) - 1, self.config.num_levels))

    def entries(self, level: int) -> slice:
        """Our table's entries of a level."""
        return slice(*np.asarray(self.tables.layout.starts[level : level + 2]).tolist())


class Peer(NamedTuple):
    """Another encoding: its calls, and how to read their results."""

    encode: Callable[[], Any]
    pull: Callable[[], Any]  # gradient in the table
    features: Callable[[Any], np.ndarray] | None = None  # [M, L, F]; None: its nodes differ from ours
    gradient: Callable[[Any], np.ndarray] | None = None  # [entries, F]
    same: dict[int, slice] | None = None  # levels that hash as ours do, and their entries in its table


def _problem(work: Work, interpolation: str) -> Problem:
    rng = np.random.default_rng(0)
    config = EncodingConfig(
        layout="per_tet",
        interpolation=interpolation,
        num_levels=work.num_levels,
        features_per_level=FEATURES,
        base_resolution=BASE,
        growth=(FINEST / BASE) ** (1 / (work.num_levels - 1)),
        log2_tet_table=work.log2_table,
        init_scale=1.0,
    )
    layout = build_layout(np.eye(4, 3), np.arange(4)[None], config)
    features = init_features(jax.random.key(0), int(layout.starts[-1]), config)
    return Problem(
        config=config,
        tables=HashTables(features=features, layout=layout),
        lambdas=rng.dirichlet(np.ones(4), work.encoded).astype(np.float32),
        cotangent=rng.normal(size=(work.encoded, work.num_levels, FEATURES)).astype(np.float32),
    )


# ---- comparisons -------------------------------------------------------------------------------------------


def encode_fwd_vs_drjit(work: Work) -> Match:
    """`drjit.nn.HashGridEncoding` in 4D: 16 corners on both sides."""
    problem = _problem(work, "grid")
    return _forward(problem, _drjit(problem, "HashGridEncoding", 4))


def encode_bwd_vs_drjit(work: Work) -> Match:
    """Its gradient."""
    problem = _problem(work, "grid")
    return _backward(problem, _drjit(problem, "HashGridEncoding", 4))


def encode_simplex_fwd_vs_drjit(work: Work) -> Match:
    """`drjit.nn.PermutoEncoding` in 4D: 5 corners a point and level to our 4."""
    problem = _problem(work, "simplex")
    return _forward(problem, _drjit(problem, "PermutoEncoding", 4))


def encode_simplex_bwd_vs_drjit(work: Work) -> Match:
    """Its gradient."""
    problem = _problem(work, "simplex")
    return _backward(problem, _drjit(problem, "PermutoEncoding", 4))


def encode_simplex_fwd_vs_drjit_3d(work: Work) -> Match:
    """The same in a tet's three dimensions: 4 corners on both sides."""
    problem = _problem(work, "simplex")
    return _forward(problem, _drjit(problem, "PermutoEncoding", 3))


def encode_simplex_bwd_vs_drjit_3d(work: Work) -> Match:
    """Its gradient."""
    problem = _problem(work, "simplex")
    return _backward(problem, _drjit(problem, "PermutoEncoding", 3))


def encode_fwd_vs_torch(work: Work) -> Match:
    """A 4D hash grid in plain PyTorch."""
    problem = _problem(work, "grid")
    return _forward(problem, _torch_grid(problem))


def encode_bwd_vs_torch(work: Work) -> Match:
    """Its gradient."""
    problem = _problem(work, "grid")
    return _backward(problem, _torch_grid(problem))


def _forward(problem: Problem, peer: Peer) -> Match:
    def function(tables: HashTables, lambdas: jax.Array) -> jax.Array:
        return encode(tables, problem.config, jnp.zeros(len(lambdas), jnp.int32), lambdas)

    def describe(ours: jax.Array, theirs: Any) -> Row:
        if peer.features is None or peer.same is None:
            return {}
        levels = list(peer.same)
        error = np.asarray(ours).reshape(problem.cotangent.shape) - peer.features(theirs)
        return {"agree": float(np.mean(np.abs(error[:, levels]).max(axis=(1, 2)) < CLOSE))}

    return Match(spread(function, problem.tables, problem.lambdas), peer.encode, describe)


def _backward(problem: Problem, peer: Peer) -> Match:
    def function(tables: HashTables, items: tuple[jax.Array, jax.Array]) -> jax.Array:
        lambdas, cotangent = items
        tets = jnp.zeros(len(lambdas), jnp.int32)
        _, pull = jax.vjp(
            lambda x: encode(tables.replace(features=x), problem.config, tets, lambdas), tables.features
        )
        return pull(cotangent.reshape(len(lambdas), -1))[0]

    def describe(ours: jax.Array, theirs: Any) -> Row:
        if peer.gradient is None or peer.same is None:
            return {}
        gradient, expected = np.asarray(ours), peer.gradient(theirs)
        same = [
            np.abs(gradient[problem.entries(level)] - expected[entries]).max(axis=1) < CLOSE
            for level, entries in peer.same.items()
        ]
        return {"agree": float(np.mean(np.concatenate(same)))}

    call = spread(function, problem.tables, (problem.lambdas, problem.cotangent), out_specs=P(), threads=1)
    return Match(call, peer.pull, describe, ours_threads=1)


# ---- peers -------------------------------------------------------------------------------------------------


def _drjit(problem: Problem, name: str, dimension: int) -> Peer:
    """One of `drjit.nn`'s encodings, recorded once and replayed (`drjit.freeze`)."""
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.LLVM):
        raise Absent("Dr.Jit finds no LLVM library, 15 or newer; DRJIT_LIBLLVM_PATH can name one")
    import drjit.nn
    from drjit.llvm.ad import ArrayXf, Float

    resolutions = problem.config.resolutions

    class Encoding(getattr(drjit.nn, name)):
        def _level_scale(self, level: int) -> float:  # its own are not whole numbers
            return float(resolutions[level])

    encoding = Encoding(
        Float,
        dimension,
        n_levels=problem.config.num_levels,
        n_features_per_level=FEATURES,
        hashmap_size=problem.table_size,
        base_resolution=BASE,
        per_level_scale=problem.config.growth,
        align_corners=True,
    )
    points = ArrayXf(problem.lambdas[:, :dimension].T.copy())
    shape = problem.cotangent.shape
    cotangent = ArrayXf(problem.cotangent.reshape(shape[0], -1).T.copy())
    grid = name == "HashGridEncoding"
    same, data = {}, np.array(encoding.data).reshape(-1, FEATURES)
    for level in problem.hashed_levels() if grid else []:
        entries = slice(encoding.level_offset(level), encoding.level_offset(level + 1))
        if (resolutions[level] + 1) ** dimension > problem.table_size:  # else it numbers them
            same[level] = entries
            data[entries] = problem.tables.features[problem.entries(level)]
    encoding.data = Float(data.reshape(-1))
    dr.eval(encoding.data, points, cotangent)

    @dr.freeze
    def features(encoding: Any, points: Any) -> Any:
        return encoding(points)

    @dr.freeze
    def gradient(encoding: Any, points: Any, cotangent: Any) -> Any:
        table = encoding.data
        dr.enable_grad(table)
        values = encoding(points)
        dr.set_grad(values, cotangent)
        dr.enqueue(dr.ADMode.Backward, values)
        dr.traverse(dr.ADMode.Backward)
        result = dr.grad(table)
        dr.disable_grad(table)
        return result

    def finished(call: Callable[..., Any], *arguments: Any) -> Any:
        result = call(*arguments)
        dr.eval(result)
        dr.sync_thread()
        return result

    return Peer(
        encode=lambda: finished(features, encoding, points),
        pull=lambda: finished(gradient, encoding, points, cotangent),
        features=(lambda result: np.array(result).T.reshape(shape)) if grid else None,
        gradient=(lambda result: np.array(result).reshape(-1, FEATURES)) if grid else None,
        same=same if grid else None,
    )


def _torch_grid(problem: Problem) -> Peer:
    """Every level hashed; all levels at once, one gather a corner, as PyTorch without kernels does it."""
    import torch

    torch.set_num_threads(CORES)
    size, num_levels = problem.table_size, problem.config.num_levels
    table = np.zeros((num_levels, size, FEATURES), np.float32)
    same = {level: slice(level * size, (level + 1) * size) for level in problem.hashed_levels()}
    for level in same:
        table[level] = problem.tables.features[problem.entries(level)]
    table = torch.tensor(table.reshape(-1, FEATURES), requires_grad=True)
    points, cotangent = torch.tensor(problem.lambdas), torch.tensor(problem.cotangent)
    resolutions = torch.tensor(problem.config.resolutions, dtype=torch.float32)
    offsets = size * torch.arange(num_levels)

    def features() -> Any:
        scaled = points[:, None, :] * resolutions[:, None]  # [M, L, 4]
        low = torch.floor(scaled)
        fractions, low = scaled - low, low.long()
        total = 0
        for corner in itertools.product((0, 1), repeat=4):
            weight, entry = 1, 0
            for axis, (side, prime) in enumerate(zip(corner, NGP_PRIMES, strict=True)):
                fraction = fractions[..., axis]
                weight = weight * (fraction if side else 1 - fraction)
                entry = entry ^ ((low[..., axis] + side) * prime)
            total = total + weight[..., None] * table[(entry & (size - 1)) + offsets]
        return total

    values = features()

    def encode_only() -> Any:
        with torch.no_grad():
            return features()

    return Peer(
        encode=encode_only,
        pull=lambda: torch.autograd.grad(values, table, cotangent, retain_graph=True)[0],
        features=lambda result: result.numpy(),
        gradient=lambda result: result.numpy(),
        same=same,
    )
