"""The scene: a set of 3D (or 2D, surfel) Gaussians, as 3DGS files store them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

SH_C0 = 0.28209479177387814  # Y_0; 3DGS stores colour as 0.5 + SH_C0 * f_dc, gamma-encoded sRGB
SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
SH_C3 = (
    *(-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154),
    *(-0.4570457994644658, 1.445305721320277, -0.5900435899266435),
)
ARRAYS = ("means", "log_scales", "quats", "opacity_logits", "sh")  # what Gaussians are made of, a row each


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians in the file's own frame and the file's own (raw) parametrisation.

    Values are raw: log-scales, opacity logits and unnormalised quaternions, because untouched rows must survive
    exactly. Use the properties for activated values.
    """

    means: np.ndarray  # [N, 3] float32, scene units
    log_scales: np.ndarray  # [N, 3] float32, natural log; [N, 2] for 2DGS surfels (the normal is the third axis)
    quats: np.ndarray  # [N, 4] float32, wxyz, not necessarily unit
    opacity_logits: np.ndarray  # [N] float32, ±inf is legal
    sh: np.ndarray  # [N, (degree+1)², 3] float32, coefficient k as (R, G, B)
    antialiased: bool = False  # trained with the mip-splatting opacity compensation

    def __post_init__(self) -> None:
        n = len(self.means)
        expected = ((n, 3), (n, self.log_scales.shape[-1]), (n, 4), (n,), (n, self.sh.shape[1], 3))
        for name, shape in zip(ARRAYS, expected):
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {getattr(self, name).shape}")
        if self.log_scales.shape[1] not in (2, 3) or self.sh.shape[1] not in (1, 4, 9, 16):
            raise ValueError(f"not a Gaussian set: {self.log_scales.shape[1]} scales, {self.sh.shape[1]} SH bands")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def is_surfels(self) -> bool:
        """True for 2DGS (two scales)."""
        return self.log_scales.shape[1] == 2

    @property
    def sh_degree(self) -> int:
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def scales(self) -> np.ndarray:
        """Standard deviations along the local axes, [N, 3 or 2]."""
        with np.errstate(over="ignore"):
            return np.exp(self.log_scales)

    @property
    def opacity(self) -> np.ndarray:
        """Opacity in [0, 1], [N]."""
        with np.errstate(over="ignore"):
            return 1.0 / (1.0 + np.exp(-self.opacity_logits))

    @property
    def usable(self) -> np.ndarray:
        """[N] bool: rows that can be drawn. NaN, infinite positions and zero quaternions are ignored in use."""
        finite = np.isfinite(self.means).all(1) & np.isfinite(self.quats).all(1) & np.isfinite(self.sh).all((1, 2))
        scales = ~np.isnan(self.log_scales).any(1) & (self.log_scales < 80).all(1)
        return finite & scales & ~np.isnan(self.opacity_logits) & ((self.quats**2).sum(1) > 1e-20)

    def take(self, rows: np.ndarray) -> Gaussians:
        """The Gaussians at `rows` (indices or a boolean mask), in that order."""
        return replace(self, **{name: getattr(self, name)[rows] for name in ARRAYS})

    def with_rows(self, rows: np.ndarray, others: Gaussians) -> Gaussians:
        """These Gaussians with others in the place of those at `rows`."""
        arrays = {name: getattr(self, name).copy() for name in ARRAYS}
        for name, array in arrays.items():
            array[rows] = getattr(others, name)
        return replace(self, **arrays)

    def extended(self, other: Gaussians | None) -> Gaussians:
        """These Gaussians followed by others of the same kind, if any; the lower SH degree is padded with zeros."""
        if other is None:
            return self
        if self.is_surfels != other.is_surfels:
            raise ValueError("cannot join 3D Gaussians and surfels")
        bands = max(self.sh.shape[1], other.sh.shape[1])
        pair = [replace(g, sh=pad_sh(g.sh, bands)) for g in (self, other)]
        return replace(self, **{name: np.concatenate([getattr(g, name) for g in pair]) for name in ARRAYS})


def pad_sh(sh: np.ndarray, bands: int) -> np.ndarray:
    """SH coefficients [N, K, 3] padded with zeros, or cut, to `bands` coefficients, [N, bands, 3]."""
    if sh.shape[1] >= bands:
        return sh[:, :bands]
    return np.concatenate([sh, np.zeros((len(sh), bands - sh.shape[1], 3), sh.dtype)], axis=1)


def quats_to_matrices(quats: np.ndarray) -> np.ndarray:
    """Rotation matrices [N, 3, 3] whose columns are the local axes, of quaternions [N, 4] wxyz of any norm > 0."""
    w, x, y, z = np.moveaxis(quats / np.linalg.norm(quats, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def matrices_to_quats(matrices: np.ndarray) -> np.ndarray:
    """Unit quaternions [N, 4] wxyz with w ≥ 0 of proper rotations [N, 3, 3] (Bar-Itzhack 2000: the dominant
    eigenvector of a 4×4 matrix)."""
    m = np.asarray(matrices, dtype=np.float64)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(m, 0, -1)
    rows = [
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, yy - xx - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, zz - xx - yy],
    ]
    _, vectors = np.linalg.eigh(np.stack([np.stack(r, axis=-1) for r in rows], axis=-2))
    wxyz = vectors[..., -1]
    return np.where(wxyz[:, :1] < 0, -wxyz, wxyz)


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Y_k(ω) [..., (degree+1)²], 3DGS's signs and order, of unit directions [..., 3] from the camera to the point."""
    x, y, z = np.moveaxis(directions, -1, 0)
    bands = [np.full_like(x, SH_C0)]
    if degree > 0:
        bands += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree > 1:
        squares = (SH_C2[2] * (2 * z * z - x * x - y * y), SH_C2[3] * x * z, SH_C2[4] * (x * x - y * y))
        bands += [SH_C2[0] * x * y, SH_C2[1] * y * z, *squares]
    if degree > 2:
        bands += [SH_C3[0] * y * (3 * x * x - y * y), SH_C3[1] * x * y * z, SH_C3[2] * y * (4 * z * z - x * x - y * y)]
        bands += [SH_C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y), SH_C3[4] * x * (4 * z * z - x * x - y * y)]
        bands += [SH_C3[5] * z * (x * x - y * y), SH_C3[6] * x * (x * x - 3 * y * y)]
    return np.stack(bands, -1)
