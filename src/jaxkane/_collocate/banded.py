"""Factors of sparse matrices that are banded in a suitable order."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse


class BandedFactors:
    """The LU factors of a sparse matrix that is banded in a suitable order.

    **Arguments:**

    - `matrix`: a sparse matrix (n, n).
    - `rows`, `columns`: an order of its rows and columns in which it is banded.

    **Raises:** `np.linalg.LinAlgError` if it is singular.
    """

    def __init__(self, matrix: Any, rows: np.ndarray, columns: np.ndarray):
        self.rows, self.columns, n = rows, columns, matrix.shape[0]
        ordered = scipy.sparse.coo_matrix(matrix.tocsr()[rows][:, columns])
        i, j = ordered.row, ordered.col
        self.below, self.above = int(np.max(i - j, initial=0)), int(np.max(j - i, initial=0))
        band = np.zeros((2 * self.below + self.above + 1, n))
        band[self.below + self.above + i - j, j] = ordered.data
        factorize, self._solve = scipy.linalg.get_lapack_funcs(("gbtrf", "gbtrs"), (band,))
        self.lu, self.pivots, info = factorize(band, self.below, self.above, overwrite_ab=True)
        if info != 0:
            raise np.linalg.LinAlgError("The matrix is singular.")

    @property
    def log_determinant(self) -> float:
        """log |det|."""
        return float(np.sum(np.log(np.abs(self.lu[self.below + self.above]))))

    def solve(self, b: np.ndarray) -> np.ndarray:
        """The solution (n, k) for right-hand sides (n, k)."""
        x, info = self._solve(self.lu, self.below, self.above, b[self.rows], self.pivots)
        if info != 0:
            raise np.linalg.LinAlgError("The matrix is singular.")
        solved = np.empty_like(x)
        solved[self.columns] = x
        return solved
