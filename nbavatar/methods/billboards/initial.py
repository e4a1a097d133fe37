"""The avatar before the first step: architecture from the options, initial state from the rest meshes."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from nbavatar.config.training import TrainConfig
from nbavatar.data.lights import Light
from nbavatar.data.sequences import SHELL, MeshSequence
from nbavatar.errors import DataError
from nbavatar.mesh.frames import face_frames
from nbavatar.mesh.texels import texel_values
from nbavatar.methods.base import modelled_parts
from nbavatar.methods.billboards.architecture import Architecture
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.billboards import Billboards, gaussian_alpha_logits, initial_half_extents
from nbavatar.methods.billboards.losses import knn_graph
from nbavatar.methods.billboards.options import BillboardsConfig
from nbavatar.methods.billboards.refine import Refinement, displacement_basis
from nbavatar.methods.billboards.shading import Shading

__all__ = ["initial_avatar", "neighbour_graph"]

# Spread of random initial features (ablation of the spectral ones): comparable to coordinates in [-1, 1].
_RANDOM_SPREAD = 0.5


def initial_avatar(
    sequence: MeshSequence,
    coords: Mapping[str, np.ndarray],
    frames: Sequence[str],
    config: TrainConfig,
    light: Light | None = None,
) -> Avatar:
    """Build an avatar in its initial state; the same seed gives the same bits.

    Args:
        sequence: meshes; faces and rest poses are used.
        coords: spectral coordinates per part, float (V, K); may be empty for random features without refinement.
        frames: training frames, for the refinement.
        config: training options.
        light: of the studio; None, or one without lights, where it is not known.

    Raises:
        DataError: spectral coordinates of a part are missing or of another vertex count.
    """
    options: BillboardsConfig = config.own
    torch.manual_seed(config.seed)
    parts = modelled_parts(sequence, config)
    _check_coords(sequence, coords, parts, needed=options.init == "spectral" or options.refine.modes > 0)
    extents, features = [], []
    for part in parts:
        mesh = sequence.parts[part]
        rest, faces = torch.from_numpy(np.asarray(mesh.rest)).float(), torch.from_numpy(np.asarray(mesh.faces))
        size = initial_half_extents(rest, faces, face_frames(rest, faces), margin=options.extent_margin)
        extents.append(size)
        features.append(_initial_features(rest, faces, size, coords.get(part), options))
    count = sum(len(size) for size in extents)
    logits = gaussian_alpha_logits(
        options.texels,
        sigma=options.alpha_sigma,
        peak=options.alpha_peak,
        floor=min(options.alpha_floor, options.alpha_peak),
    )
    billboards = Billboards(torch.cat(extents), torch.cat(features), logits.expand(count, -1, -1).contiguous())
    refinement = None
    if options.refine.modes > 0:
        basis = {part: torch.from_numpy(np.asarray(coords[part])) for part in parts}
        refinement = Refinement(frames, displacement_basis(basis, options.refine.modes), rigid=options.refine.rigid)
    shaded = options.deferred and options.shading and light is not None and len(light.weights) > 0
    return Avatar(
        Architecture(
            channels=_channels(options),
            texels=options.texels,
            deferred=options.deferred,
            unet_width=options.unet.width,
            unet_depth=options.unet.depth,
            unet_max_width=options.unet.max_width,
            unet_convs=options.unet.convs,
            unet_form=options.unet.form,
            normals=options.deferred and options.normals,
            shading=shaded,
            gloss=options.deferred and options.gloss,
            roi=options.roi,
            roi_margin=options.roi_margin,
            order=options.order,
        ),
        {part: torch.from_numpy(np.asarray(sequence.parts[part].faces)) for part in parts},
        {part: len(sequence.parts[part].rest) for part in parts},
        billboards,
        refinement=refinement,
        shading=_shading(sequence, parts, light) if shaded and light is not None else None,
    )


def _shading(sequence: MeshSequence, parts: Sequence[str], light: Light) -> Shading:
    """The light, and what throws shadows: all parts but a shell."""
    if SHELL not in parts:
        return Shading(light)
    faces = {part: torch.from_numpy(np.asarray(sequence.parts[part].faces)) for part in parts}
    return Shading(light, {**faces, SHELL: faces[SHELL][:0]})


def neighbour_graph(avatar: Avatar, sequence: MeshSequence, config: TrainConfig) -> Tensor | None:
    """Neighbours of every billboard in rest pose, part by part, int64 (F, K); None when the term has no effect."""
    options: BillboardsConfig = config.own
    if options.weight_knn == 0 or options.neighbours < 2:
        return None
    rest = torch.from_numpy(np.concatenate([sequence.parts[part].rest for part in avatar.parts]))
    centroids = rest[avatar.faces.cpu()].mean(1)
    return knn_graph(centroids, avatar.face_groups(), options.neighbours, include_self=options.include_self)


def _channels(options: BillboardsConfig) -> int:
    return options.channels if options.deferred else 3


def _initial_features(
    rest: Tensor, faces: Tensor, size: Tensor, coords: np.ndarray | None, options: BillboardsConfig
) -> Tensor:
    """Neural textures float32 (F, T, T, C) before training."""
    shape = (len(faces), options.texels, options.texels, _channels(options))
    if not options.deferred:
        return torch.zeros(shape)  # mid grey behind the sigmoid
    if options.init == "random" or coords is None:
        return _RANDOM_SPREAD * torch.randn(shape)
    used = torch.from_numpy(np.asarray(coords, dtype=np.float32)[:, : options.channels])
    features = torch.zeros(shape)
    # Channels beyond the basis start at zero.
    if options.texels == 1:
        features[..., : used.shape[1]] = used[faces].mean(1)[:, None, None]
    else:
        known = texel_values(used.numpy(), rest.numpy(), faces.numpy(), size.numpy(), options.texels)
        features[..., : used.shape[1]] = torch.from_numpy(known)
    return features


def _check_coords(
    sequence: MeshSequence, coords: Mapping[str, np.ndarray], parts: Sequence[str], *, needed: bool
) -> None:
    if not needed:
        return
    for part in parts:
        count = len(sequence.parts[part].rest)
        if part not in coords:
            raise DataError.of("spectral coordinates", f"{part}.coords", expected="this array", found="none")
        if coords[part].ndim != 2 or len(coords[part]) != count:
            found = list(coords[part].shape)
            raise DataError.of("spectral coordinates", f"{part}.coords", expected=f"[{count}, K]", found=found)
