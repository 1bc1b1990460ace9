"""Marching cubes: surfaces without cracks for any signs, in place and the right way out for known ones."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from advtex_engine.core.scene import Mesh
from advtex_engine.mesh.marching_cubes import extract_surface
from advtex_engine.mesh.tsdf import BLOCK, VOXELS, VoxelBlocks, block_corners, encode_blocks


def blocks_of(values: np.ndarray, first: tuple[int, int, int], voxel_size: float = 1.0) -> VoxelBlocks:
    """Blocks from `first` on that hold `values` [X,Y,Z], whose sides are multiples of BLOCK."""
    counts = [side // BLOCK for side in values.shape]
    block = torch.cartesian_prod(*[torch.arange(count) for count in counts]).view(-1, 3) + torch.tensor(first)
    keys, order = encode_blocks(block).sort()
    split = torch.from_numpy(values).float().reshape(counts[0], BLOCK, counts[1], BLOCK, counts[2], BLOCK)
    distance = split.permute(0, 2, 4, 1, 3, 5).reshape(-1, VOXELS)[order]
    return VoxelBlocks(voxel_size, keys, distance)


def directed_edges(mesh: Mesh) -> np.ndarray:
    return mesh.t_pos_idx.numpy()[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def assert_closed(mesh: Mesh) -> None:
    """Every edge has one face on each side, and both walk it in opposite directions."""
    edges = directed_edges(mesh)
    forth = np.sort(edges[:, 0] * len(mesh.v_pos) + edges[:, 1])
    back = np.sort(edges[:, 1] * len(mesh.v_pos) + edges[:, 0])
    assert (np.diff(forth) > 0).all()
    assert np.array_equal(forth, back)


def volume(mesh: Mesh) -> float:
    a, b, c = mesh.v_pos.double()[mesh.t_pos_idx].unbind(1)
    return float((torch.linalg.cross(a, b) * c).sum()) / 6


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.02, 0.98))
def test_any_signs_give_a_closed_surface_across_blocks(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    values = rng.uniform(0.01, 3.9, (16, 8, 16))
    inner = tuple(slice(1, side - 1) for side in values.shape)
    values[inner] *= np.where(rng.random(values[inner].shape) < share, -1, 1)
    mesh = extract_surface(blocks_of(values, (-1, 0, 3)))
    assert len(mesh.t_pos_idx) > 0
    assert_closed(mesh)
    assert volume(mesh) > 0
    assert len(np.unique(mesh.t_pos_idx.numpy())) == len(mesh.v_pos)


def sphere_values(radius: float, center: float, side: int) -> np.ndarray:
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1)
    return np.linalg.norm(grid - center, axis=-1) - radius


def test_a_sphere_comes_out_in_place_and_faces_outward() -> None:
    size = 0.01
    mesh = extract_surface(blocks_of(sphere_values(9.3, 15.6, 32) * size, (-4, -4, -4), size))
    assert_closed(mesh)
    center = (-4 * BLOCK + 15.6) * size
    radii = (mesh.v_pos.double() - center).norm(dim=1)
    assert float((radii - 9.3 * size).abs().max()) < 0.02 * size
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * (9.3 * size) ** 3, rel=0.01)


def test_what_was_not_observed_stays_open() -> None:
    values = sphere_values(9.3, 15.6, 32)
    values[:, :, 20:] = np.nan
    mesh = extract_surface(blocks_of(values, (0, 0, 0)))
    edges = {tuple(edge) for edge in directed_edges(mesh)}
    border = {edge for edge in edges if edge[::-1] not in edges}
    assert border
    heights = mesh.v_pos[torch.tensor(sorted(border))[:, 0], 2]
    assert float(heights.min()) > 18
    assert float(mesh.v_pos[mesh.t_pos_idx, 2].max()) <= 19


def test_without_a_neighboring_block_the_surface_ends() -> None:
    whole = blocks_of(sphere_values(9.3, 15.6, 32), (0, 0, 0))
    half = VoxelBlocks(1.0, whole.keys[:32], whole.distance[:32])
    mesh = extract_surface(half)
    assert float(mesh.v_pos[mesh.t_pos_idx, 0].max()) <= 15
    assert len(mesh.t_pos_idx) > 0


def test_blocks_without_a_surface_give_no_faces() -> None:
    mesh = extract_surface(blocks_of(np.ones((8, 8, 8)), (0, 0, 0)))
    assert mesh.t_pos_idx.shape == (0, 3)


@given(st.lists(st.tuples(*[st.integers(-(2**20), 2**20 - 2)] * 3), min_size=1, max_size=20))
def test_keys_hold_block_coordinates(blocks: list[tuple[int, int, int]]) -> None:
    block = torch.tensor(blocks)
    assert torch.equal(block_corners(encode_blocks(block)), block * BLOCK)
