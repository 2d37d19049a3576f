"""Real spherical harmonics as 3DGS uses them, and fitting them to colours seen from several directions."""

from __future__ import annotations

import numpy as np

from ..gaussians import SH_C0

C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def sh_basis(
    directions: np.ndarray,  # [..., 3] unit, from the camera to the point
    degree: int,  # 0–3
) -> np.ndarray:
    """Y_k(ω) with 3DGS's signs and order, [..., (degree+1)²]."""
    x, y, z = np.moveaxis(directions, -1, 0)
    bands = [np.full_like(x, SH_C0)]
    if degree > 0:
        bands += [-C1 * y, C1 * z, -C1 * x]
    if degree > 1:
        bands += [
            C2[0] * x * y,
            C2[1] * y * z,
            C2[2] * (2 * z * z - x * x - y * y),
            C2[3] * x * z,
            C2[4] * (x * x - y * y),
        ]
    if degree > 2:
        bands += [
            C3[0] * y * (3 * x * x - y * y),
            C3[1] * x * y * z,
            C3[2] * y * (4 * z * z - x * x - y * y),
            C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            C3[4] * x * (4 * z * z - x * x - y * y),
            C3[5] * z * (x * x - y * y),
            C3[6] * x * (x * x - 3 * y * y),
        ]
    return np.stack(bands, -1)


def fit_anchored_sh(
    anchor: np.ndarray,  # [N, 3] colour c_0 in [0, 1] that must be reproduced in the reference direction
    anchor_direction: np.ndarray,  # [N, 3] unit ω_0
    residuals: np.ndarray,  # [N, V, 3] c_ω − c_0
    directions: np.ndarray,  # [N, V, 3] unit ω
    weights: np.ndarray,  # [N, V] ≥ 0, 0 = not observed
    degree: int,
    ridge: float,  # added to the diagonal, in observations' weight
) -> np.ndarray:
    """SH coefficients [N, (degree+1)², 3] by weighted least squares on residual colours (paper supplementary).

    The basis is Y_k(ω) − Y_k(ω_0), so that c_0 comes out exactly in the reference direction (METHOD section 6: the
    printed system does not do that), and the 0.5 of 3DGS's colours is taken off. Without observations the
    higher coefficients are 0.
    """
    n, bands = len(anchor), (degree + 1) ** 2
    sh = np.zeros((n, bands, 3))
    at_anchor = sh_basis(anchor_direction, degree)
    if degree > 0:
        basis = (sh_basis(directions, degree) - at_anchor[:, None])[..., 1:]  # [N, V, bands−1]
        weighted = basis * weights[..., None]
        normal = np.einsum("nvi,nvj->nij", weighted, basis) + ridge * np.eye(bands - 1)
        sh[:, 1:] = np.linalg.solve(normal, np.einsum("nvi,nvc->nic", weighted, residuals))
    sh[:, 0] = (anchor - 0.5 - np.einsum("nk,nkc->nc", at_anchor[:, 1:], sh[:, 1:])) / SH_C0
    return sh


def residual_weights(
    residuals: np.ndarray,  # [N, V, 3]
    directions: np.ndarray,  # [N, V, 3]
    anchor_direction: np.ndarray,  # [N, 3]
    observed: np.ndarray,  # [N, V] bool
) -> np.ndarray:
    """The paper's robust weights e_ω [N, V], with σ_0 from the residuals' median absolute deviation."""
    size = np.linalg.norm(residuals, axis=-1)
    sigma = 1.4826 * np.median(size[observed]) if observed.any() else 0.0
    sigma = max(float(sigma), 1.0 / 255)
    cosine = (directions * anchor_direction[:, None]).sum(-1)
    return observed * np.exp(-(size**2) / (2 * (sigma * np.exp(1 - cosine)) ** 2))
