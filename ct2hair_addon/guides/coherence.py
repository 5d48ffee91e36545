"""Signs of the nodes of a signed graph, so that what is bound together agrees: which way each of many strands runs.

The problem is an Ising spin glass's ground state: NP-hard, but these graphs are nearly free of frustration, hair being combed.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy.sparse import csr_matrix

ROUNDS = 200
"""Sweeps of the signs at most; they settle in a few dozen, and of those all but the first ask few nodes."""
GAIN = 3.0
"""How fast a node grows certain with what it hears."""
STILL = 1e-3
"""A node that changes by less is not worth asking its neighbours again."""


def settled(
    graph: csr_matrix,
    scale: np.ndarray,
    start: np.ndarray,
    sure: np.ndarray,
    hint: np.ndarray | float = 0.0,
    gain: float = GAIN,
) -> np.ndarray:
    """(N,) float64 in [-1, 1]: the mean-field solution next to `start`, where each node hears its neighbours, one by one.

    graph: (N, N), symmetric, above 0 where two agree if they have the same sign. scale: (N,) the sums of its absolute rows.
    sure: (N,) bool, nodes that stay as they start. hint: (N,) what each holds for itself, neighbours saying up to 1 in all.
    gain: up to 1 no node holds more than it was told by those that are sure; the higher, the sooner what is heard first holds.
    """
    value = start.astype(np.float64)
    own = np.full(len(value), hint, np.float64)
    _settle(graph.indptr, graph.indices, graph.data, np.maximum(scale, 1e-9), np.asarray(sure, bool), own, gain, value)
    return value


@numba.njit(cache=True)
def _settle(starts, columns, bonds, scale, sure, own, gain, value):
    """Nodes take what they hear in turn, those of which a neighbour has changed, until none has."""
    asked = ~sure
    for _ in range(ROUNDS):
        still = True
        for n in range(len(value)):
            if not asked[n]:
                continue
            asked[n] = False
            total = 0.0
            for k in range(starts[n], starts[n + 1]):
                total += bonds[k] * value[columns[k]]
            heard = np.tanh(gain * (total / scale[n] + own[n]))
            changed = abs(heard - value[n]) > STILL
            value[n] = heard
            if changed:
                still = False
                for k in range(starts[n], starts[n + 1]):
                    asked[columns[k]] = not sure[columns[k]]
        if still:
            return


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
