"""encoding.layout: who owns which table entry."""

import itertools
import math

import numpy as np
import oracles
import pytest
from meshes import cube, delaunay, nonconvex, one_tet
from numpy.testing import assert_array_equal

from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.encoding.layout import SIZE_BITS, build_layout, slab_half_width

KINDS = list(itertools.product(["per_simplex", "per_tet"], ["grid", "simplex"]))


def config_of(layout, interpolation, **rest):
    return EncodingConfig(layout=layout, interpolation=interpolation, **({"num_levels": 6} | rest))


def reachable_nodes(resolution, half_width):
    axis = np.arange(resolution + 1)
    nodes = np.stack(np.meshgrid(axis, axis, axis, axis), axis=-1).reshape(-1, 4)
    return nodes[np.abs(nodes.sum(axis=1) - resolution) <= half_width]


def owner(layout_name, tet, corners, node):
    """The sub-simplex that a node lies on, as a key equal for all tets that share it."""
    if layout_name == "per_tet":
        return ("tet", tet)
    return tuple(int(v) for v, u in zip(corners, node, strict=True) if u > 0)


@pytest.mark.parametrize("layout_name, interpolation", KINDS)
def test_regions_never_alias(layout_name, interpolation):
    """Each entry belongs to one sub-simplex, and all lie inside the table."""
    vertices, tets = cube()
    config = config_of(layout_name, interpolation, num_levels=4, log2_tet_table=8)
    layout = build_layout(vertices, tets, config)
    order = np.asarray(layout.corner_order)
    for level, resolution in enumerate(config.resolutions):
        owners = {}
        for tet in range(len(tets)):
            for node in reachable_nodes(resolution, slab_half_width(config)):
                entry = oracles.node_entry(layout, config, level, tet, node)
                assert layout.starts[level] <= entry < layout.starts[level + 1]
                key = owner(layout_name, tet, tets[tet][order[tet]], node)
                assert owners.setdefault(entry, key) == key


@pytest.mark.parametrize("layout_name", ["per_simplex", "per_tet"])
def test_packed_regions_are_disjoint_on_a_larger_mesh(layout_name):
    vertices, tets = nonconvex()
    config = config_of(layout_name, "grid", num_levels=7)
    layout = build_layout(vertices, tets, config)
    for level in range(7):
        regions = np.asarray(layout.regions[level])
        dense = oracles.is_dense(layout, level)
        unique = np.unique(regions)
        starts, sizes = unique >> SIZE_BITS, 1 << (unique & ((1 << SIZE_BITS) - 1))
        ends = starts + (1 if dense else sizes)
        assert np.all(starts[1:] >= ends[:-1])
        size = layout.starts[level + 1] - layout.starts[level]
        assert ends.max() <= size
        if not dense:
            assert ends.max() == size  # nothing is wasted


@pytest.mark.parametrize("layout_name, interpolation", KINDS)
def test_dense_levels_are_collision_free_and_full(layout_name, interpolation):
    vertices, tets = cube()
    config = config_of(layout_name, interpolation, num_levels=3)
    layout = build_layout(vertices, tets, config)
    order = np.asarray(layout.corner_order)
    dense = 0
    for level, resolution in enumerate(config.resolutions):
        if not oracles.is_dense(layout, level):
            continue
        dense += 1
        used = {}
        for tet in range(len(tets)):
            corners = tets[tet][order[tet]]
            for node in reachable_nodes(resolution, slab_half_width(config)):
                entry = oracles.node_entry(layout, config, level, tet, node)
                place = (
                    owner(layout_name, tet, corners, node),
                    tuple(u for u in node if u or layout_name == "per_tet"),
                )
                assert used.setdefault(entry, place) == place
        missing = set(range(*map(int, layout.starts[level : level + 2]))) - set(used)
        assert len(missing) <= 1  # entry 0, the all-zero node, is only reachable at coarse levels
    assert dense >= 2


def test_neighbours_agree_on_the_nodes_of_their_common_face():
    vertices, tets = delaunay(count=10)
    for interpolation in ("grid", "simplex"):
        config = config_of("per_simplex", interpolation, num_levels=5, log2_tet_table=8)
        layout = build_layout(vertices, tets, config)
        order = np.asarray(layout.corner_order)
        places = {}
        for level, resolution in enumerate(config.resolutions):
            nodes = reachable_nodes(resolution, 0)
            for tet in range(len(tets)):
                for node in nodes[(nodes == 0).any(axis=1)][::7]:
                    corners = tets[tet][order[tet]]
                    place = (level, *((int(v), int(u)) for v, u in zip(corners, node, strict=True) if u))
                    entry = oracles.node_entry(layout, config, level, tet, node)
                    assert places.setdefault(place, entry) == entry


@pytest.mark.parametrize("interpolation", ["grid", "simplex"])
@pytest.mark.parametrize("make", [one_tet, cube, delaunay, nonconvex])
@pytest.mark.parametrize("log2", [8, 11])
def test_per_simplex_is_never_larger_than_per_tet(make, interpolation, log2):
    """At the same H' (Sec. 5.1's range): levels may grow with the resolution, never over the budget."""
    vertices, tets = make()
    sizes = {}
    for name in ("per_simplex", "per_tet"):
        config = config_of(name, interpolation, num_levels=16, log2_tet_table=log2)
        sizes[name] = np.diff(build_layout(vertices, tets, config).starts)
    budget = len(tets) << log2
    assert max(sizes["per_simplex"]) <= budget
    assert max(sizes["per_tet"]) <= budget
    assert sum(sizes["per_simplex"]) <= sum(sizes["per_tet"])


