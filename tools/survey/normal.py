"""Normal equations: solved, and as much of their inverse as an adjustment needs, sparse where they are large."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.averages import Floats, Ints

# Up to this many unknowns a dense inverse is as fast, and needs no scipy.
DENSE: Final = 1500
SYMMETRIC: Final[dict[str, Any]] = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
# A block in more rows than this many times the root of the number of blocks is eliminated last (the rule of AMD).
OFTEN: Final = 10.0
# A single unknown in more rows than this is an instrument's. A leg's own (azimuth, a gyroscope's wander) is in fewer.
OWN_ROWS: Final = 8
# Loops times instruments' unknowns, from which on dives cross so often that only one order is looked for.
CROSSED: Final = 5_000_000
# Subtrees of up to this many unknowns are one front.
WIDE: Final = 48


class Normal:
    """N = A^T W A of rows A (m, n) as coordinates (row, column, value) and their weights (m,); positive definite.

    blocks: (n,), from 0 without gaps: unknowns of one number are eliminated together. tree: of equations of the same
    pattern, whose order of elimination is used again; None: of dense ones.
    Raises BuddylineError if an unknown is not determined.
    """

    def __init__(
        self, at: tuple[Ints, Ints], values: Floats, weights: Floats, blocks: Ints, tree: Tree | None = None
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
        self.tree = tree
        try:
            if count <= DENSE:
                A = np.zeros((len(weights), count))
                np.add.at(A, (rows, columns), scaled)
                self._dense = A.T @ A
                np.linalg.cholesky(self._dense)
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
        if self.tree is None:
            self.tree = Tree(rows, columns, blocks)
        A = csc_array((scaled, (rows, self.tree.place[columns])), shape=(int(rows.max()) + 1, self.count))
        self._lu = splu((A.T @ A).tocsc(), permc_spec="NATURAL", **SYMMETRIC)

    def solve(self, right: Floats) -> Floats:
        """Return N^-1 times right, (n,) or (n, k)."""
        scale = self._scale if right.ndim == 1 else self._scale[:, None]
        scaled = scale * right
        if self.tree is None:
            return np.asarray(scale * np.linalg.solve(self._dense, scaled))
        tree = self.tree
        return np.asarray(scale * self._lu.solve(np.ascontiguousarray(scaled[tree.order]))[tree.place])

    def inverse(self, unknowns: Ints) -> Floats:
        """Return the inverse between some unknowns, (u, u).

        With N = L D L^T, it is Y^T D^-1 Y of Y = L^-1 I; a column of Y has the unknown's ancestors in the elimination
        tree alone (Gilbert 1994), so that few unknowns touch little of L.
        """
        scale = self._scale[unknowns]
        if self.tree is None:
            between = np.linalg.inv(self._dense)[np.ix_(unknowns, unknowns)]
        else:
            from scipy.sparse.linalg import splu

            lower, here = self._lu.L, self._lu.perm_c[self.tree.place[unknowns]]
            lower.sort_indices()
            below = np.minimum(lower.indptr[:-1] + 1, lower.nnz - 1)
            parents = np.where(np.diff(lower.indptr) > 1, lower.indices[below], -1)
            above, kept = np.unique(here), np.zeros(self.count, dtype=bool)
            while len(above):
                kept[above] = True
                above = np.unique(parents[above])
                above = above[(above >= 0) & ~kept[above]]
            every = np.flatnonzero(kept)
            units = (every[:, None] == here).astype(float)
            Y = splu(lower[every][:, every], permc_spec="NATURAL", **SYMMETRIC).solve(units)
            between = Y.T @ (Y / self._lu.U.diagonal()[every, None])
        return np.asarray(scale[:, None] * between * scale)

    def blocks(self, groups: Ints, columns: Ints, values: Floats) -> tuple[Floats, Floats]:
        """Return the inverse between the unknowns of each group, (g, k, k), and v^T N^-1 v of each row v, (m,).

        groups: (g, k) of unknowns; columns: (m, j), each row's unknowns; -1: none. values: (m, j). The unknowns of a
        group or row must occur in one observation together, or N between them is not kept.
        """
        at = [np.where(one >= 0, one, 0) for one in (groups, columns)]
        scales = [np.where(one >= 0, self._scale[here], 0.0) for one, here in zip((groups, columns), at, strict=True)]
        scaled = values * scales[1]
        if self.tree is None:
            inverse = np.linalg.inv(self._dense)
            found = inverse[at[0][:, :, None], at[0][:, None, :]]
            forms = np.einsum("mi,mij,mj->m", scaled, inverse[at[1][:, :, None], at[1][:, None, :]], scaled)
        else:
            found, forms = self._selected(self.tree, groups, columns, scaled)
        return np.asarray(found * scales[0][:, :, None] * scales[0][:, None, :]), np.asarray(forms)

    def _selected(self, tree: Tree, groups: Ints, columns: Ints, values: Floats) -> tuple[Floats, Floats]:
        """Return what `blocks` does, scaled, of a sparse inverse (Takahashi, Fagan and Chin 1973), front by front.

        For columns J of L with rows R below them: with G = L_RJ L_JJ^-1, Z_RJ = -Z_RR G and
        Z_JJ = (L_JJ D_J L_JJ^T)^-1 - G^T Z_RJ. R is part of the front (J and R together) that R's first row is in.
        """
        from scipy.linalg.lapack import dtrtri

        count, moved = self.count, self._lu.perm_c
        # SuperLU may have taken branches of the tree in another order.
        lower = self._lu.L.tocsc()[:, moved]
        back = np.empty(count, dtype=np.int64)
        back[moved] = np.arange(count)
        rows, starts = back[lower.indices], lower.indptr
        pivots = self._lu.U.diagonal()[moved]
        bounds = tree.bounds
        of_front = np.repeat(np.arange(len(tree.below)), np.diff(bounds))
        parents = [int(of_front[below[0]]) if len(below) else -1 for below in tree.below]
        children = np.bincount([one for one in parents if one >= 0], minlength=len(parents)).tolist()
        # Each group is found in the front that has its first unknown. The place `count`, after all unknowns, is for -1.
        places = [np.where(one >= 0, tree.place[one], count) for one in (groups, columns)]
        wanted = []
        for one in places:
            front = of_front[np.minimum(one.min(axis=1, initial=count), count - 1)]
            sizes = np.bincount(front, minlength=len(parents))
            wanted.append(np.split(np.argsort(front, kind="stable"), np.cumsum(sizes)[:-1]))
        found, forms = np.zeros((*groups.shape, groups.shape[1])), np.zeros(len(columns))
        fronts: dict[int, tuple[Ints, Floats]] = {}
        for number in range(len(parents) - 1, -1, -1):
            begin, end = int(bounds[number]), int(bounds[number + 1])
            width, part = end - begin, slice(starts[begin], starts[end])
            members = np.concatenate([np.arange(begin, end), tree.below[number]])
            L = np.zeros((len(members), width))
            beside = np.repeat(np.arange(width), np.diff(starts[begin : end + 1]))
            L[np.searchsorted(members, rows[part]), beside] = lower.data[part]
            inverse = dtrtri(L[:width], lower=1, unitdiag=1)[0]
            Z = np.empty((len(members), len(members)))
            Z[:width, :width] = inverse.T @ (inverse / pivots[begin:end, None])
            if len(members) > width:
                parent = parents[number]
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


class Tree:
    """The elimination tree of rows' unknowns (Liu 1990), block by block, and its fronts: unknowns of one dense part.

    order, place: (n,), the unknown at each place, a postorder, and the place of each unknown. bounds: (f + 1,), places
    at which fronts begin. below: of each front the places of the other unknowns that L has in its columns, in order.
    """

    def __init__(self, rows: Ints, columns: Ints, blocks: Ints) -> None:
        of_block = np.bincount(blocks)
        beside, ranks = _orders(rows, blocks[columns], of_block)
        # By rank, from here on.
        found = [(*_eliminated(beside, rank, of_block), rank) for rank in ranks]
        _, under, children, rank = min(found, key=lambda one: one[0])
        count, widths = len(rank), of_block[np.argsort(rank)].tolist()
        sizes, parents = list(widths), [-1] * count
        for parent, own in enumerate(children):
            for child in own:
                parents[child] = parent
                sizes[parent] += sizes[child]
        post: list[int] = []
        stack = [k for k in range(count) if parents[k] < 0]
        while stack:
            post.append(stack.pop())
            stack += children[post[-1]]
        post.reverse()
        tops: list[int] = []
        for k in post:
            if sizes[k] <= WIDE and parents[k] >= 0 and sizes[parents[k]] <= WIDE:
                continue
            # The last front goes on with a block that has the same other blocks below it.
            if tops and parents[tops[-1]] == k and len(under[tops[-1]]) == len(under[k]) + 1:
                tops.pop()
            tops.append(k)
        at = np.empty(count, dtype=np.int64)
        at[post] = np.arange(count)
        first = np.concatenate([[0], np.cumsum(np.array(widths)[post])])
        self.bounds = np.concatenate([[0], first[at[tops] + 1]])
        self.order = np.argsort(at[rank[blocks]], kind="stable")
        self.place = np.empty(len(blocks), dtype=np.int64)
        self.place[self.order] = np.arange(len(blocks))
        self.below = []
        for k in tops:
            parts = np.sort(at[list(under[k])])
            many = first[parts + 1] - first[parts]
            self.below.append(np.repeat(first[parts] - np.cumsum(many) + many, many) + np.arange(many.sum()))


def _eliminated(beside: Any, rank: Ints, widths: Ints) -> tuple[float, list[set[int]], list[list[int]]]:
    """Return the operations that an order of blocks takes, and by rank what is below each block in L, and its children.

    beside: (b, b), which blocks meet in a row; widths: (b,), each one's unknowns.
    """
    turn = np.argsort(rank)
    wide, starts, ends = widths[turn].tolist(), beside.indptr.tolist(), rank[beside.indices].tolist()
    under: list[set[int]] = []
    children: list[list[int]] = [[] for _ in turn]
    work = 0.0
    for k, block in enumerate(turn.tolist()):
        here = {other for other in ends[starts[block] : starts[block + 1]] if other > k}
        here.update(*(under[child] for child in children[k]))
        here.discard(k)
        under.append(here)
        if here:
            children[min(here)].append(k)
        work += wide[k] * float(wide[k] + sum(wide[other] for other in here)) ** 2
    return work, under, children


def _orders(rows: Ints, blocks: Ints, widths: Ints) -> tuple[Any, list[Ints]]:
    """Return which blocks meet in a row, (b, b), and orders of little fill: the rank of each block, (b,).

    Both are Liu's minimum degree, with some blocks last: those of instruments; or those in very many rows alone. The
    first is better where dives cross often, the second where they hardly do; where they cross very often it is not
    looked for, because the search itself takes long.
    """
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    met = csc_array((np.ones(len(rows)), (blocks, rows)), shape=(blocks.max() + 1, rows.max() + 1))
    met.data[:] = 1.0
    beside = (met @ met.T).tocsc()
    in_rows = np.bincount(met.indices)
    shared = (widths == 1) & (in_rows > OWN_ROWS)
    often = in_rows > OFTEN * math.sqrt(beside.shape[0])
    places = beside[~shared][:, ~shared]
    loops = (places.nnz - places.shape[0]) // 2 - places.shape[0] + 1
    ranks = []
    for last in (shared, often) if loops * int(shared.sum()) < CROSSED else (shared | often,):
        first, rank = np.flatnonzero(~last), np.empty(len(last), dtype=np.int64)
        if len(first):
            between = beside[first][:, first].tocsc()
            between.setdiag(between.sum(axis=0) + 1)
            rank[first] = splu(between, permc_spec="MMD_AT_PLUS_A", **SYMMETRIC).perm_c
        rank[last] = np.arange(len(first), len(last))
        ranks.append(rank)
    return beside, ranks
