"""One view per face: a Markov random field over the mesh.

Nodes are faces, their labels the candidate views, edges the mesh's inner edges. The seam between two faces that show
different views costs its visibility: a constant, and how much the two views differ in color along the edge that the
faces share (as in graph-cut textures, Kwatra et al. 2003), so that seams run where views agree. Solved by
parallel min-sum message passing, and by descent from the labeling that it finds.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from advtex_engine.core.scene import Mesh, face_areas
from advtex_engine.selection.candidates import NO_VIEW, Candidates

SEAM_COST = 4.0  # of any seam of mean length, in units of the data term of a face of mean area
COLOR_COST = 0.1  # difference in color, of 1, that costs as much as SEAM_COST once more
MAX_COLOR_COST = 3.0
MESSAGE_ROUNDS = 30
DAMPING = 0.25
DESCENT_ROUNDS = 200
BLOCK = 1 << 16  # edges whose seams are compared at once: bounds the memory


@dataclass(frozen=True)
class Adjacency:
    """Inner edges of a mesh: face [E,2] on either side and, per side, the face's own side number [E,2] in 0..2.

    Side s of a face joins its corners s and s + 1. An edge with more than two faces joins them in a chain.
    """

    face: Tensor
    side: Tensor


def face_adjacency(t_pos_idx: Tensor) -> Adjacency:
    """Pairs of faces that share an edge, from vertex indices [T,3]."""
    ends = torch.stack((t_pos_idx, t_pos_idx.roll(-1, 1)), 2).sort(2).values.view(-1, 2)
    key, order = torch.sort(ends[:, 0] * (int(t_pos_idx.max()) + 1) + ends[:, 1], stable=True)
    pair = torch.stack((order[:-1], order[1:]), 1)[key[:-1] == key[1:]]
    return Adjacency(pair // 3, pair % 3)


def edge_ends(t_pos_idx: Tensor, adjacency: Adjacency, number: int) -> Tensor:
    """[E,2] corner numbers of the edges' ends in the first or second face, that of the lower vertex index first."""
    face, side = adjacency.face[:, number], adjacency.side[:, number]
    ends = torch.stack((side, (side + 1) % 3), 1)
    return ends.gather(1, t_pos_idx[face].gather(1, ends).argsort(1))


def seam_costs(t_pos_idx: Tensor, candidates: Candidates, adjacency: Adjacency) -> Tensor:
    """[E,K,K] cost of showing candidate a of the first and candidate b of the second face beside each other.

    In memory the edges of each pair of candidates lie side by side, as `solve` reads them.
    """
    count, kept = len(adjacency.face), candidates.view.shape[1]
    costs = torch.empty((kept, kept, count), device=t_pos_idx.device).permute(2, 0, 1)
    blocks = (torch.split(part, BLOCK) for part in (adjacency.face, adjacency.side, costs))
    for face, side, cost in zip(*blocks, strict=True):
        block = Adjacency(face, side)
        first, second = (_along_edge(t_pos_idx, candidates, block, number) for number in (0, 1))
        difference = torch.cdist(first, second, p=1) / first.shape[2]
        one, other = candidates.view[face].unbind(1)
        cost.copy_(SEAM_COST * (1 + (difference / COLOR_COST).clamp(max=MAX_COLOR_COST)))
        cost.masked_fill_(one[:, :, None] == other[:, None, :], 0.0)
    return costs


def _along_edge(t_pos_idx: Tensor, candidates: Candidates, adjacency: Adjacency, number: int) -> Tensor:
    """[E,K,9] colors in [0,1] at the edges' ends and midpoints, the end of the lower vertex index first."""
    places = torch.cat((edge_ends(t_pos_idx, adjacency, number), adjacency.side[:, number, None] + 3), 1)
    colors = candidates.color[adjacency.face[:, number, None], :, places]
    return colors.transpose(1, 2).flatten(2).to(torch.float32) / 255


def energy(choice: Tensor, unary: Tensor, pairs: Tensor, pairwise: Tensor) -> Tensor:
    """0-dim float64: data terms plus seams of a labeling [T] (candidate numbers)."""
    data = unary.gather(1, choice[:, None]).double().sum()
    edge = torch.arange(len(pairs), device=pairs.device)
    return data + pairwise[edge, choice[pairs[:, 0]], choice[pairs[:, 1]]].double().sum()


