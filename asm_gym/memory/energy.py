"""The energy of the state, its gradient, and inference, which descends it.

    F = ½ Π_z ‖z - μ‖² + ½ Σ_i Π_x,i (x_i - x̂_i)²,    x̂ = W_F f(z),    f = tanh
    ∂F/∂z = Π_z (z - μ) - f'(z) ⊙ W_Fᵀ Π_x ε_x,        f' = 1 - f²
    z ← z - η ∂F/∂z,  η = 1.5 / (Π_z + Π_x‖W_F‖² + max|f''| ‖W_Fᵀ Π_x ε_x‖_∞)

Inference begins at μ. The bracket bounds the largest curvature of F, so that no step raises F. Everything is in units
of the standardised stream and has a batch as its first axis.

Source: Millidge et al. 2024 (PLOS Comput Biol), with f = tanh.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np

# The BLAS of the kernels; loaded here, so that its threads can be limited.
import scipy.linalg.cython_blas  # noqa: F401
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner

Array = NDArray[np.floating[Any]]
Scalar = float | np.floating[Any]

STEEPEST = np.float32(0.77)  # above the largest |f''|, which is 4 / (3√3) for tanh
STRIDE = np.float32(1.5)  # step of inference times the curvature; inference diverges from 2 on
MOST_IN_ORDER = 64  # rows of a batch that are summed one by one; more come to learn from
STILL = np.float32(1e-8)  # inference ends when no unit moves further in a step


class Inference(NamedTuple):
    """Precisions of the temporal network, and how far its state descends the energy.

    All numbers are of single precision, or the compiled loops would compute in double.
    """

    prior_precision: Scalar  # Π_z
    sensory_precision: Scalar  # Π_x of a sense that is not missing
    curvature: Scalar  # Π_z + Π_x ‖W_F‖²
    iterations: int  # most steps


F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile ``function``, once a machine. Inputs must be finite, so that loops can use vector registers."""
    return compiled(function, fastmath=True)


def inner_kernel(function: F) -> F:
    """Compile ``function`` into kernels that call it."""
    return inner(function, fastmath=True)


@kernel
def activate(z: Array) -> Array:
    """Return tanh(z) to 5e-7, by Eigen's ratio of polynomials, which unlike libm's runs in vector registers."""
    out = np.empty_like(z)
    flat = z.reshape(-1)
    result = out.reshape(-1)
    for j in range(flat.size):
        v = min(max(flat[j], np.float32(-7.9)), np.float32(7.9))
        s = v * v
        p = np.float32(-2.76076847742355e-16) * s + np.float32(2.00018790482477e-13)
        p = p * s + np.float32(-8.60467152213735e-11)
        p = p * s + np.float32(5.12229709037114e-08)
        p = p * s + np.float32(1.48572235717979e-05)
        p = p * s + np.float32(6.37261928875436e-04)
        p = p * s + np.float32(4.89352455891786e-03)
        q = np.float32(1.19825839466702e-06) * s + np.float32(1.18534705686654e-04)
        q = q * s + np.float32(2.26843463243900e-03)
        q = q * s + np.float32(4.89352518554385e-03)
        result[j] = v * p / q
    return out


@kernel
def outward(a: Array, W: Array) -> Array:
    """Return a @ W.T, (B, P) from (B, Q), along the synapses ``W`` (P, Q).

    Up to ``MOST_IN_ORDER`` rows are each summed in one order, so that no row depends on the others. BLAS, for more,
    sums in an order of the whole batch, and an error of prediction is a small difference of large sums.
    """
    rows = a.shape[0]
    out = np.empty((rows, W.shape[0]), a.dtype)
    if rows > MOST_IN_ORDER:
        np.dot(a, W.T, out)
        return out
    whole = W.shape[0] - W.shape[0] % 4
    for i in range(0, whole, 4):
        for n in range(rows):
            p = q = r = s = np.float32(0)
            for j in range(W.shape[1]):
                p += a[n, j] * W[i, j]
                q += a[n, j] * W[i + 1, j]
                r += a[n, j] * W[i + 2, j]
                s += a[n, j] * W[i + 3, j]
            out[n, i] = p
            out[n, i + 1] = q
            out[n, i + 2] = r
            out[n, i + 3] = s
    for i in range(whole, W.shape[0]):
        for n in range(rows):
            total = np.float32(0)
            for j in range(W.shape[1]):
                total += a[n, j] * W[i, j]
            out[n, i] = total
    return out


