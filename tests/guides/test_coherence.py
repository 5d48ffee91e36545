"""Signs of a signed graph: what hangs together agrees, and turns to its field."""

import itertools

import numpy as np
import pytest
from scipy.sparse import coo_matrix, csr_matrix

from ct2hair_addon.guides.coherence import contracted, settled
from ct2hair_addon.guides.direction import GAINS

NEIGHBOURS = [(0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)]


def signed_grid(side: int, planted: np.ndarray, lying: float, generator: np.random.Generator) -> csr_matrix:
    """A grid of side x side nodes, each bound to the twelve around it: bonds say how the planted signs of their ends agree, but
    for a share that is `lying`."""
    node = np.arange(side * side).reshape(side, side)
    one, other = [], []
    for down, right in NEIGHBOURS:
        one.append(node[: side - down, max(-right, 0) : side - max(right, 0)].ravel())
        other.append(node[down:, max(right, 0) : side + min(right, 0)].ravel())
    one, other = np.concatenate(one), np.concatenate(other)
    bond = planted[one] * planted[other] * generator.uniform(0.5, 1.5, len(one))
    bond *= np.where(generator.random(len(one)) < lying, -1.0, 1.0)
    graph = coo_matrix((bond, (one, other)), shape=(side * side, side * side))
    return (graph + graph.T).tocsr()


def mixed(generator: np.random.Generator, graph: csr_matrix, *of_nodes: np.ndarray):
    """The same with its nodes in any order, as pieces come: none is asked before the one beside it."""
    order = generator.permutation(graph.shape[0])
    return graph[order][:, order], *(values[order] for values in of_nodes)


@pytest.mark.parametrize("side", [4, 40])
def test_signs_without_contradiction_are_found_exactly(side):
    generator = np.random.default_rng(side)
    planted = generator.choice([-1.0, 1.0], side * side)
    graph = signed_grid(side, planted, 0.0, generator)
    field = np.zeros(side * side)
    field[0] = 0.01 * planted[0]  # one node in all of them knows its sign
    np.testing.assert_array_equal(contracted(graph, field), planted)


def test_one_bond_in_twenty_that_lies_costs_few_signs_and_no_walls():
    generator = np.random.default_rng(7)
    planted = generator.choice([-1.0, 1.0], 3600)
    graph = signed_grid(60, planted, 0.05, generator)
    # what each node holds for itself is mostly wrong, far from where the truth is known
    field = 0.005 * planted * np.where(np.arange(3600) < 1400, 1.0, -0.6)
    assert (planted * field).sum() > 0.0
    graph, planted, field = mixed(generator, graph, planted, field)
    scale, nobody = np.asarray(abs(graph).sum(axis=1)).ravel(), np.zeros(3600, bool)
    sign = contracted(graph, field)
    assert np.mean(sign == planted) > 0.9
    assert np.mean(np.sign(settled(graph, scale, sign, nobody)) == planted) > 0.99
    nearby = settled(graph, scale, np.zeros(3600), nobody, field / scale)
    assert np.mean(np.sign(nearby) == planted) < 0.6


def test_what_settles_is_what_each_node_hears():
    generator = np.random.default_rng(11)
    planted = generator.choice([-1.0, 1.0], 900)
    graph = signed_grid(30, planted, 0.1, generator)
    scale = np.asarray(abs(graph).sum(axis=1)).ravel()
    sure = generator.random(900) < 0.05
    hint = 0.1 * generator.normal(size=900)
    for gain in (1.1, 3.0):
        value = settled(graph, scale, planted * sure, sure, hint, gain)
        np.testing.assert_array_equal(value[sure], planted[sure])
        heard = np.tanh(gain * (graph @ value / scale + hint))
        np.testing.assert_allclose(value[~sure], heard[~sure], atol=0.01)
    assert np.mean(np.sign(value) == planted) > 0.97


def test_signs_that_grow_certain_together_leave_no_walls_where_fronts_met():
    """Of those that are sure, in two rows along one side, one in four is wrong, and one bond in five lies."""
    found = []
    for seed in range(6):
        generator = np.random.default_rng(seed)
        graph = signed_grid(60, np.ones(3600), 0.2, generator)
        start = np.zeros(3600)
        start[:120] = np.where(generator.random(120) < 0.25, -1.0, 1.0)
        graph, start = mixed(generator, graph, start)
        scale, sure = np.asarray(abs(graph).sum(axis=1)).ravel(), start != 0
        value = start
        for gain in GAINS:
            value = settled(graph, scale, value, sure, gain=gain)
        found.append([np.mean(signs[~sure] > 0) for signs in (settled(graph, scale, start, sure), value)])
    at_once, together = np.mean(found, axis=0)
    assert together > 0.95 > 0.8 > at_once


def test_small_graphs_come_close_to_the_best_signs_of_all():
    generator = np.random.default_rng(3)
    signs = np.array(list(itertools.product([-1.0, 1.0], repeat=10)))
    reached = []
    for _ in range(30):
        bond = np.triu(generator.normal(0.7, 1.0, (10, 10)) * (generator.random((10, 10)) < 0.4), 1)
        bond += bond.T
        best = np.einsum("ni,ij,nj->n", signs, bond, signs).max()
        found = contracted(csr_matrix(bond), np.zeros(10))
        reached.append(found @ bond @ found / best)
    assert np.mean(reached) > 0.93


def test_each_part_turns_to_its_own_field_and_a_strong_one_asks_nobody():
    parts = coo_matrix(([1.0, -1.0, 0.2], ([0, 2, 1], [1, 3, 2])), shape=(5, 5))
    graph = (parts + parts.T).tocsr()
    # 0 and 1 agree, 2 and 3 don't; the bond between 1 and 2 is weaker than either pair's field; 4 has no bond at all
    assert contracted(graph, np.array([0.4, 0.0, -0.5, 0.0, -1.0])).tolist() == [1, 1, -1, 1, -1]
    assert contracted(graph, np.array([0.4, 0.0, -0.05, 0.0, 0.0])).tolist() == [1, 1, 1, -1, 1]


def test_no_nodes_and_no_bonds():
    assert len(contracted(csr_matrix((0, 0)), np.zeros(0))) == 0
    assert contracted(csr_matrix((3, 3)), np.array([1.0, -2.0, 0.0])).tolist() == [1, -1, 1]
