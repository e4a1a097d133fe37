"""Only what a scene requires: each saving switched on and off, on the same pictures.

Every switch is measured in a scene in which it matters: the held-out pictures as they are, the same camera with the
avatar an eighth as large, turned away from it, or the avatar of one part. On and off are timed in turn; the pictures of
the two are compared with each other, and with the truth where there is one.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from statistics import fmean
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nbavatar.avatar.model import Avatar
from nbavatar.config.tradeoff import SettingConfig, TradeoffConfig, vary
from nbavatar.metrics.lpips import LPIPS
from nbavatar.tradeoff.measure import Shot, difference, peak_memory_mb, quality, reference, time_pairs
from nbavatar.tradeoff.reduce import avatar_bytes, keep_parts
from nbavatar.tradeoff.tuned import TunedAvatar

__all__ = ["measure_savings", "savings_markdown", "shrunk", "turned_away"]

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
    avatar: Avatar, shots: Sequence[Shot], importance: Tensor, net: LPIPS, sheet: TradeoffConfig, *, device: str = "cpu"
) -> list[dict[str, Any]]:
    """Every switch, on and off.

    Args:
        avatar: trained.
        shots: held-out pictures.
        importance: contributions (N, F) of the billboards to training views.
        net: LPIPS on `device`.
        sheet: repeats and warm-up.
        device: where the avatar computes.

    Returns:
        One row a switch: `saving`, `scene`, `on_ms`, `off_ms`, `faster` (median ratio of paired pictures), memory and
        bytes on and off, largest difference, share of the pixels that differ by more than 1/255 and LPIPS between
        the two, change of PSNR and LPIPS against the truth where there is one (else None), and the work counted, on and
        off.
    """
    rows = []
    for switch in _switches(avatar, shots, importance):
        times = time_pairs(
            switch.on, switch.off, switch.shots, repeats=sheet.repeats, warmup=sheet.warmup, device=device
        )
        apart, changes = [], []
        work = {"on": _counted(switch.on, switch.shots[0]), "off": _counted(switch.off, switch.shots[0])}
        for shot in switch.shots:
            on, off = shot.render(switch.on)[0], shot.render(switch.off)[0]
            apart.append(difference(on, reference(off, net), net))
            if switch.judged:
                without, with_it = quality(off, shot, net), quality(on, shot, net)
                changes.append([(with_it[name] or 0.0) - (without[name] or 0.0) for name in ("psnr", "lpips_net")])
        memory = [peak_memory_mb(side, switch.shots[0], device) for side in (switch.on, switch.off)]
        rows.append(
            {
                "saving": switch.name,
                "scene": switch.scene,
                "on_ms": times["ms"]["total"],
                "off_ms": times["exact_ms"],
                "faster": times["speedup"],
                "on_memory_mb": round(memory[0], 1),
                "off_memory_mb": round(memory[1], 1),
                "on_mb": round(avatar_bytes(switch.on.avatar) / 1e6, 3),
                "off_mb": round(avatar_bytes(switch.off.avatar) / 1e6, 3),
                "diff_max": max(row["diff_max"] for row in apart),
                **{name: fmean(row[name] for row in apart) for name in ("diff_share", "lpips_apart")},
                "psnr_change": fmean(c[0] for c in changes) if changes else None,
                "lpips_change": fmean(c[1] for c in changes) if changes else None,
                **{f"{side}_{name}": value for side in work for name, value in work[side].items()},
            }
        )
    return rows


def savings_markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as a table to read."""
    head = ["saving", "scene", "ms on", "ms off", "faster", "memory on / off [MB]", "avatar on / off [MB]",
            "pixels changed", "PSNR [dB]", "LPIPS", "decoded pixels on / off", "billboards posed on / off"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|---|---|" + "---:|" * (len(head) - 2)]
    for row in rows:
        judged = row["psnr_change"] is not None
        cells = [
            row["saving"],
            row["scene"],
            f"{row['on_ms']:.1f}",
            f"{row['off_ms']:.1f}",
            f"{row['faster']:.2f}x",
            f"{row['on_memory_mb']:.0f} / {row['off_memory_mb']:.0f}",
            f"{row['on_mb']:.2f} / {row['off_mb']:.2f}",
            f"{100 * row['diff_share']:.2f}%",
            f"{row['psnr_change']:+.3f}" if judged else "",
            f"{row['lpips_change']:+.4f}" if judged else "",
            f"{row['on_decoded_pixels']} / {row['off_decoded_pixels']}",
            f"{row['on_posed']} / {row['off_posed']}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _switches(avatar: Avatar, shots: Sequence[Shot], importance: Tensor) -> list[_Switch]:
    exact = SettingConfig(roi=False)

    def tuned(**change: Any) -> TunedAvatar:
        return TunedAvatar(avatar, vary(exact, change), importance=importance)

    far = [shrunk(shot, _FAR) for shot in shots]
    away = [turned_away(shot) for shot in shots]
    base, window = tuned(), tuned(roi=True)
    distant = f"avatar {_FAR:g}x smaller"
    switches = [
        _Switch("region of interest", "held-out pictures", window, base, shots, True),
        _Switch("region of interest", distant, window, base, far, False),
        _Switch("empty pictures skipped", "avatar behind the camera", base, _Unaware(avatar, exact), away, False),
        _Switch("billboards pruned to 75%", "held-out pictures", tuned(billboards=0.75), base, shots, True),
        _Switch("early ray stop (t_min 1e-4)", "held-out pictures", base, tuned(t_min=0.0), shots, True),
        _Switch("early ray stop (t_min 0.01)", "held-out pictures", tuned(t_min=0.01), base, shots, True),
        _Switch("textures by size on screen", "held-out pictures", tuned(mips=True), base, shots, True),
        _Switch("textures by size on screen", distant, tuned(roi=True, mips=True), window, far, False),
        _Switch("all window and texture savings", distant, tuned(roi=True, mips=True), base, far, False),
    ]
    if avatar.architecture.texels > 1:
        half = (avatar.architecture.texels + 1) // 2
        switches.append(
            _Switch(f"textures of {half} texels", "held-out pictures", tuned(texels=half), base, shots, True)
        )
    if len(avatar.parts) > 1:
        alone = avatar.parts[0]
        one = [dataclasses.replace(shot, verts={alone: shot.verts[alone]}) for shot in shots]
        only = TunedAvatar(keep_parts(avatar, [alone]), exact)
        unaware = _Unaware(avatar, exact)
        switches.append(_Switch("absent parts left out", f"{alone} only", base, unaware, one, False))
        switches.append(_Switch(f"an avatar of {alone} only", f"{alone} only", only, unaware, one, False))
    return switches


class _Unaware(TunedAvatar):
    """What a renderer does that does not look first: absent parts are posed, empty pictures are drawn and decoded."""

    def render(self, verts: Mapping[str, Tensor], *args: Any, laps: Any = None, **options: Any) -> Any:
        viewmat, K, width, height, background = args
        with torch.no_grad():
            posed, keep = self.avatar.pose(verts)
            self.work.posed += len(self.avatar.billboards.mu)
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


def _counted(avatar: TunedAvatar, shot: Shot) -> dict[str, int]:
    """Work of one picture."""
    before = asdict(avatar.work)
    shot.render(avatar)
    counted = {name: value - before[name] for name, value in asdict(avatar.work).items()}
    counted.pop("pictures")
    return counted