def hashed_regions(vertices, tets, config):
    """Entries of the finest level, and the size of each sub-simplex' region, by its vertices."""
    layout = build_layout(vertices, tets, config)
    order = np.asarray(layout.corner_order)
    found = {}
    for tet, regions in enumerate(np.asarray(layout.regions[-1])):
        corners = tets[tet][order[tet]]
        for mask in range(1, 16):
            key = tuple(int(corners[i]) for i in range(4) if mask >> i & 1)
            assert found.setdefault(key, regions[mask]) == regions[mask]
    sizes = {key: 1 << int(region % (1 << SIZE_BITS)) for key, region in found.items()}
    return int(layout.starts[-1] - layout.starts[-2]), sizes


def doubled_in_turn(vertices, tets, resolution, budget):
    """Sizes by vertices: always the region with most nodes times area for each entry, while it fits."""
    volumes = np.abs(np.linalg.det(np.diff(vertices[tets], axis=1)))
    areas = np.maximum(volumes ** (2 / 3), np.median(volumes ** (2 / 3)) / 16).astype(np.float32)
    nodes, demand = {}, {}
    for tet, area in zip(tets.tolist(), areas.tolist(), strict=True):
        for size in range(1, 5):
            for key in itertools.combinations(sorted(tet), size):
                nodes[key] = math.comb(resolution - 1, size - 1)
                demand[key] = max(demand.get(key, 0), nodes[key] * area)
    sizes, left = dict.fromkeys(nodes, 1), budget - 1 - len(nodes)
    growing = sorted(nodes, key=lambda key: (len(key), key))  # of equal ones the first
    while growing:
        key = max(growing, key=lambda key: demand[key] / sizes[key])
        if sizes[key] >= nodes[key] or sizes[key] > left:
            growing.remove(key)
        else:
            left -= sizes[key]
            sizes[key] *= 2
    return sizes


@pytest.mark.parametrize(
    "rule",
    [
        {"log2_tet_table": 3},
        {"log2_tet_table": 9},
        {"log2_table_size": 14, "min_log2_tet_table": 1},  # 96 entries for each of 170 tets
        {"log2_table_size": 9, "min_log2_tet_table": 1},  # not one for each sub-simplex
    ],
)
def test_regions_double_where_there_is_most_to_keep_for_each_entry(rule):
    """Areas of the cage's tets differ by a factor of 48."""
    vertices, tets = delaunay(count=40)
    config = config_of("per_simplex", "simplex", num_levels=6, growth=2.0, **rule)
    entries, sizes = hashed_regions(vertices, tets, config)
    budget = config.level_budget(len(tets))
    assert sizes == doubled_in_turn(vertices, tets, config.resolutions[-1], budget)
    assert entries == 1 + sum(sizes.values())
    assert entries <= max(budget, 1 + len(sizes))


@pytest.mark.parametrize("make", [one_tet, cube, delaunay, nonconvex])
@pytest.mark.parametrize(
    "rule", [{"log2_tet_table": 9}, {"log2_table_size": 11, "min_log2_tet_table": 4}]
)
def test_hashed_levels_use_the_budget(make, rule):
    """A limit that is respected by storing nothing would be worthless."""
    vertices, tets = make()
    config = config_of("per_simplex", "simplex", num_levels=8, growth=2.0, **rule)
    entries, _ = hashed_regions(vertices, tets, config)
    budget = config.level_budget(len(tets))
    assert 0.97 * budget < entries <= budget  # a single tet has too few regions to use all of it
    assert len(tets) == 1 or entries == budget


def test_flat_tets_have_tables():
    """As if their area were a sixteenth of the median."""
    vertices, tets = delaunay(count=40)
    flat = vertices.copy()
    flat[tets[0, 0]] = vertices[tets[0, 1:]].mean(axis=0)
    config = config_of("per_simplex", "simplex", num_levels=6, growth=2.0, log2_tet_table=9)
    _, sizes = hashed_regions(flat, tets, config)
    inside = np.array([sizes[tuple(sorted(tet))] for tet in tets.tolist()])
    assert inside[0] >= np.median(inside) / 32  # sizes are powers of two


def test_sizes_do_not_depend_on_the_unit_of_length():
    vertices, tets = delaunay(count=40)
    config = config_of("per_simplex", "simplex", num_levels=9)
    expected = build_layout(vertices, tets, config).regions
    assert_array_equal(build_layout(1024 * vertices, tets, config).regions, expected)


def test_offsets_that_do_not_fit_their_integers_are_refused():
    vertices, tets = nonconvex()
    config = config_of("per_tet", "grid", num_levels=14, log2_tet_table=20)
    with pytest.raises(ValueError, match="entries"):
        build_layout(vertices, np.tile(tets, (3, 1)), config)


def test_corner_order_sorts_by_vertex_id():
    vertices, tets = delaunay(count=12)
    layout = build_layout(vertices, tets, config_of("per_simplex", "grid"))
    ordered = np.take_along_axis(tets, np.asarray(layout.corner_order), axis=1)
    assert np.all(np.diff(ordered, axis=1) > 0)
    layout = build_layout(vertices, tets, config_of("per_tet", "grid"))
    assert_array_equal(layout.corner_order, np.broadcast_to(np.arange(4), tets.shape))


def test_table_size_follows_the_paper():
    """H' = clip(H - floor(log2 T + 1), 8, 11): the sizes that notes give for the paper's meshes."""
    config = EncodingConfig(log2_table_size=19)
    assert [config.tet_table_size(t) for t in (6, 294, 545, 1754, 100_000)] == [2048, 1024, 512, 256, 256]
