"""A stored avatar from a new camera: python examples/render_avatar.py model.pt meshes.npz out.png"""

import sys

import numpy as np
from PIL import Image

import nbavatar

model, meshes, out = sys.argv[1:4]
avatar, sequence = nbavatar.load_avatar(model), nbavatar.load_meshes(meshes)
vertices = {part: mesh.verts[0] for part, mesh in sequence.parts.items()}  # or any of your own, [V, 3] in metres
head = next(iter(vertices.values()))
middle, size = (head.min(0) + head.max(0)) / 2, np.ptp(head, axis=0).max()
camera = nbavatar.look_at(
    middle + np.array([2.0, 1.0, 4.0]) * size, middle, up=(0, 1, 0), width=512, height=512, fov=0.4
)
picture = nbavatar.render(avatar, vertices, camera, background=(1, 1, 1))
Image.fromarray((picture.rgb * 255 + 0.5).astype(np.uint8)).save(out)
print(f"{out}: {picture.rgb.shape[1]}x{picture.rgb.shape[0]}, {(picture.alpha > 0.5).mean():.0%} covered")