@inner_kernel
def beside(a: Array, b: Array) -> Array:
    """Return the columns of ``a`` (B, P), then those of ``b`` (B, Q); numba takes far longer to compile ``hstack``."""
    out = np.empty((a.shape[0], a.shape[1] + b.shape[1]), a.dtype)
    for n in range(a.shape[0]):
        for i in range(a.shape[1]):
            out[n, i] = a[n, i]
        for i in range(b.shape[1]):
            out[n, a.shape[1] + i] = b[n, i]
    return out


@inner_kernel
def feedback(f: Array, x: Array, W_F: Array, pi_x: Array) -> Array:
    """Return W_Fᵀ Π_x ε_x (B, H) for firing rates ``f`` (B, H); for a single row each weight is read once."""
    X, H = W_F.shape
    out = np.zeros(f.shape, f.dtype)
    if f.shape[0] > 1:
        error = np.empty(x.shape, f.dtype)
        np.dot(f, W_F.T, error)
        for n in range(x.shape[0]):
            for i in range(X):
                error[n, i] = pi_x[n, i] * (x[n, i] - error[n, i])
        np.dot(error, W_F, out)
        return out
    whole = X - X % 4
    for i in range(0, whole, 4):
        a = b = c = d = np.float32(0)
        for j in range(H):
            a += f[0, j] * W_F[i, j]
            b += f[0, j] * W_F[i + 1, j]
            c += f[0, j] * W_F[i + 2, j]
            d += f[0, j] * W_F[i + 3, j]
        a = pi_x[0, i] * (x[0, i] - a)
        b = pi_x[0, i + 1] * (x[0, i + 1] - b)
        c = pi_x[0, i + 2] * (x[0, i + 2] - c)
        d = pi_x[0, i + 3] * (x[0, i + 3] - d)
        for j in range(H):
            out[0, j] += a * W_F[i, j] + b * W_F[i + 1, j] + c * W_F[i + 2, j] + d * W_F[i + 3, j]
    for i in range(whole, X):
        a = np.float32(0)
        for j in range(H):
            a += f[0, j] * W_F[i, j]
        a = pi_x[0, i] * (x[0, i] - a)
        for j in range(H):
            out[0, j] += a * W_F[i, j]
    return out


@inner_kernel
def energy_gradient(
    z: Array, mu: Array, x: Array, W_F: Array, pi_z: Scalar, pi_x: Array
) -> tuple[Array, Array]:
    """Return ∂F/∂z (B, H), and the most that the bend of f adds to the curvature of F (B,).

    ``x`` (B, X) are senses and actions, less what is predicted past the state; Π_x (B, X) is 0 where not sensed.
    """
    f = activate(z)  # (B, H)
    gradient = feedback(f, x, W_F, pi_x)
    bend = np.empty(z.shape[0], z.dtype)
    for n in range(z.shape[0]):
        steepest = np.float32(0)
        for j in range(z.shape[1]):
            steepest = max(steepest, abs(gradient[n, j]))
        bend[n] = STEEPEST * steepest
        for j in range(z.shape[1]):
            gradient[n, j] = (
                pi_z * (z[n, j] - mu[n, j]) - (np.float32(1) - f[n, j] * f[n, j]) * gradient[n, j]
            )
    return gradient, bend


@kernel
def infer(mu: Array, x: Array, W_F: Array, pi_x: Array, inference: Inference) -> Array:
    """Return z_t (B, H) after at most so many steps down the energy from μ; ``x`` and Π_x as in ``energy_gradient``."""
    z = mu.copy()
    for _ in range(inference.iterations):
        gradient, bend = energy_gradient(z, mu, x, W_F, inference.prior_precision, pi_x)
        farthest = np.float32(0)
        for n in range(z.shape[0]):
            step = STRIDE / (inference.curvature + bend[n])
            for j in range(z.shape[1]):
                move = step * gradient[n, j]
                z[n, j] -= move
                farthest = max(farthest, abs(move))
        if farthest < STILL:
            break
    return z
