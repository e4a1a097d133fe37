"""The scene that the rasterizer is measured on: billboards on a full-size head and the hand that touches it."""

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from nbavatar.data.synthetic.scene import full_scene
from nbavatar.math.rotations import matrix_to_quaternion
from nbavatar.mesh.frames import face_frames
from nbavatar.methods.billboards.billboards import Billboards, gaussian_alpha_logits, initial_half_extents

__all__ = ["RasterScene", "make_scene"]


@dataclass(frozen=True)
class RasterScene:
    """Inputs of `render_billboards`: five tensors of F billboards and one camera.

    Attributes:
        means, quats, half_extents, features, alpha: float32.
        viewmat: (4, 4).
        K: (3, 3) for an image of `size` by `size` pixels.
        size: [px].
    """

    means: Tensor
    quats: Tensor
    half_extents: Tensor
    features: Tensor
    alpha: Tensor
    viewmat: Tensor
    K: Tensor
    size: int

    @property
    def billboards(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The five differentiable tensors."""
        return self.means, self.quats, self.half_extents, self.features, self.alpha

    def to(self, device: str) -> "RasterScene":
        """The same scene on another device."""
        moved = (tensor.to(device) for tensor in (*self.billboards, self.viewmat, self.K))
        return RasterScene(*moved, self.size)


@cache
def _meshes() -> tuple[Tensor, Tensor, int]:
    """Vertices of head and hand in contact, merged (V, 3) float32, faces (F, 3), and the head's vertex count."""
    sequence = full_scene(4, dents=False)
    head, hand = sequence.parts["head"], sequence.parts["right_hand"]
    verts = torch.cat([torch.from_numpy(head.verts[2]), torch.from_numpy(hand.verts[2])]).float()
    count = head.verts.shape[1]
    faces = torch.cat([torch.from_numpy(head.faces), torch.from_numpy(hand.faces) + count])
    return verts, faces, count


def make_scene(
    *,
    size: int = 1024,
    billboards: int | None = None,
    channels: int = 6,
    texels: int = 16,
    state: str = "trained",
    seed: int = 0,
) -> RasterScene:
    """Builds the scene.

    One billboard a face (11,514 of FLAME and MANO); features are random. In the state `initial` training
    starts: opacity a Gaussian of peak 0.9 and deviation 0.5, half-extents 1.5 boxes around the triangle,
    two dozen layers on a pixel. The state `trained` stands in for an avatar whose surface has closed:
    half-extents of 1.1 boxes, opacity 0.95 inside that falls off towards the border. Another number of
    billboards is spread over the same surface, each as large as its share of it asks. The camera looks at
    the face from 0.8 m and the head fills 85 % of the height.

    Args:
        size: image side [px].
        billboards: F, or None for one a face.
        channels: C.
        texels: T.
        state: `trained` or `initial`.
        seed: of the features and of the spreading.
    """
    verts, faces, head_count = _meshes()
    generator = torch.Generator().manual_seed(seed)
    frames = face_frames(verts, faces)
    extents = initial_half_extents(verts, faces, frames, margin=1.5 if state == "initial" else 1.1)
    count = len(faces) if billboards is None else billboards
    if state == "initial":
        logits = gaussian_alpha_logits(texels, sigma=0.5, peak=0.9, floor=0.005)
    else:
        axis = torch.linspace(-1, 1, texels) if texels > 1 else torch.zeros(1)
        radius = (axis[:, None] ** 4 + axis**4) ** 0.25
        logits = torch.logit((0.95 * torch.sigmoid(16.0 * (0.75 - radius))).clamp_min(1e-4))
    logits = logits.expand(count, texels, texels)
    features = torch.rand(count, texels, texels, channels, generator=generator)
    if count == len(faces):
        model = Billboards(extents, features, logits)
        posed = model.pose(frames)
        means, quats, half_extents = (tensor.detach() for tensor in posed.planes)
    else:
        corners = verts[faces]
        areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1)
        chosen = torch.multinomial(areas, count, replacement=True, generator=generator)
        bary = torch.distributions.Dirichlet(torch.ones(3))
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            shares = bary.sample((count,))
        means = (corners[chosen] * shares[..., None]).sum(1)
        quats = matrix_to_quaternion(frames.R)[chosen]
        half_extents = (extents * frames.k[:, None])[chosen] * (len(faces) / count) ** 0.5
    head = verts[:head_count]
    low, high = head.amin(0), head.amax(0)
    centre, tall = (low + high) / 2, float(high[1] - low[1])
    distance = 0.8
    focal = 0.85 * size * distance / tall
    # the synthetic head looks along -z with y up; the camera stands before it
    viewmat = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))
    viewmat[:3, 3] = -(viewmat[:3, :3] @ (centre - torch.tensor([0.0, 0.0, distance])))
    K = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    alpha = torch.sigmoid(logits).contiguous()
    return RasterScene(means, quats, half_extents, features, alpha, viewmat, K, size)
