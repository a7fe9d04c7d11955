"""Whitened least squares with a prior, and score tests of further columns, for all of the diagnosis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.distributions import chi2_logsf
from ...calibration.numerics.frames import Array, product

# Share of noise in a direction's squares from which the direction is excluded
MAX_NOISE_SHARE = 0.5
# Added to normal equations of unit diagonal, so that collinear columns have a solution
ROUNDING = 1e-9
# Directions with less than this share of their length outside the others are excluded as collinear
INDEPENDENT = 1e-3


def root_of_inverse(normal: Array) -> Array:
    """Return (n, n) with root.T @ root the inverse of a normal matrix (n, n), which may be singular to rounding."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    rounded = scale[:, None] * normal * scale + ROUNDING * np.eye(len(scale))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(rounded)) * scale)


@dataclass(frozen=True)
class WhitenedLeastSquares:
    """Least squares ‖target - columns x‖² + Σ ((x - centre) / std)² of whitened columns and target.

    gram: (n + 1, n + 1) of columns and target, in this order. std, centre: (n,), the prior.
    """

    gram: Array
    std: Array
    centre: Array

    @staticmethod
    def of(columns: Array, target: Array, std: Array, centre: Array) -> WhitenedLeastSquares:
        """Return the system of whitened columns (m, n) and target (m,). std, centre: (n,) of the parameters' prior."""
        xty = columns.T @ target
        gram = np.block([[columns.T @ columns, xty[:, None]], [xty, target @ target]])
        return WhitenedLeastSquares(gram, std, centre)

    def part(self, at: NDArray[np.intp]) -> WhitenedLeastSquares:
        """Return the system of some columns; other parameters are zero."""
        rows = np.append(at, len(self.std))
        return WhitenedLeastSquares(self.gram[np.ix_(rows, rows)], self.std[at], self.centre[at])

    @property
    def _normal(self) -> Array:
        normal: Array = self.gram[:-1, :-1] + np.diag(self.std**-2.0)
        return normal

    @property
    def is_definite(self) -> bool:
        """Return whether there is a unique minimum."""
        diagonal = np.diag(self._normal)
        if not (diagonal > 0.0).all():  # more noise was subtracted than the columns hold
            return False
        scale = 1.0 / np.sqrt(diagonal)
        return bool(np.linalg.eigvalsh(scale[:, None] * self._normal * scale)[0] > 1e-9)

    def solution(self) -> Array:
        """Return x (n,)."""
        right = self.gram[:-1, -1] + self.centre / self.std**2
        return np.linalg.solve(self._normal, right)

    def solution_without(self, noise: Array) -> Array:
        """Return x (n,) with noise (n + 1, n + 1) subtracted from `gram`; zero along noisy directions."""
        root = root_of_inverse(self._normal)
        shares, along = np.linalg.eigh(root @ noise[:-1, :-1] @ root.T)
        right = along.T @ root @ (self.gram[:-1, -1] - noise[:-1, -1] + self.centre / self.std**2)
        signal = np.where(shares < MAX_NOISE_SHARE, right / np.maximum(1.0 - shares, 1.0 - MAX_NOISE_SHARE), 0.0)
        return np.asarray(root.T @ along @ signal)

    def squares(self, x: Array) -> float:
        """Return ‖target - columns x‖² at x (n,)."""
        extended = np.append(-x, 1.0)
        return float(extended @ self.gram @ extended)

    def misfit(self, x: Array) -> float:
        """Return the objective at x (n,)."""
        return self.squares(x) + float(np.sum(((x - self.centre) / self.std) ** 2))

    def marginal_deviance(self) -> float:
        """Return -2 log marginal likelihood of the target, without constants and the prior's determinant."""
        return self.misfit(self.solution()) + float(np.linalg.slogdet(self._normal)[1])

    def covariance(self) -> Array:
        """Return the covariance (n, n) of the solution, for noise of unit variance."""
        return np.asarray(np.linalg.inv(self._normal))

    def effective_dof(self) -> Array:
        """Return the degrees of freedom (n,) per parameter, less than one where the prior contributes."""
        return np.asarray(1.0 - np.diag(self.covariance()) / self.std**2)


def orthonormal(white: Array) -> Array:
    """Return an orthonormal basis (m, r) of whitened columns (m, n), which may be zero or collinear."""
    lengths = np.linalg.norm(white, axis=0)
    white = white[:, lengths > 0.0] / lengths[lengths > 0.0]
    u, s, _ = np.linalg.svd(white, full_matrices=False)
    return u[:, s > INDEPENDENT]


@dataclass(frozen=True)
class ScoreTest:
    """Normal equations of columns for a whitened series, orthogonal to a basis.

    Basis and series may end with prior rows, which the columns lack.
    gram: (c, c) of unit columns after projection.
    along: (c,) products with the series.
    nonzero: (c,) whether a column exceeds rounding after projection.
    """

    gram: Array
    along: Array
    nonzero: NDArray[np.bool_]

    @staticmethod
    def of(q: Array, white_columns: Array, white: Array, first: int = 0) -> ScoreTest:
        """Test whitened columns (m, c), zero but from row `first` on, beside an orthonormal basis q for a series."""
        rows = slice(first, first + len(white_columns))
        explained, square = q[rows].T @ white_columns, white_columns.T @ white_columns
        scatter = square - explained.T @ explained
        before, after = (np.sqrt(np.maximum(np.diag(each), 0.0)) for each in (square, scatter))
        nonzero = after > 0.02 * np.maximum(before, 1e-300)
        size = np.where(nonzero, after, 1.0)
        along = white_columns.T @ white[rows] - explained.T @ (q.T @ white)
        return ScoreTest(scatter / np.outer(size, size), along / size, nonzero)

    def energy(self, at: NDArray[np.intp]) -> tuple[float, int]:
        """Return the energy that columns `at` explain jointly, and their rank."""
        (energy,), (rank,) = self.energies(at[None])
        return float(energy), int(rank)

    def energies(self, groups: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
        """Return the energy and rank (K,) of each group of columns (K, c), see `energy`."""
        nonzero = self.nonzero[groups]
        gram = self.gram[groups[:, :, None], groups[:, None, :]]
        squares, directions = np.linalg.eigh(np.where(nonzero[:, :, None] & nonzero[:, None, :], gram, 0.0))
        independent = squares > INDEPENDENT**2
        projected = product(directions.swapaxes(1, 2), np.where(nonzero, self.along[groups], 0.0))
        energies = np.where(independent, projected**2 / np.where(independent, squares, 1.0), 0.0)
        return energies.sum(axis=1), np.count_nonzero(independent, axis=1)

    def log_p(self, groups: NDArray[np.intp]) -> Array:
        """Return log p (K,) of the energy that each group of columns (K, c) explains jointly."""
        energies, ranks = self.energies(groups)
        return np.where(ranks > 0, chi2_logsf(energies, np.maximum(ranks, 1)), 0.0)
