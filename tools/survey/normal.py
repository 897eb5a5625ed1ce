"""Normal equations: solved, and as much of their inverse as an adjustment needs, sparse where they are large."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.averages import Floats, Ints

# Up to this many unknowns a dense inverse is as fast, and needs no scipy.
DENSE: Final = 1500
SYMMETRIC: Final[dict[str, Any]] = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


class Normal:
    """N = A^T W A of rows A (m, n) as coordinates (row, column, value) and their weights (m,); positive definite.

    blocks: (n,), unknowns of one number are eliminated together; -1: last, for those that stand in very many rows.
    before: equations of the same pattern; their order of elimination is used again.
    Raises BuddylineError if an unknown is not determined.
    """

    def __init__(
        self, at: tuple[Ints, Ints], values: Floats, weights: Floats, blocks: Ints, before: Normal | None = None
    ) -> None:
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
        self._order: Ints = np.empty(0, dtype=np.int64) if before is None else before._order
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
        count = int(rows.max()) + 1
        if not len(self._order):
            rank = _elimination(rows, blocks[columns], count)
            self._order = np.argsort(np.where(blocks >= 0, rank[blocks], len(rank)), kind="stable")
        place = np.empty(self.count, dtype=np.int64)
        place[self._order] = np.arange(self.count)
        A = csc_array((scaled, (rows, place[columns])), shape=(count, self.count))
        self._N, self._place = (A.T @ A).tocsc(), place
        self._lu = splu(self._N, permc_spec="NATURAL", **SYMMETRIC)

    def solve(self, right: Floats) -> Floats:
        """Return N^-1 times right, (n,) or (n, k)."""
        scale = self._scale if right.ndim == 1 else self._scale[:, None]
        scaled = scale * right
        if self._lu is None:
            return np.asarray(scale * np.linalg.solve(self._dense, scaled))
        return np.asarray(scale * self._lu.solve(np.ascontiguousarray(scaled[self._order]))[self._place])

    def blocks(self, groups: Ints, columns: Ints, values: Floats) -> tuple[Floats, Floats]:
        """Return the inverse between the unknowns of each group, (g, k, k), and v^T N^-1 v of each row v, (m,).

        groups: (g, k) of unknowns; columns: (m, j), each row's unknowns; -1: none. values: (m, j). The unknowns of a
        group or row must occur in one observation together, or N between them is not kept.
        """
        at = [np.where(one >= 0, one, 0) for one in (groups, columns)]
        scales = [np.where(one >= 0, self._scale[here], 0.0) for one, here in zip((groups, columns), at, strict=True)]
        scaled = values * scales[1]
        if self._lu is None:
            inverse = np.linalg.inv(self._dense)
            found = inverse[at[0][:, :, None], at[0][:, None, :]]
            forms = np.einsum("mi,mij,mj->m", scaled, inverse[at[1][:, :, None], at[1][:, None, :]], scaled)
        else:
            found, forms = self._selected(groups, columns, scaled)
        return np.asarray(found * scales[0][:, :, None] * scales[0][:, None, :]), np.asarray(forms)

    def _lower(self) -> tuple[Ints, Ints, Floats]:
        """Return L's columns' starts, its rows in order and their values, with the zeros that happen to be exact.

        Those are left out of a factor, but not of one in which nothing can cancel.
        """
        from scipy.sparse.linalg import splu

        pattern = self._N.copy()
        pattern.data[:] = -1.0
        pattern.setdiag(2.0 * np.diff(pattern.indptr))
        whole = splu(pattern, permc_spec="NATURAL", **SYMMETRIC).L.tocsc()
        whole.sort_indices()
        lower = self._lu.L.tocsc()
        lower.sort_indices()

        def keys(one: Any) -> Ints:
            columns = np.repeat(np.arange(self.count, dtype=np.int64), np.diff(one.indptr))
            return np.asarray(columns * self.count + one.indices)

        values = np.zeros(len(whole.data))
        values[np.searchsorted(keys(whole), keys(lower))] = lower.data
        return whole.indptr, whole.indices, values

    def _selected(self, groups: Ints, columns: Ints, values: Floats) -> tuple[Floats, Floats]:
        """Return what `blocks` does, scaled, of a sparse inverse (Takahashi, Fagan and Chin 1973), front by front.

        For columns J of L with the same rows R below them: with G = L_RJ L_JJ^-1, Z_RJ = -Z_RR G and
        Z_JJ = (L_JJ D_J L_JJ^T)^-1 - G^T Z_RJ. R is part of the front (J and R together) that R's first row is in.
        """
        from scipy.linalg.lapack import dtrtri

        count, lu = self.count, self._lu
        place = lu.perm_c[self._place]
        starts, rows, lower = self._lower()
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
        # Each group is found in the front that has its first unknown. The place `count`, after all unknowns, is for -1.
        places = [np.where(one >= 0, place[one], count) for one in (groups, columns)]
        wanted = []
        for one in places:
            front = of_front[np.minimum(one.min(axis=1, initial=count), count - 1)]
            sizes = np.bincount(front, minlength=len(parents))
            wanted.append(np.split(np.argsort(front, kind="stable"), np.cumsum(sizes)[:-1]))
        found, forms = np.zeros((*groups.shape, groups.shape[1])), np.zeros(len(columns))
        fronts: dict[int, tuple[Ints, Floats]] = {}
        for number in range(len(parents) - 1, -1, -1):
            begin, end = int(bounds[number]), int(bounds[number + 1])
            members, width = rows[starts[begin] : starts[begin + 1]], end - begin
            L = np.zeros((len(members), width))
            for k in range(width):
                L[k:, k] = lower[starts[begin + k] : starts[begin + k + 1]]
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
            if len(which := wanted[0][number]):
                here = np.searchsorted(members[:-1], places[0][which])
                found[which] = Z[here[:, :, None], here[:, None, :]]
            if len(which := wanted[1][number]):
                here = np.searchsorted(members[:-1], places[1][which])
                v = values[which]
                forms[which] = np.einsum("mi,mij,mj->m", v, Z[here[:, :, None], here[:, None, :]], v)
        return found, forms


def _elimination(rows: Ints, blocks: Ints, count: int) -> Ints:
    """Return the order of least fill between blocks (Liu's minimum degree, by a matrix of their neighbourhood)."""
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    early = blocks >= 0
    met = csc_array((np.ones(early.sum()), (blocks[early], rows[early])), shape=(blocks.max() + 1, count))
    met.data[:] = 1.0
    beside = (met @ met.T).tocsc()
    beside.setdiag(beside.sum(axis=0) + 1)
    return np.asarray(splu(beside, permc_spec="MMD_AT_PLUS_A", **SYMMETRIC).perm_c)
