"""What the core computes, again in plain NumPy loops and float64: slow, short, written from the paper."""

import itertools

import numpy as np

from nimpostor_jax.encoding.layout import SIZE_BITS


def barycentric(point, corners):
    """Solve p = sum_i lambda_i v_i, sum_i lambda_i = 1."""
    system = np.vstack([np.asarray(corners, np.float64).T, np.ones(4)])
    return np.linalg.solve(system, np.append(point, 1.0))


def ray_segments(vertices, tets, origin, direction, near=0.0):
    """Every tet that the ray crosses: (t_enter, t_exit, tet, lambda_enter, lambda_exit), by t_enter.

    Barycentric coordinates are affine along the ray; each must stay >= 0: four slabs clip the line.
    """
    systems = np.concatenate([vertices[tets].transpose(0, 2, 1), np.ones((len(tets), 1, 4))], axis=1)
    start = np.linalg.solve(systems, np.append(origin, 1.0)[:, None])[..., 0]
    slope = np.linalg.solve(systems, np.append(direction, 0.0)[:, None])[..., 0]
    found = []
    for tet in range(len(tets)):
        low, high = near, np.inf
        for a, b in zip(start[tet], slope[tet], strict=True):
            if abs(b) < 1e-13:
                high = high if a >= -1e-13 else -np.inf
            elif b > 0:
                low = max(low, -a / b)
            else:
                high = min(high, -a / b)
        if high > low:
            ends = (start[tet] + low * slope[tet], start[tet] + high * slope[tet])
            found.append((low, high, tet, *ends))
    return sorted(found, key=lambda segment: segment[0])


def union_length(segments):
    """Length of the union of intervals (a ray along a face lies in both tets beside it)."""
    total, end = 0.0, -np.inf
    for low, high, *_ in segments:
        total += max(0.0, high - max(low, end))
        end = max(end, high)
    return total


def composite(sigmas, deltas):
    """Weights of Eq. 1 with an exclusive transmittance, by a loop along one ray."""
    weights, light = [], 1.0
    for sigma, delta in zip(sigmas, deltas, strict=True):
        absorbed = -np.expm1(-sigma * delta)
        weights.append(light * absorbed)
        light *= 1 - absorbed
    return np.array(weights)


def is_dense(layout, level):
    """Whether a level's nodes are numbered without collisions."""
    return level < len(layout.rank_starts) - 1


def node_entry(layout, config, level, tet, node):
    """The table entry of a grid node, given in the order of the tet's canonical corners."""
    resolution, start = config.resolutions[level], int(layout.starts[level])
    regions = np.asarray(layout.regions[level])
    mask = sum(1 << i for i, u in enumerate(node) if u > 0)
    region = int(regions[tet, 0 if regions.shape[1] == 1 else mask])
    offset, log2 = region >> SIZE_BITS, region % (1 << SIZE_BITS)
    if is_dense(layout, level):
        index = sum(u * (resolution + 1) ** i for i, u in enumerate(node))
        return start + offset + int(layout.dense_ranks[int(layout.rank_starts[level]) + index])
    hashed = 0
    for u, multiplier in zip(node, np.asarray(layout.multipliers)[tet], strict=True):
        hashed ^= int(u) * int(multiplier) % (1 << 32)
    return start + offset + hashed % (1 << log2)


def grid_nodes(coordinates, resolution):
    """The 16 corners of the voxel around a point and their 4-linear weights (Sec. 3.3)."""
    scaled = np.asarray(coordinates) * resolution
    low = np.clip(np.floor(scaled), 0, resolution - 1).astype(int)
    for bits in itertools.product((0, 1), repeat=4):
        sides = [f if b else 1 - f for f, b in zip(scaled - low, bits, strict=True)]
        yield low + bits, np.prod(sides)


def simplex_nodes(coordinates, resolution):
    """The corners of the point's simplex in the edgewise subdivision, by sorting fractions."""
    cumulative = resolution * np.cumsum(coordinates)[:3]
    low = np.clip(np.floor(cumulative), 0, resolution - 1).astype(int)
    fractions = cumulative - low
    order = sorted(range(3), key=lambda axis: (-fractions[axis], -axis))
    ends = [1.0, *fractions[order], 0.0]
    corner = low.copy()
    for step in range(4):
        yield np.diff([0, *corner, resolution]), ends[step] - ends[step + 1]
        if step < 3:
            corner[order[step]] += 1


def encode(features, layout, config, tet, coordinates):
    """Features of one point, level by level, from nodes and their entries."""
    canonical = np.asarray(coordinates, np.float64)[np.asarray(layout.corner_order)[tet]]
    nodes = grid_nodes if config.interpolation == "grid" else simplex_nodes
    table, levels = np.asarray(features, np.float64), []
    for level, resolution in enumerate(config.resolutions):
        terms = [
            w * table[node_entry(layout, config, level, tet, u)] for u, w in nodes(canonical, resolution) if w
        ]
        levels.append(np.sum(terms, axis=0))
    return np.concatenate(levels)


def directional_difference(function, x, direction, step=1e-6):
    """Central difference of a scalar function along a direction; x and direction are pytrees' flat arrays."""
    return (float(function(x + step * direction)) - float(function(x - step * direction))) / (2 * step)
