"""The cheapest set of joints in which no end is used twice: an assignment problem, solved exactly.

Shortest augmenting paths over reduced costs (Jonker and Volgenant 1987), sparse, with a price for a row that is left without
a column.
"""

from __future__ import annotations

import heapq

import numba
import numpy as np


def assign(
    starts: np.ndarray, columns: np.ndarray, costs: np.ndarray, prices: tuple[float, ...], chosen: np.ndarray, most: int = 0
) -> float:
    """Fill `chosen` (R,) int64: each row's column, or -1, at the least sum of costs, a price for a row without one.

    Row r may have the columns `columns[starts[r]:starts[r + 1]]`, at `costs`, none below 0. Of the rising `prices` the first
    that leaves no more than `most` rows without a column is taken, else the last, and returned. Shortest augmenting paths over
    reduced costs (Jonker and Volgenant 1987); each search ends where leaving somebody loose is cheapest, so it stays among
    neighbours, and looks at a row's columns, cheapest first, no farther than its end may lie. What is best at one price is
    where the next one starts: only rows without a column are looked at again.
    """
    order = np.empty(len(costs), np.int32 if len(costs) < 2**31 else np.int64)
    _by_cost(starts, costs, order)
    columns, costs = columns[order].astype(np.int32), costs[order]
    chosen[:] = -1
    owner = np.full(len(chosen), -1, np.int64)
    row_price, column_price = np.zeros(len(chosen)), np.zeros(len(chosen))  # of columns none is above 0
    for price in prices:
        _assign(starts, columns, costs, price, chosen, owner, row_price, column_price)
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
def _assign(starts, columns, costs, loose, chosen, owner, row_price, column_price):
    """`assign` of joints that are sorted by row and cost, going on from what was best where `loose` was less.

    owner (R,): each column's row, -1 for none; row_price, column_price (R,): what costs are reduced by.
    """
    rows = len(chosen)
    distance, before = np.empty(rows), np.empty(rows, np.int64)
    seen, done = np.full(rows, -1, np.int64), np.full(rows, -1, np.int64)
    for first in np.flatnonzero(chosen < 0):
        heap = [(0.0, np.int64(-1)) for _ in range(0)]
        scanned = [np.int64(0) for _ in range(0)]
        row, far = first, 0.0
        nearest, last_row, last_column = np.inf, first, -1
        while True:
            if far + loose - row_price[row] < nearest:
                nearest, last_row, last_column = far + loose - row_price[row], row, -1
            start = far - row_price[row]
            for k in range(starts[row], starts[row + 1]):
                if start + costs[k] >= nearest:
                    break  # nor is any that is dearer
                column = np.int64(columns[k])
                if done[column] == first:
                    continue
                way = start + costs[k] - column_price[column]
                if way < nearest and (seen[column] != first or way < distance[column]):
                    seen[column], distance[column], before[column] = first, way, row
                    heapq.heappush(heap, (way, column))
            column = np.int64(-1)
            while len(heap):
                far, column = heapq.heappop(heap)
                if done[column] != first and far <= distance[column]:
                    break
                column = np.int64(-1)
            if column < 0 or far >= nearest:
                break
            if owner[column] < 0:
                nearest, last_column = far, column
                break
            done[column] = first
            scanned.append(column)
            row = owner[column]
        for column in scanned:
            less = nearest - distance[column]
            column_price[column] -= less
            row_price[owner[column]] += less
        row_price[first] += nearest
        if last_column < 0:
            row, column = last_row, chosen[last_row]
            chosen[row] = -1
        else:
            row, column = np.int64(-1), last_column
        while row != first:
            row = before[column]
            freed = chosen[row]
            chosen[row], owner[column] = column, row
            column = freed
