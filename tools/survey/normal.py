"""Normal equations: solved, and as much of their inverse as an adjustment needs, sparse where they are large."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.averages import Bools, Floats, Ints

# Up to this many unknowns a dense inverse is as fast, and needs no scipy.
DENSE: Final = 1500


class Normal:
    """N = A^T W A of rows A (m, n) as coordinates (row, column, value) and their weights (m,); positive definite.

    blocks: (n,), unknowns of one number are eliminated together; -1: last, for those that stand in very many rows.
    Raises BuddylineError if an unknown is not determined.
    """

    def __init__(self, at: tuple[Ints, Ints], values: Floats, weights: Floats, blocks: Ints) -> None:
        self.count = count = len(blocks)
        rows, columns = at
        square = np.zeros(count)
        np.add.at(square, columns, values**2 * weights[rows])
        if not (square > 0).all() or not np.isfinite(square).all():
            raise BuddylineError("the adjustment has an unknown that nothing observes")
        # Scaled to a unit diagonal, because metres and radians of many sizes stand side by side.
        self._scale = 1 / np.sqrt(square)
        scaled = values * np.sqrt(weights[rows]) * self._scale[columns]
        self._lu: Any = None
        try:
            if count <= DENSE:
                A = np.zeros((len(weights), count))
                np.add.at(A, (rows, columns), scaled)
                self._dense = A.T @ A
            else:
                self._factor(rows, columns, scaled, blocks)
        except (np.linalg.LinAlgError, RuntimeError) as error:
            raise BuddylineError("the adjustment has stations that its observations do not fix") from error

    def _factor(self, rows: Ints, columns: Ints, scaled: Floats, blocks: Ints) -> None:
        try:
            from scipy.sparse import csc_array
            from scipy.sparse.linalg import splu
        except ModuleNotFoundError as error:
            raise BuddylineError("a survey of this size needs scipy: make install EXTRAS=survey") from error
        symmetric = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
        count = int(rows.max()) + 1
        # Least fill between blocks (Liu's minimum degree, by a matrix of their neighbourhood).
        early = blocks[columns] >= 0
        met = csc_array((np.ones(early.sum()), (blocks[columns[early]], rows[early])), shape=(blocks.max() + 1, count))
        met.data[:] = 1.0
        beside = (met @ met.T).tocsc()
        beside.setdiag(beside.sum(axis=0) + 1)
        rank = splu(beside, permc_spec="MMD_AT_PLUS_A", **symmetric).perm_c
        self._order = np.argsort(np.where(blocks >= 0, rank[blocks], len(rank)), kind="stable")
        place = np.empty(self.count, dtype=np.int64)
        place[self._order] = np.arange(self.count)
        A = csc_array((scaled, (rows, place[columns])), shape=(count, self.count))
        self._N, self._place = (A.T @ A).tocsc(), place
        self._lu = splu(self._N, permc_spec="NATURAL", **symmetric)

    def solve(self, right: Floats) -> Floats:
        """Return N^-1 times right, (n,) or (n, k)."""
        scale = self._scale if right.ndim == 1 else self._scale[:, None]
        scaled = scale * right
        if self._lu is None:
            return np.asarray(scale * np.linalg.solve(self._dense, scaled))
        return np.asarray(scale * self._lu.solve(np.ascontiguousarray(scaled[self._order]))[self._place])

    def blocks(self, groups: Ints) -> Floats:
        """Return the inverse between the unknowns of each group, (g, k, k). groups: (g, k) of numbers, -1: none (zero).

        The unknowns of a group must occur in one row, or N between them is not kept.
        """
        known = groups >= 0
        at = np.where(known, groups, 0)
        if self._lu is None:
            found = np.linalg.inv(self._dense)[at[:, :, None], at[:, None, :]]
        else:
            found = self._selected(at, known)
        scale = np.where(known, self._scale[at], 0.0)
        return np.asarray(found * scale[:, :, None] * scale[:, None, :])

    def _lower(self) -> tuple[Ints, Ints, Floats]:
        """Return L's columns' starts, its rows in order and their values, with the zeros that happen to be exact.

        Those are left out of a factor, but not of one in which nothing can cancel.
        """
        from scipy.sparse.linalg import splu

        pattern = self._N.copy()
        pattern.data[:] = -1.0
        pattern.setdiag(2.0 * np.diff(pattern.indptr))
        options = {"SymmetricMode": True}
        whole = splu(pattern, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options).L.tocsc()
        whole.sort_indices()
        lower = self._lu.L.tocsc()
        lower.sort_indices()

        def keys(one: Any) -> Ints:
            columns = np.repeat(np.arange(self.count, dtype=np.int64), np.diff(one.indptr))
            return np.asarray(columns * self.count + one.indices)

        values = np.zeros(len(whole.data))
        values[np.searchsorted(keys(whole), keys(lower))] = lower.data
        return whole.indptr, whole.indices, values

    def _selected(self, at: Ints, known: Bools) -> Floats:
        """Return the blocks of a sparse inverse (Takahashi, Fagan and Chin 1973), front by front of the factor.

        For columns J of L with the same rows R below them: with G = L_RJ L_JJ^-1, Z_RJ = -Z_RR G and
        Z_JJ = (L_JJ D_J L_JJ^T)^-1 - G^T Z_RJ. R is part of the front (J and R together) that R's first row is in.
        """
        from scipy.linalg.lapack import dtrtri

        count, lu = self.count, self._lu
        place = lu.perm_c[self._place]
        starts, rows, values = self._lower()
        pivots = lu.U.diagonal()
        lengths = np.diff(starts)
        following = np.full(count, -1)
        following[lengths > 1] = rows[starts[:-1][lengths > 1] + 1]
        # A column that has its right neighbour's rows and that neighbour itself is of the same front.
        opens = np.ones(count + 1, dtype=bool)
        opens[1:-1] = (following[:-1] != np.arange(1, count)) | (lengths[:-1] != lengths[1:] + 1)
        bounds = np.flatnonzero(opens)
        of_front = np.cumsum(opens[:-1]) - 1
        parents = np.where(following[bounds[1:] - 1] >= 0, of_front[following[bounds[1:] - 1]], -1)
        children = np.bincount(parents[parents >= 0], minlength=len(parents)).tolist()
        wanted: dict[int, list[int]] = {}
        first = np.where(known, place[at], count).min(axis=1)
        for group, front in enumerate(of_front[first].tolist()):
            wanted.setdefault(front, []).append(group)
        found = np.zeros((*at.shape, at.shape[1]))
        fronts: dict[int, tuple[Ints, Floats]] = {}
        positions = place[at]
        for number in range(len(parents) - 1, -1, -1):
            begin, end = int(bounds[number]), int(bounds[number + 1])
            members, width = rows[starts[begin] : starts[begin + 1]], end - begin
            L = np.zeros((len(members), width))
            for k in range(width):
                L[k:, k] = values[starts[begin + k] : starts[begin + k + 1]]
            inverse = dtrtri(L[:width], lower=1, unitdiag=1)[0]
            Z = np.empty((len(members), len(members)))
            Z[:width, :width] = inverse.T @ (inverse / pivots[begin:end, None])
            if len(members) > width:
                parent = int(parents[number])
                members_of, Z_of = fronts[parent]
                inside = np.searchsorted(members_of, members[width:])
                Z_RR = Z_of[inside[:, None], inside]
                G = L[width:] @ inverse
                across = -(Z_RR @ G)
                Z[width:, width:], Z[width:, :width], Z[:width, width:] = Z_RR, across, across.T
                Z[:width, :width] -= G.T @ across
                children[parent] -= 1
                if not children[parent]:
                    del fronts[parent]
            if children[number]:
                fronts[number] = members, Z
            for group in wanted.get(number, ()):
                here = np.searchsorted(members, positions[group])
                here[~known[group]] = 0
                found[group] = Z[here[:, None], here]
        return found
