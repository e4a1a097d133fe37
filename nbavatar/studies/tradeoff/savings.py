"""Only what a scene requires: each saving switched on and off, on the same pictures.

Every switch is measured in a scene in which it matters: the held-out pictures as they are, the same camera with the
avatar an eighth as large, turned away from it, or the avatar of one part. On and off are timed in turn; the pictures of
the two are compared with each other, and with the truth where there is one.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from statistics import fmean
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nbavatar.config.tradeoff import SettingConfig, TradeoffConfig, vary
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.billboards import Posed
from nbavatar.methods.billboards.compression.footprint import texels_of
from nbavatar.methods.billboards.compression.reduce import avatar_bytes, keep_billboards, keep_parts, size_textures
from nbavatar.metrics.lpips import LPIPS
from nbavatar.studies.tradeoff.measure import (
    Reference,
    Shot,
    difference,
    peak_memory_mb,
    quality,
    reference,
    time_pairs,
)
from nbavatar.studies.tradeoff.tuned import TunedAvatar

__all__ = ["even_rows", "measure_savings", "savings_markdown", "shrunk", "turned_away"]

_FAR = 8.0  # the avatar is this many times smaller in the distant scene


class _Switch(NamedTuple):
    """One saving: its name, the scene, the avatars with and without it, the pictures, whether they have a truth."""

    name: str
    scene: str
    on: TunedAvatar
    off: TunedAvatar
    shots: Sequence[Shot]
    judged: bool


def shrunk(shot: Shot, times: float) -> Shot:
    """The same picture size with the avatar `times` smaller in it, about the middle."""
    scale = torch.tensor([1 / times, 1 / times, 1.0])[:, None].to(shot.K)
    centre = torch.tensor([shot.view.width / 2, shot.view.height / 2, 0.0]).to(shot.K)
    K = shot.K.clone()
    K[:, 2] -= centre
    K = K * scale
    K[:, 2] += centre
    return dataclasses.replace(shot, K=K)


def turned_away(shot: Shot) -> Shot:
    """The camera turned about its vertical axis by half a turn: nothing of the avatar is in the picture."""
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])).to(shot.viewmat)
    return dataclasses.replace(shot, viewmat=turn @ shot.viewmat)


def measure_savings(
    avatar: Avatar, shots: Sequence[Shot], importance: Tensor, footprints: Tensor, net: LPIPS, sheet: TradeoffConfig,
    *, device: str = "cpu",
) -> Iterator[dict[str, Any]]:  # fmt: skip
    """Every switch of a picture, on and off.

    Args:
        avatar: trained.
        shots: held-out pictures.
        importance: contributions (N, F) of the billboards to training views.
        footprints: largest footprint (F,) of the billboards in training views [px].
        net: LPIPS on `device`.
        sheet: repeats and warm-up.
        device: where the avatar computes.

    Yields:
        One row a switch: `saving`, `scene`, `on_ms`, `off_ms`, `faster` (median ratio of paired pictures), memory and
        bytes on and off, largest difference, share of the pixels that differ by more than 1/255 and LPIPS between
        the two, change of PSNR and LPIPS against the truth where there is one (else None), and the work counted, on and
        off.
    """
    looks: dict[tuple[int, int], _Look] = {}  # many switches share a side: the exact setting is looked at once
    for switch in list(_switches(avatar, shots, importance, footprints)):
        times = time_pairs(
            switch.on, switch.off, switch.shots, repeats=sheet.repeats, warmup=sheet.warmup, device=device
        )
        sides = []
        for side in (switch.on, switch.off):
            key = id(side), id(switch.shots)
            if key not in looks:
                looks[key] = _look(side, switch.shots, net, device, switch.judged)
            sides.append(looks[key])
        on, off = sides
        apart = [difference(*pair, net) for pair in zip(on.images, off.references(net), strict=True)]
        work = {"on": on.work, "off": off.work}
        memory = [on.memory_mb, off.memory_mb]
        changes = [
            [(with_it[name] or 0.0) - (without[name] or 0.0) for name in ("psnr", "lpips_net")]
            for with_it, without in zip(on.quality, off.quality, strict=True)
        ]
        yield {
            "saving": switch.name,
            "scene": switch.scene,
            "on_ms": times["ms"]["total"],
            "off_ms": times["exact_ms"],
            "faster": times["speedup"],
            "on_memory_mb": memory[0],
            "off_memory_mb": memory[1],
            "on_mb": avatar_bytes(switch.on.avatar) / 1e6,
            "off_mb": avatar_bytes(switch.off.avatar) / 1e6,
            "diff_max": max(row["diff_max"] for row in apart),
            **{name: fmean(row[name] for row in apart) for name in ("diff_share", "lpips_apart")},
            "psnr_change": fmean(c[0] for c in changes) if changes else None,
            "lpips_change": fmean(c[1] for c in changes) if changes else None,
            **{f"{side}_{name}": value for side in work for name, value in work[side].items()},
        }


def even_rows(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows with the same keys: None where a row has no such value."""
    rows = list(rows)
    names = dict.fromkeys(name for row in rows for name in row)
    return [{name: row.get(name) for name in names} for row in rows]


