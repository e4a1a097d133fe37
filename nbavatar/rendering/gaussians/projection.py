"""3D Gaussians seen from one camera, as 2D Gaussians on the image.

A Gaussian of covariance Sigma = R S S^T R^T about a mean m lands on the image as a Gaussian about
the projected mean with the covariance

    Sigma' = J W Sigma W^T J^T + h I        (Zwicker et al. 2001, eq. 31; Kerbl et al. 2023, eq. 5)

where W is the camera's rotation, J the derivative of the pixel by the point in camera axes, taken
at the mean, and h the low-pass [px^2]. J grows without bound for points beside the camera, far
outside the image; its direction of view is therefore clamped to the image widened by 15 % of its
width and height on each side, which changes only Gaussians whose mean lies outside of that.

For blending, exp(-d^T Sigma'^-1 d / 2) is written with the conditional form of the normal
distribution: with Sigma' = [[a, b], [b, c]] and d = (x, y) - mean,

    d^T Sigma'^-1 d = u^2 + v^2,    u = p dx + s dy,    v = k dy,
    p = sqrt(c / det),  s = -p b / c,  k = 1 / sqrt(c).

That is a sum of two squares, so a long thin Gaussian costs no cancellation; v is constant along a
row of pixels, so the columns that a row covers follow in closed form. The determinant is a sum of
squares as well: with T = J W R S, det = |T_1 x T_2|^2 + h tr(T T^T) + h^2.

Everything is float64 and elementwise: no bit of a Gaussian's record depends on where it stands in
the arrays.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["FAINTEST", "MARGIN", "SIGMAS", "Projection", "camera_centre", "project_gaussians", "support_box"]

FAINTEST = 1e-30  # alpha that counts as nothing even where no threshold is set
MARGIN = 0.15  # of the image, by which the clamp of the Jacobian lies outside of it
SIGMAS = 3.0  # of the radius that is reported


@dataclass(frozen=True)
class Projection:
    """N Gaussians in one camera.

    Attributes:
        form: (N, 5) float64 `p, s, k` and the mean `x, y` [px]; differentiable.
        variances: (N, 2) float64, a and c, in x and in y [px^2], low-pass included; no gradient.
        depth: (N,) float64 depth of the mean [m].
        visible: (N,) bool, whether the mean is at least `near` before the camera and the form exists.
        radii: (N,) float64 three standard deviations along the longer axis [px]; 0 where the Gaussian
            is not visible or that square lies off the image.
    """

    form: Tensor
    variances: Tensor
    depth: Tensor
    visible: Tensor
    radii: Tensor


def camera_centre(viewmat: Tensor) -> Tensor:
    """Position (3,) of a camera with the rigid transform (4, 4) `cam_from_world`."""
    rotation, shift = viewmat[:3, :3], viewmat[:3, 3]
    return -(rotation * shift[:, None]).sum(0)


def _axes(quats: Tensor) -> tuple[tuple[Tensor, ...], ...]:
    """Columns of the rotation matrices of wxyz quaternions of any norm but zero."""
    w, x, y, z = quats.unbind(-1)
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return (
        (1.0 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)),
        (s * (x * y - w * z), 1.0 - s * (x * x + z * z), s * (y * z + w * x)),
        (s * (x * z + w * y), s * (y * z - w * x), 1.0 - s * (x * x + y * y)),
    )


def project_gaussians(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    near: float,
    low_pass: float,
    screen_offsets: Tensor | None = None,
) -> Projection:
    """Projects Gaussians into one camera.

    Args:
        means: (N, 3) world [m].
        quats: (N, 4) wxyz, of any norm but zero.
        scales: (N, 3) standard deviations along the axes [m].
        viewmat: (4, 4) `cam_from_world`.
        K: (3, 3) intrinsics [px], upper triangular; skew is honoured.
        width, height: image [px], for the clamp of the Jacobian and for `radii`.
        near: least depth of a mean [m].
        low_pass: h [px^2].
        screen_offsets: (N, 2) added to the projected means [px].

    Returns:
        A Projection; `form` carries gradients to means, quats, scales and offsets.
    """
    view, intr = viewmat.detach().double(), K.detach().double()
    fx, skew, cx, fy, cy = intr[0, 0], intr[0, 1], intr[0, 2], intr[1, 1], intr[1, 2]

    def rotate(vector: tuple[Tensor, ...]) -> list[Tensor]:
        return [view[i, 0] * vector[0] + view[i, 1] * vector[1] + view[i, 2] * vector[2] for i in range(3)]

    px, py, pz = (value + view[i, 3] for i, value in enumerate(rotate(means.double().unbind(-1))))
    visible = pz.detach() >= near
    z = torch.where(visible, pz, 1.0)
    tx, ty = px / z, py / z
    x, y = fx * tx + skew * ty + cx, fy * ty + cy
    # the direction at which J is taken: y first, for with skew the range of x depends on it
    ty = ty.clamp((-MARGIN * height - cy) / fy, ((1 + MARGIN) * height - cy) / fy)
    side = torch.minimum(fx * tx + skew * ty, (1 + MARGIN) * width - cx)
    side = torch.maximum(side, -MARGIN * width - cx)

    row_x, row_y = [], []
    for axis, scale in zip(_axes(quats.double()), scales.double().unbind(-1), strict=True):
        ax, ay, az = (value * scale for value in rotate(axis))
        row_x.append((fx * ax + skew * ay - side * az) / z)
        row_y.append((fy * ay - fy * ty * az) / z)
    a = row_x[0] * row_x[0] + row_x[1] * row_x[1] + row_x[2] * row_x[2]
    b = row_x[0] * row_y[0] + row_x[1] * row_y[1] + row_x[2] * row_y[2]
    c = row_y[0] * row_y[0] + row_y[1] * row_y[1] + row_y[2] * row_y[2]
    minors = [row_x[i] * row_y[j] - row_x[j] * row_y[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    det = minors[0] * minors[0] + minors[1] * minors[1] + minors[2] * minors[2]
    det = det + low_pass * (a + c) + low_pass * low_pass
    a, c = a + low_pass, c + low_pass

    visible = visible & (det.detach() > 0) & torch.isfinite(det.detach())
    a, b, c, det = (torch.where(visible, value, fill) for value, fill in ((a, 1.0), (b, 0.0), (c, 1.0), (det, 1.0)))
    p = (c / det).sqrt()
    if screen_offsets is not None:
        x, y = x + screen_offsets[:, 0].double(), y + screen_offsets[:, 1].double()
    form = torch.stack([p, -p * b / c, 1.0 / c.sqrt(), x, y], -1)
    with torch.no_grad():
        half_gap = (0.25 * (a - c).square() + b * b).sqrt()
        radius = SIGMAS * (0.5 * (a + c) + half_gap).sqrt()
        on_image = (x + radius > 0) & (x - radius < width) & (y + radius > 0) & (y - radius < height)
        radii = torch.where(visible & on_image, radius, 0.0)
    return Projection(form, torch.stack([a, c], -1).detach(), pz.detach(), visible, radii)


@torch.no_grad()
def support_box(projection: Projection, opacities: Tensor, alpha_min: float) -> tuple[Tensor, Tensor]:
    """Where Gaussians reach a given alpha.

    Args:
        projection: of N Gaussians.
        opacities: (N,).
        alpha_min: alpha that has to be reached; `FAINTEST` where it is smaller.

    Returns:
        (N,) float64 bound on sqrt(u^2 + v^2), negative where alpha is reached nowhere, and (N, 4)
        float64 box `x0, y0, x1, y1` [px], with `x0 > x1` there.
    """
    ratio = opacities.double() / max(alpha_min, FAINTEST)
    seen = projection.visible & (ratio >= 1.0)
    reach = torch.where(seen, (2.0 * ratio.clamp_min(1.0).log()).sqrt(), -1.0)
    half = reach[:, None] * projection.variances.sqrt()
    mean = projection.form[:, 3:].detach()
    box = torch.cat([mean - half, mean + half], -1)
    hidden = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=box.dtype, device=box.device)
    return reach, torch.where(seen[:, None], box, hidden)
