"""A training step on a full-size head and hand, with the options of a run's file.

11,514 billboards of FLAME and MANO, one view whose window is the whole picture; pixels, and the spectral
coordinates where the options want any, are random: what a step costs does not depend on them.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from nbavatar.config.run import load_run
from nbavatar.config.training import TrainConfig
from nbavatar.config.yamlfiles import read_yaml
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.synthetic.scene import full_scene
from nbavatar.data.views import Sample, View
from nbavatar.methods.billboards.training import BillboardTraining
from nbavatar.methods.create import create_method
from nbavatar.metrics.lpips import load_lpips
from nbavatar.optimization.adam import Adam
from nbavatar.optimization.groups import split_groups
from nbavatar.optimization.muon import Muon
from nbavatar.optimization.schedule import Plan

__all__ = ["FRAME", "StepScene", "training_options"]

FRAME = "f"
"""Id of the frame that is trained on."""
_COORDINATES = 6


def training_options(path: str) -> TrainConfig:
    """Training options of a run's file (`stages: train:`), of billboards.

    Raises:
        ConfigError: no such file, or not one of a run.
    """
    return load_run(read_yaml(path, "a run's configuration"), path).stages.train


class StepScene:
    """Method in its initial state, a view whose avatar fills the picture, and what a step needs beside.

    Attributes:
        method, optimizer, muon, lpips: of the options.
        sample: the view.
        verts: vertices of its frame, by part.
        size: image side [px].
    """

    def __init__(self, size: int, config: TrainConfig, device: str, sequence: MeshSequence | None = None) -> None:
        """Args: image side [px]; options; `cpu` or `cuda`; other meshes than the full-size head and hand."""
        sequence = full_scene(4, dents=False) if sequence is None else sequence
        verts = {name: torch.from_numpy(part.verts[2]).float() for name, part in sequence.parts.items()}
        generator = np.random.default_rng(0)
        coords = {
            name: generator.uniform(-1.0, 1.0, (len(part.rest), _COORDINATES)) for name, part in sequence.parts.items()
        }
        self.size, self.sample = size, _sample(size, torch.cat(list(verts.values())))
        method = create_method(sequence, coords, [self.sample.view], config, device)
        assert isinstance(method, BillboardTraining)
        method.avatar.train()
        self.method, self.verts = method, {name: values.to(device) for name, values in verts.items()}
        for_adam, for_muon = split_groups(method.parameter_groups())
        self.optimizer, self.muon = Adam(for_adam), Muon(for_muon)
        self.lpips = load_lpips(config.lpips_net).to(device) if method.lpips_net() else None
        self._anchor = method.avatar.anchor(self.verts, FRAME)

    def plan(self, number: int = 0, progress: float = 0.9) -> Plan:
        """Settings of a step late in the training, where all terms count; even numbers have LPIPS in a capture's."""
        return self.method.plan(progress, self.size, number)._replace(shrink=1)

    def step(self, number: int = 0) -> None:
        """One step, as the trainer makes it, but for its checks."""
        self.optimizer.zero_grad()
        self.muon.zero_grad()
        random = torch.Generator().manual_seed(0)
        lost = self.method.step_loss(self.sample, self._anchor, self.lpips, self.plan(number), random)
        lost.total.backward()
        self.update()
        self.method.after_step(self.optimizer, lost.aux, number, 0.9, random)

    def update(self) -> None:
        """What the optimizers do with the gradients that are there."""
        self.optimizer.step()
        self.muon.step()

    def stepping(self) -> Callable[[], None]:
        """A function that makes the next step at every call."""
        number = iter(range(1 << 62))
        return lambda: self.step(next(number))


def _sample(size: int, points: Tensor) -> Sample:
    """A view in which these points fill the picture."""
    centre, extent = (points.amax(0) + points.amin(0)) / 2, float((points.amax(0) - points.amin(0)).max())
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # z is up, it looks to -y
    viewmat[:3, 3] = -viewmat[:3, :3] @ centre + torch.tensor([0.0, 0.0, 4.0 * extent])
    focal = 3.6 * size
    K = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    view = View(0, "camera", FRAME, 2, size, size, K, viewmat)
    pixels = torch.rand((5, size, size), generator=torch.Generator().manual_seed(0))
    pixels[3], pixels[4] = 1.0, 0.0
    return Sample(view, pixels, 0, 0, size, size, K)
