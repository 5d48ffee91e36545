"""Signs of the nodes of a signed graph, so that what is bound together agrees: which way each of many strands runs.

The problem is an Ising spin glass's ground state: NP-hard, but these graphs are nearly free of frustration, hair being combed.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy.sparse import csr_matrix

ROUNDS = 200
"""Sweeps of the signs at most; they settle in a few dozen."""
GAIN = 3.0
"""How fast a node grows certain with what it hears."""


def settled(
    graph: csr_matrix, scale: np.ndarray, start: np.ndarray, sure: np.ndarray, hint: np.ndarray | float = 0.0
) -> np.ndarray:
    """(N,) float64 in [-1, 1]: the mean-field solution next to `start`, where each node hears its neighbours.

    graph: (N, N), symmetric, above 0 where two agree if they have the same sign. scale: (N,) the sums of its absolute rows.
    sure: (N,) bool, nodes that stay as they start. hint: (N,) what each holds for itself, neighbours saying up to 1 in all.
    """
    value = start.astype(np.float64)
    for _ in range(ROUNDS):
        around = _summed(graph.indptr, graph.indices, graph.data, value)
        heard = np.where(sure, start, np.tanh(GAIN * (around / np.maximum(scale, 1e-9) + hint)))
        change = np.abs(heard - value).max(initial=0.0)
        value = 0.5 * (value + heard)
        if change < 1e-3:
            break
    return value


@numba.njit(cache=True, parallel=True)
def _summed(starts, columns, bonds, value):
    """The product of a graph with `value` (N,), on all threads, where scipy's runs on one."""
    out = np.empty(len(value))
    for n in numba.prange(len(value)):
        total = 0.0
        for k in range(starts[n], starts[n + 1]):
            total += bonds[k] * value[columns[k]]
        out[n] = total
    return out


def contracted(graph: csr_matrix, field: np.ndarray) -> np.ndarray:
    """(N,) float64, 1 or -1: signs that agree over as much of a graph (as above) as hangs together, not only nearby.

    In rounds, as Boruvka's trees grow: each cluster joins the one that it is bound to the most for their sizes, turned if they
    disagree, and the bonds of both are summed. A cluster whose `field` (N,), summed over its nodes, is stronger than any bond
    of it asks for no more. At last each cluster turns to its field. A few nodes are still to settle among their neighbours.
    """
    graph, field = graph.tocsr(), np.asarray(field, np.float64)
    label, sign, size = np.arange(len(field)), np.ones(len(field)), np.ones(len(field))
    while True:
        leader, parity = _strongest(graph, field, size)
        leads = leader == np.arange(len(leader))
        if leads.all():
            break
        new = (np.cumsum(leads) - 1)[leader]
        count = int(leads.sum())
        row = np.repeat(np.arange(len(leader)), np.diff(graph.indptr))
        data = graph.data * parity[row] * parity[graph.indices]
        outer = new[row] != new[graph.indices]
        graph = csr_matrix((data[outer], (new[row[outer]], new[graph.indices[outer]])), shape=(count, count))
        field, size = np.bincount(new, parity * field, count), np.bincount(new, size, count)
        sign, label = sign * parity[label], new[label]
    return sign * np.where(field < 0.0, -1.0, 1.0)[label]


def _strongest(graph: csr_matrix, field: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(leader (N,): the node at the end of each one's chain of strongest bonds, parity (N,): its sign against that)."""
    count = len(field)
    leader, parity = np.arange(count), np.ones(count)
    degree = np.diff(graph.indptr)
    bound = np.flatnonzero(degree)
    if not len(bound):
        return leader, parity
    row, strength = np.repeat(np.arange(count), degree), np.abs(graph.data)
    most = np.zeros(count)
    most[bound] = np.maximum.reduceat(strength, graph.indptr[bound])
    strength /= np.sqrt(size[row] * size[graph.indices])
    best = np.maximum.reduceat(strength, graph.indptr[bound])
    # of equals the first node: chains then close nowhere but in pairs
    place = np.flatnonzero(strength == np.repeat(best, degree[bound]))[::-1]
    leader[row[place]], parity[row[place]] = graph.indices[place], np.sign(graph.data[place])
    alone = np.abs(field) >= most
    first = (leader[leader] == np.arange(count)) & (np.arange(count) < leader) & ~alone[leader]
    alone |= first
    leader[alone], parity[alone] = np.flatnonzero(alone), 1.0
    for _ in range(count.bit_length()):
        parity, leader = parity * parity[leader], leader[leader]
    # bonds that differ by their rounding alone, seen from either end, might close a chain: it waits for the next round
    closed = leader[leader] != leader
    leader[closed], parity[closed] = np.flatnonzero(closed), 1.0
    return leader, parity