def savings_markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows of `even_rows` as a table to read."""
    head = ["saving", "scene", "ms on", "ms off", "faster", "memory on / off [MB]", "avatar on / off [MB]",
            "pixels changed", "LPIPS apart", "PSNR [dB]", "LPIPS", "apart [mm]", "decoded pixels on / off",
            "billboards or vertices on / off"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|---|---|" + "---:|" * (len(head) - 2)]
    for row in rows:

        def pair(name: str, form: str, row: Mapping[str, Any] = row) -> str:
            return " / ".join(_cell(row.get(f"{side}_{name}"), form) for side in ("on", "off")).strip(" /")

        share = row.get("diff_share")
        cells = [
            row["saving"],
            row["scene"],
            f"{row['on_ms']:.1f}",
            f"{row['off_ms']:.1f}",
            f"{row['faster']:.2f}x",
            pair("memory_mb", ".1f"),
            pair("mb", ".2f"),
            "" if share is None else f"{100 * share:.2f}%",
            _cell(row.get("lpips_apart"), ".4f"),
            _cell(row.get("psnr_change"), "+.3f"),
            _cell(row.get("lpips_change"), "+.4f"),
            _cell(row.get("error_mm"), ".3f"),
            pair("decoded_pixels", "d"),
            pair("posed", "d"),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _cell(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _switches(avatar: Avatar, shots: Sequence[Shot], importance: Tensor, footprints: Tensor) -> Iterator[_Switch]:
    exact = SettingConfig(roi=False)

    def tuned(**change: Any) -> TunedAvatar:
        return TunedAvatar(avatar, vary(exact, change), importance=importance)

    far = [shrunk(shot, _FAR) for shot in shots]
    away = [turned_away(shot) for shot in shots]
    base, window = tuned(), tuned(roi=True)
    distant = f"avatar {_FAR:g}x smaller"
    yield _Switch("region of interest", "held-out pictures", window, base, shots, True)
    yield _Switch("region of interest", distant, window, base, far, False)
    yield _Switch("empty pictures skipped", "avatar behind the camera", base, _Unaware(avatar, exact), away, False)
    shown = (importance.amax(0) > 0).nonzero().squeeze(1)
    seen = TunedAvatar(keep_billboards(avatar, shown.to(avatar.faces.device)), exact)
    yield _Switch("billboards that training views show", "held-out pictures", seen, base, shots, True)
    yield _Switch("billboards pruned to 75%", "held-out pictures", tuned(billboards=0.75), base, shots, True)
    yield _Switch("early ray stop (t_min 1e-4)", "held-out pictures", base, tuned(t_min=0.0), shots, True)
    yield _Switch("early ray stop (t_min 0.01)", "held-out pictures", tuned(t_min=0.01), base, shots, True)
    yield _Switch("level of detail", "held-out pictures", tuned(mips=True), base, shots, True)
    yield _Switch("level of detail", distant, tuned(roi=True, mips=True), window, far, False)
    yield _Switch("window and level of detail", distant, tuned(roi=True, mips=True), base, far, False)
    texels = avatar.architecture.texels
    if texels > 1:
        for density in (1.0, 2.0):
            sized = TunedAvatar(size_textures(avatar, texels_of(footprints, density)), exact)
            name = f"textures by footprint ({density:g} texels a pixel)"
            yield _Switch(name, "held-out pictures", sized, base, shots, True)
        half = (texels + 1) // 2
        yield _Switch(f"textures of {half} texels", "held-out pictures", tuned(texels=half), base, shots, True)
    if len(avatar.parts) > 1:
        alone = avatar.parts[0]
        one = [dataclasses.replace(shot, verts={alone: shot.verts[alone]}) for shot in shots]
        unaware = _Unaware(avatar, exact)
        yield _Switch("absent parts left out", f"{alone} only", base, unaware, one, False)
        only = TunedAvatar(keep_parts(avatar, [alone]), exact)
        yield _Switch(f"an avatar of {alone} only", f"{alone} only", only, unaware, one, False)


class _Unaware(TunedAvatar):
    """What a renderer does that does not look first: absent parts are posed, empty pictures are drawn and decoded."""

    def render(self, verts: Mapping[str, Tensor], *args: Any, laps: Any = None, **options: Any) -> Any:
        viewmat, K, width, height, background = args
        with torch.no_grad():
            a = self.avatar
            nowhere = {part: a.billboards.mu.new_zeros(count, 3) for part, count in a.vertex_counts.items()}
            posed, keep = a.pose({**nowhere, **verts})[0], None
            self.work.posed += a.primitives
            if len(verts) < len(a.parts):
                there = torch.tensor([part in verts for part in a.parts])
                keep = there[a.face_groups()].nonzero().squeeze(1).to(a.faces.device)
                posed = Posed(*(values[keep] for values in posed))
            if laps is not None:
                laps("pose")
            window = self.avatar.window(posed, keep, viewmat, K, width, height, roi=False)
            pixels = window.region.width * window.region.height
            self.work.raster_calls, self.work.decoder_calls = self.work.raster_calls + 1, self.work.decoder_calls + 1
            self.work.raster_pixels += pixels
            self.work.decoded_pixels += pixels
            if laps is not None:
                laps("raster")
                laps("renderer")
            planes = window.alpha[:height, :width], window.nb_alpha[:height, :width]
            image = window.colour[:, :height, :width] * planes[0] + (1 - planes[0]) * background[:, None, None]
            if laps is not None:
                laps("compose")
        return image, *planes


@dataclasses.dataclass
class _Look:
    """What one side of a switch shows: pictures (3, H, W), metrics where judged, memory and work of the first."""

    images: list[Tensor]
    quality: list[dict[str, float | None]]
    memory_mb: float
    work: dict[str, int]
    _references: list[Reference] = dataclasses.field(default_factory=list)

    def references(self, net: LPIPS) -> list[Reference]:
        if not self._references:
            self._references = [reference(image, net) for image in self.images]
        return self._references


def _look(avatar: TunedAvatar, shots: Sequence[Shot], net: LPIPS, device: str, judged: bool) -> _Look:
    before = asdict(avatar.work)
    memory, first = peak_memory_mb(avatar, shots[0], device)
    work = {name: value - before[name] for name, value in asdict(avatar.work).items() if name != "pictures"}
    images = [first, *(shot.render(avatar)[0] for shot in shots[1:])]
    metrics = [quality(image, shot, net) for image, shot in zip(images, shots, strict=True)] if judged else []
    return _Look(images, metrics, memory, work)
