"""The networks: what a pose changes about Gaussians, and what points of a hand say about its touch.

All are small perceptrons with ReLU. Networks of changes start at exactly zero: an untrained avatar is GaussianAvatars'.
"""
# pyright: reportReturnType=false
# torch says of skip_init that it gives a module, whatever class is asked for.

import math

import torch
from torch import Tensor, nn
from torch.nn.utils import skip_init

__all__ = ["APPEARANCE", "GEOMETRY", "Changes", "PointFeatures", "encoded"]

GEOMETRY = 10
"""Numbers that are added to a Gaussian's geometry: position [k] (3), logarithms of the scales (3), quaternion (4)."""

APPEARANCE = 4
"""Numbers that are added to its appearance: harmonics of degree 0 (3), opacity before the sigmoid (1)."""

_OCTAVES = 4


def encoded(places: Tensor) -> Tensor:
    """Positions (M, 3) in [-1, 1] with sines and cosines of four octaves of them, (M, 27) (Mildenhall et al. 2020)."""
    waves = torch.cat([math.pi * 2.0**octave * places for octave in range(_OCTAVES)], 1)
    return torch.cat((places, waves.sin(), waves.cos()), 1)


class Changes(nn.Module):
    """Changes of Gaussians of one part under one pose.

    Two networks, of the geometry and of the appearance. Both see where a Gaussian is at rest and the code of the pose;
    the appearance also sees which way its triangle faces, because lights stand still in the world.
    """

    def __init__(self, place: int, code: int, width: int, random: torch.Generator | None = None) -> None:
        """Args: numbers that say where a Gaussian is; of the code; of hidden units; generator of the weights."""
        super().__init__()
        self.geometry = _Perceptron(place, code, width, GEOMETRY, random)
        self.appearance = _Perceptron(place + 3, code, width, APPEARANCE, random)

    def forward(self, place: Tensor, normals: Tensor, code: Tensor) -> Tensor:
        """Changes (M, 14).

        Args:
            place: (M, P); normals: of the triangles in the world, (M, 3); code: of the pose, (C,).
        """
        return torch.cat((self.geometry(place, code), self.appearance(torch.cat((place, normals), 1), code)), 1)


class PointFeatures(nn.Module):
    """Features of the points of hands near a face, after PointNet++ (Qi et al. 2017) with two levels.

    Each point gathers its neighbours on the hand by a perceptron and a maximum; all points together are gathered
    likewise. A point counts less the farther it is from the face, so a hand that is away says nothing.
    """

    def __init__(self, features: int, random: torch.Generator | None = None) -> None:
        """Args: number of features; generator of the weights."""
        super().__init__()
        self.first = _linear(3, features, random)
        self.second = _linear(features, features, random)
        self.third = _linear(features + 4, 2 * features, random)
        self.fourth = _linear(2 * features, features, random)

    def forward(self, centres: Tensor, groups: Tensor, near: Tensor) -> Tensor:
        """Features (C,), none negative.

        Args:
            centres: points in the frame of the head, in its size, (P, 3).
            groups: their neighbours relative to them, (P, K, 3).
            near: how near the face they are, from 0 (out of reach) to 1 (touching), (P,).
        """
        local = torch.relu(self.second(torch.relu(self.first(groups)))).amax(1)
        whole = torch.relu(self.third(torch.cat((local, centres, near[:, None]), 1)))
        return (torch.relu(self.fourth(whole)) * near[:, None]).amax(0)


class _Perceptron(nn.Module):
    """Two hidden layers; the code is the same for all rows, so its share of the first is computed once."""

    def __init__(self, place: int, code: int, width: int, outputs: int, random: torch.Generator | None) -> None:
        super().__init__()
        self.place = _linear(place, width, random, inputs=place + code)
        self.code = _linear(code, width, random, inputs=place + code, bias=False)
        self.hidden = _linear(width, width, random)
        self.last = _linear(width, outputs, None)

    def forward(self, place: Tensor, code: Tensor) -> Tensor:
        """(M, P) and (C,) to (M, outputs)."""
        return self.last(torch.relu(self.hidden(torch.relu(self.place(place) + self.code(code)))))


def _linear(
    before: int, after: int, random: torch.Generator | None, *, inputs: int | None = None, bias: bool = True
) -> nn.Linear:
    """A layer with weights after He et al. 2015 for `inputs` numbers in all and no bias yet; zero without generator."""
    layer = skip_init(nn.Linear, before, after, bias=bias)  # its own start would draw from the global generator
    with torch.no_grad():
        if bias:
            layer.bias.zero_()
        if random is None:
            layer.weight.zero_()
        else:
            layer.weight.copy_(torch.randn(after, before, generator=random) * math.sqrt(2.0 / (inputs or before)))
    return layer
