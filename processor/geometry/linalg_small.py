"""Compiled linear algebra of small matrices: Cholesky factor, solution, inverse, product, symmetric eigenvectors.

Every sum runs in one fixed order. LAPACK and BLAS change theirs with the number of threads, and so their last digits.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import numpy as np
from numba import njit

from processor.inner_kernels import inner, inner_ieee

DEFINITE = 1e-12  # least pivot of a positive definite matrix, as a share of its diagonal element
SWEEPS = 12  # work: of Jacobi's method, which ends before: its convergence is quadratic


@inner
def assign(target, source):  # type: ignore[no-untyped-def]
    """Copy the elements of an array (n,) to another: numba takes a second to compile target[:] = source."""
    for i in range(len(source)):
        target[i] = source[i]


@inner
def assign_rows(target, source):  # type: ignore[no-untyped-def]
    """Copy the elements of an array (n, m) to another; see :func:`assign`."""
    for i in range(len(source)):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@inner_ieee
def factorise(A, n, least, L):  # type: ignore[no-untyped-def]
    """Write the lower Cholesky factor of the leading (n, n) block of A to L; only the lower halves are used.

    False where a pivot is not above ``least`` times its diagonal element: the block is not positive definite.
    """
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > least * A[i, i]:
                    return False
                L[i, i] = np.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def cholesky(A):  # type: ignore[no-untyped-def]
    """Lower Cholesky factor (n, n) of a symmetric matrix; all NaN where it is not positive definite."""
    n = len(A)
    L = np.zeros((n, n))
    if not factorise(A, n, 0.0, L):
        return np.full((n, n), np.nan)
    return L


@inner_ieee
def substitute(L, n, x):  # type: ignore[no-untyped-def]
    """Solve L L' x = b in place for the leading (n, n) block of L: ``x`` (n,) holds b and then the solution."""
    for i in range(n):
        value = x[i]
        for k in range(i):
            value -= L[i, k] * x[k]
        x[i] = value / L[i, i]
    for i in range(n - 1, -1, -1):
        value = x[i]
        for k in range(i + 1, n):
            value -= L[k, i] * x[k]
        x[i] = value / L[i, i]


@njit(cache=True, nogil=True, error_model="numpy")
def solve(L, B):  # type: ignore[no-untyped-def]
    """Solve L L' X = B (n, m) by a Cholesky factor L (n, n)."""
    n, m = B.shape
    X = B.copy()
    for i in range(n):
        for k in range(i):
            for c in range(m):
                X[i, c] -= L[i, k] * X[k, c]
        for c in range(m):
            X[i, c] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for c in range(m):
                X[i, c] -= L[k, i] * X[k, c]
        for c in range(m):
            X[i, c] /= L[i, i]
    return X


@njit(cache=True, nogil=True, error_model="numpy")
def inverse_of(A, out):  # type: ignore[no-untyped-def]
    """Write the inverse of a symmetric matrix (n, n) to ``out``; False where it is not positive definite."""
    n = len(A)
    L = np.zeros((n, n))
    if not factorise(A, n, DEFINITE, L):
        return False
    M = np.zeros((n, n))  # inverse of L
    for i in range(n):
        M[i, i] = 1.0 / L[i, i]
        for j in range(i):
            total = 0.0
            for k in range(j, i):
                total -= L[i, k] * M[k, j]
            M[i, j] = total / L[i, i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += M[k, i] * M[k, j]
            out[i, j] = total
            out[j, i] = total
    return True


@inner_ieee
def log_det(A):  # type: ignore[no-untyped-def]
    """Logarithm of the determinant of a symmetric matrix (n, n); NaN where it is not positive definite."""
    n = len(A)
    L = np.zeros((n, n))
    if not factorise(A, n, 0.0, L):
        return np.nan
    total = 0.0
    for i in range(n):
        total += 2.0 * np.log(L[i, i])
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def product(A, B):  # type: ignore[no-untyped-def]
    """Product (n, m) of A (n, k) and B (k, m)."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            for j in range(B.shape[1]):
                out[i, j] += A[i, k] * B[k, j]
    return out


@inner
def eigen(A, V):  # type: ignore[no-untyped-def]
    """Turn a symmetric A (3, 3) into its eigenvalues on the diagonal, V into its vectors as columns (Jacobi)."""
    for i in range(3):
        for j in range(3):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        off = abs(A[0, 1]) + abs(A[0, 2]) + abs(A[1, 2])
        if off <= 1e-18 * (abs(A[0, 0]) + abs(A[1, 1]) + abs(A[2, 2])):
            return
        for p in range(2):
            for q in range(p + 1, 3):
                if A[p, q] == 0.0:
                    continue
                theta = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
                t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                h = t * A[p, q]
                A[p, p] -= h
                A[q, q] += h
                A[p, q] = A[q, p] = 0.0
                r = 3 - p - q
                g, h = A[r, p], A[r, q]
                A[r, p] = A[p, r] = c * g - s * h
                A[r, q] = A[q, r] = s * g + c * h
                for k in range(3):
                    g, h = V[k, p], V[k, q]
                    V[k, p], V[k, q] = c * g - s * h, s * g + c * h
