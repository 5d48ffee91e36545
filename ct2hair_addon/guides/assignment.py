"""The cheapest set of joints in which no end is used twice: an assignment problem, solved by auction.

Bertsekas 1988, sparse, with a price for a row that is left without a column. Rows bid for the column that is cheapest to
them; where many want few, as in hair that lies in bundles, shortest augmenting paths wander through thousands of rows.
"""

from __future__ import annotations

from collections.abc import Mapping

import numba
import numpy as np

BID = 1e-2
"""By how much more a row bids than it must: no set of joints is cheaper than the one found by more than this for each row, in
practice by two millionths (a tip left loose costs 14 and more). A tenth of it takes four times as long."""
SHORT_LIST = 8
"""Columns that a row remembers as its cheapest: prices only rise, so while two of them stay below all the others were, those
need not be looked at."""


def assign(
    starts: np.ndarray, columns: np.ndarray, costs: np.ndarray, prices: Mapping[float, int], chosen: np.ndarray
) -> float:
    """Fill `chosen` (R,) int64: each row's column, or -1, at the least sum of costs, to BID a row; a row without one costs the
    price.

    Row r may have the columns `columns[starts[r]:starts[r + 1]]`, below R, at `costs`, none below 0. Of the rising `prices` the
    first that leaves no more rows without a column than stand beside it is taken, else the last, and returned. What is best at
    one price is where the next one starts: only rows without a column bid again.
    """
    rows = len(chosen)
    order = np.empty(len(costs), np.int32 if len(costs) < 2**31 else np.int64)
    _by_cost(starts, costs, order)
    columns, costs = columns[order].astype(np.int32), costs[order].astype(np.float32)
    chosen[:] = -1
    owner, paid = np.full(rows, -1, np.int64), np.zeros(rows)
    listed, their_costs = np.full((rows, SHORT_LIST), -1, np.int32), np.empty((rows, SHORT_LIST), np.float32)
    others = np.full(rows, -1.0)
    for price, most in prices.items():
        _auction(starts, columns, costs, price, BID, chosen, owner, paid, listed, their_costs, others)
        if np.count_nonzero(chosen < 0) <= most:
            break
    return price


@numba.njit(cache=True, parallel=True)
def _by_cost(starts, costs, order):
    """Each row's joints, cheapest first."""
    for row in numba.prange(len(starts) - 1):
        low, high = starts[row], starts[row + 1]
        order[low:high] = low + np.argsort(costs[low:high], kind="mergesort")


@numba.njit(cache=True)
def _auction(starts, columns, costs, loose, more, chosen, owner, paid, listed, their_costs, others):
    """`assign` of joints that are sorted by row and cost, going on from what was best where `loose` was less.

    owner (R,): each column's row, -1 for none; paid (R,): what it takes beside a joint's cost to have the column; listed,
    their_costs (R, SHORT_LIST): each row's cheapest columns, -1 behind the last; others (R,): what no other column is below.
    """
    for first in np.flatnonzero(chosen < 0):
        row = first
        while row >= 0:
            while True:
                cheapest, second, column = loose, loose, np.int64(-1)
                for n in range(listed.shape[1]):
                    if listed[row, n] < 0:
                        break
                    cost = their_costs[row, n] + paid[listed[row, n]]
                    if cost < cheapest:
                        cheapest, second, column = cost, cheapest, np.int64(listed[row, n])
                    elif cost < second:
                        second = cost
                if second <= others[row]:
                    break
                others[row] = _list(starts, columns, costs, loose, row, paid, listed[row], their_costs[row])
            if column < 0:
                break
            # so much that the second best is as good
            paid[column] += second - cheapest + more
            before = owner[column]
            owner[column], chosen[row] = row, column
            if before >= 0:
                chosen[before] = -1
            row = before


@numba.njit(cache=True)
def _list(starts, columns, costs, loose, row, paid, listed, their_costs):
    """List the cheapest columns of a row, below `loose`; returns what no other is below."""
    size, number = len(listed), 0
    worst = loose
    for k in range(starts[row], starts[row + 1]):
        if costs[k] >= worst:
            break  # nor is any that follows cheaper
        cost = costs[k] + paid[columns[k]]
        if cost >= worst:
            continue
        at = min(number, size - 1)
        while at > 0 and their_costs[at - 1] + paid[listed[at - 1]] > cost:
            listed[at], their_costs[at] = listed[at - 1], their_costs[at - 1]
            at -= 1
        listed[at], their_costs[at] = columns[k], costs[k]
        number = min(number + 1, size)
        if number == size:
            worst = their_costs[size - 1] + paid[listed[size - 1]]
    if number < size:
        listed[number] = -1
    return worst
