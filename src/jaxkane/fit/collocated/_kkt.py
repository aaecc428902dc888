"""Covariances and the marginal likelihood from the matrix of Karush, Kuhn and Tucker.

At the minimum of half a sum of squares with the linearized constraints J dx = 0, the covariance of the variables x is
the upper left block of the inverse of

    [ H  J^T ]
    [ J   0  ]

with the Hessian H of the Lagrangian (Y. Bard, Nonlinear Parameter Estimation, 1974, section 7-6). The variables of the
nodes are eliminated first. In the order of Cuthill and McKee this part of the matrix is banded, and LAPACK factorizes
it in a fraction of a second. SuperLU took 40 to 90 s for 23 000 variables: the parameters occur in all equations.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from ..._collocate.program import NonlinearProgram
from ..._collocate.second_order import BandedFactors


class Kkt:
    """The matrix at a point, without variables that are fixed or at a bound.

    **Arguments:**

    - `program`: the nonlinear program. Its cost is a sum of squares, of which minus the log density is half.
    - `border`: the variables that are eliminated last: parameters.
    - `z` (n,), `multipliers` (n_g,): the point, in scaled numbers.
    """

    def __init__(self, program: NonlinearProgram, border: np.ndarray, z: np.ndarray, multipliers: np.ndarray):
        self.program = program
        is_free = (z - program.lower > 1e-7) & (program.upper - z > 1e-7)
        is_border = np.zeros(program.n, bool)
        is_border[border] = True
        self.inner, self.border = np.flatnonzero(is_free & ~is_border), border[is_free[border]]
        rows, columns = program.hessian_structure
        lower = scipy.sparse.csr_matrix((program.hessian(z, multipliers), (rows, columns)), (program.n,) * 2)
        # Half of the cost, in its own unit, so that the matrix is the curvature of minus the log density.
        H = 0.5 * program.f_scale * (lower + scipy.sparse.tril(lower, -1).T).tocsr()
        J = scipy.sparse.csr_matrix((program.jacobian(z), program.jacobian_structure), (program.m, program.n))
        inner, border = self.inner, self.border
        K = scipy.sparse.bmat([[H[inner][:, inner], J[:, inner].T], [J[:, inner], None]], format="csr")
        order = np.asarray(scipy.sparse.csgraph.reverse_cuthill_mckee(K, symmetric_mode=True))
        self.factors = BandedFactors(K, order, order)
        self.coupling = np.concatenate([H[inner][:, border].toarray(), J[:, border].toarray()])
        self.solved = self.factors.solve(self.coupling)
        self.schur = H[border][:, border].toarray() - self.coupling.T @ self.solved
        self.J = J

    def covariance(self, variables: np.ndarray) -> np.ndarray:
        """The covariance of some variables of the border, in their own units.

        It is zero for fixed variables, and NaN if the data do not determine the variables.
        """
        place = {int(v): i for i, v in enumerate(self.border)}
        known = [i for i, v in enumerate(variables) if int(v) in place]
        result = np.zeros((len(variables),) * 2)
        own = [place[int(variables[i])] for i in known]
        scale = self.program.x_scale[variables[known]]
        result[np.ix_(known, known)] = inverse(self.schur)[np.ix_(own, own)] * np.outer(scale, scale)
        return result


def inverse(information: np.ndarray) -> np.ndarray:
    """The inverse of a positive-definite matrix; NaN if it is not positive definite."""
    if not information.size:
        return information
    size = np.sqrt(np.abs(np.diag(information)))
    scaled = information / np.outer(size, size)
    if not np.all(np.isfinite(scaled)) or np.linalg.eigvalsh(scaled)[0] < 1e-12:
        return np.full_like(information, np.nan)
    return np.linalg.inv(scaled) / np.outer(size, size)