def solve(unary: Tensor, pairs: Tensor, pairwise: Tensor) -> Tensor:
    """A labeling [T] int64 of low energy: exact on small trees, never worse than descent from the best data terms.

    unary: [T,K]; pairs: [E,2] node indices; pairwise: [E,K,K], first node's label first.
    """
    alone = descend(unary.argmin(1), unary, pairs, pairwise)
    if len(pairs) == 0:
        return alone
    node, other = torch.cat((pairs[:, 0], pairs[:, 1])), torch.cat((pairs[:, 1], pairs[:, 0]))
    message = unary.new_zeros((len(node), unary.shape[1]))  # the e-th goes from node to other
    forth = pairwise.permute(1, 2, 0).contiguous()
    back = forth.transpose(0, 1)
    reverse = torch.arange(len(node), device=node.device).roll(len(pairs))
    for number in range(MESSAGE_ROUNDS):
        belief = unary.index_add(0, other, message)
        sent = belief[node] - message[reverse]
        new = torch.cat((_cheapest(sent[: len(pairs)], forth), _cheapest(sent[len(pairs) :], back)))
        new -= new.amin(1, keepdim=True)
        message = new if number == 0 else DAMPING * message + (1 - DAMPING) * new
    agreed = descend(unary.index_add(0, other, message).argmin(1), unary, pairs, pairwise)
    return min(agreed, alone, key=lambda choice: float(energy(choice, unary, pairs, pairwise)))


def _cheapest(sent: Tensor, costs: Tensor) -> Tensor:
    """[E,K]: of each label of an edge's other node the least sum of what is sent [E,K] and of the seam [K,K,E].

    All sums at once would be as much memory as the costs, and five times slower on a CPU.
    """
    rows = sent.T.contiguous()
    least = rows[0] + costs[0]
    for row, cost in zip(rows[1:], costs[1:], strict=True):
        torch.minimum(least, row + cost, out=least)
    return least.T


def descend(choice: Tensor, unary: Tensor, pairs: Tensor, pairwise: Tensor) -> Tensor:
    """Iterated conditional modes: nodes change to their best label given their neighbors' until none gains.

    In each round those nodes change that gain more than all of their neighbors, so that the energy falls every time.
    """
    edge = torch.arange(len(pairs), device=pairs.device)
    number = torch.arange(len(choice), device=choice.device)
    first, second = pairs.unbind(1)
    for _ in range(DESCENT_ROUNDS):
        local = unary.index_add(0, first, pairwise[edge, :, choice[second]])
        local.index_add_(0, second, pairwise[edge, choice[first], :])
        lowest, best = local.min(1)
        gain = local.gather(1, choice[:, None])[:, 0] - lowest
        beaten = torch.zeros_like(choice, dtype=torch.bool)
        for a, b in ((first, second), (second, first)):
            loses = (gain[b] > gain[a]) | ((gain[b] == gain[a]) & (number[b] < number[a]))
            beaten[a[loses]] = True
        moves = (gain > 1e-6) & ~beaten
        if not bool(moves.any()):
            break
        choice = torch.where(moves, best, choice)
    return choice


@dataclass(frozen=True)
class Assignment:
    """view: [T] int64, -1 where no view sees the face. agreement: [T] in [0,1] of its color with the other views'."""

    view: Tensor
    agreement: Tensor


def assign_views(mesh: Mesh, candidates: Candidates) -> Assignment:
    """One view per face, of least total energy.

    Data terms count by their face's area and seams by their length, over the means, so that it does not matter how
    finely the surface is cut: else a door of a few large faces is painted by a far view, to save a seam of two edges.
    """
    t_pos_idx = mesh.t_pos_idx
    adjacency = face_adjacency(t_pos_idx)
    seen = (candidates.view >= 0).any(1)
    both = seen[adjacency.face].all(1)
    adjacency = Adjacency(adjacency.face[both], adjacency.side[both])
    pairwise = seam_costs(t_pos_idx, candidates, adjacency)
    pairwise *= _over_mean(edge_lengths(mesh, adjacency))[:, None, None]
    cost = candidates.cost + candidates.disagreement
    # Costs are relative to the face's best: what all views of a face share decides nothing.
    area = face_areas(mesh)
    share = _over_mean(area, area[seen])
    unary = (cost - cost.amin(1, keepdim=True)) * share[:, None]
    unary.masked_fill_(candidates.view < 0, NO_VIEW * float(share.amax().clamp(min=1)))  # however small the face is
    choice = solve(unary, adjacency.face, pairwise)[:, None]
    agreement = torch.exp(-candidates.disagreement.gather(1, choice)[:, 0])
    return Assignment(candidates.view.gather(1, choice)[:, 0], agreement)


def edge_lengths(mesh: Mesh, adjacency: Adjacency) -> Tensor:
    """[E] metres."""
    ends = mesh.t_pos_idx[adjacency.face[:, :1], edge_ends(mesh.t_pos_idx, adjacency, 0)]
    lengths: Tensor = torch.linalg.vector_norm(mesh.v_pos[ends[:, 0]] - mesh.v_pos[ends[:, 1]], dim=1)
    return lengths


def _over_mean(measure: Tensor, counted: Tensor | None = None) -> Tensor:
    """[N] float32: sizes over the mean of those that are counted."""
    mean: Tensor = (measure if counted is None else counted).mean()
    return (measure / mean).float()
