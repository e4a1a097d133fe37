"""Measure speed against quality of a trained avatar, setting by setting, and derive presets.

    --model         model.pt of `nbavatar train`; further ones (other channels, other U-Net widths) join as points
    --meshes        mesh sequence (.npz)
    --frames        held-out frame packs (.zip) with rgb and alpha: the truth that quality is judged by
    --train-frames  packs of the training cameras: their views decide which billboards contribute
    --protocol      JSON text, a file, or a name (nv1024, ...): which frames of the packs, on which background
    --sheet         JSON text or file: knobs, values, limits of the presets (see config/tradeoff.yaml)
    --side          least longer side of the pictures [px]: smaller frames are rendered a whole number of times as
                    large; quality is judged on the pictures averaged down to the frames' size
    --out           folder: points.jsonl (log; a sweep that was stopped goes on from it), points.csv (one row a
                    point), points.md, knobs.md (a paragraph a knob), front_{ms,memory,bytes}.{png,pdf}, presets.json,
                    tradeoff.json (all of it, with the run's record); presets.json is also put beside the model, where
                    `--preset` of render, speed and train finds it

Each point: PSNR [dB], SSIM, LPIPS on the held-out images; largest difference [1] to the exact setting's pictures, share
of the pixels that differ by more than 1/255, PSNR and LPIPS between the two; milliseconds by stage, taken in turn with
the exact setting; peak memory, size of the avatar. `--savings` measures instead every "only what a scene requires"
switch, on and off (savings.{csv,md}); `--offline` the stages before training (offline.{csv,md,png}): contact iterations
and substeps, refit, spectral modes, coarser meshes.
"""

import argparse
import math
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from nbavatar.cli.common import progress, read_mapping
from nbavatar.cli.evaluate import read_protocol
from nbavatar.cli.settings import timed_device
from nbavatar.config.core import to_mapping
from nbavatar.config.evaluation import ProtocolConfig
from nbavatar.config.tradeoff import TradeoffConfig, read_sheet
from nbavatar.devices import lease_device
from nbavatar.errors import ConfigError, DataError, DependencyError
from nbavatar.io.framepack import FramePack
from nbavatar.io.records import write_json
from nbavatar.provenance import code_digest, file_digest, run_record

__all__ = ["add_arguments", "main"]

_LONGEST = 8192  # side of a picture [px]
_CHOOSERS = 4096  # most views kept in mind when contributions are asked for
_SIZING_VIEWS = 200  # most views whose footprints are taken


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar tradeoff`."""
    parser.add_argument("--model", nargs="+", default=[], metavar="PT", help="trained avatar, then others")
    parser.add_argument("--meshes", required=True, metavar="NPZ", help="mesh sequence")
    parser.add_argument("--frames", nargs="+", default=[], metavar="ZIP", help="held-out frame packs")
    parser.add_argument("--train-frames", nargs="*", default=[], metavar="ZIP", help="packs of the training cameras")
    parser.add_argument("--protocol", default="nv1024", metavar="JSON|FILE|NAME", help="which held-out images")
    parser.add_argument("--sheet", default="{}", metavar="JSON|FILE", help="knobs and values (TradeoffConfig)")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder of the results")
    parser.add_argument("--side", type=int, default=0, metavar="PX", help="least longer side of the pictures")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"), help="where to compute")
    parser.add_argument("--max-minutes", type=float, metavar="MIN", help="stop after this time; a later call goes on")
    parser.add_argument("--no-store", action="store_true", help="do not put presets.json beside the model")
    parser.add_argument("--savings", action="store_true", help="measure the savings, each on and off")
    parser.add_argument(
        "--offline", action="store_true", help="measure the stages before training; needs --meshes only"
    )


def main(args: argparse.Namespace) -> int:
    """Runs `nbavatar tradeoff`."""
    sheet = read_sheet(read_mapping(args.sheet, "--sheet"), "--sheet")
    if args.offline:
        return _offline(args, sheet)
    for name in ("model", "frames"):
        if not getattr(args, name):
            raise ConfigError.of(f"--{name}", expected="one file or more", found="none")
    if not 0 <= args.side <= _LONGEST:
        raise ConfigError.of("--side", expected=f"0 to {_LONGEST}", found=str(args.side))
    protocol = read_protocol(args.protocol, "nv")
    with lease_device(args.device) as device, ExitStack() as stack:
        packs = [stack.enter_context(FramePack(path)) for path in args.frames]
        trains = [stack.enter_context(FramePack(path)) for path in args.train_frames]
        return _sweep(args, sheet, protocol, device, packs, trains)


def _offline(args: argparse.Namespace, sheet: TradeoffConfig) -> int:
    from itertools import chain

    from nbavatar.data.sequences import read_sequence
    from nbavatar.io.atomic import atomic_write
    from nbavatar.reporting.figures import save_figure
    from nbavatar.studies.tradeoff.figures import offline_figure
    from nbavatar.studies.tradeoff.offline import contact_rows, decimation_rows, refit_rows, spectral_rows
    from nbavatar.studies.tradeoff.tables import offline_markdown, rows_csv

    out = Path(args.out)
    sequence, _ = read_sequence(args.meshes)
    o = sheet.offline
    rows = list(progress(chain(contact_rows(sequence, o), refit_rows(o), spectral_rows(sequence, o)), "offline stages"))
    lacking = ""
    try:
        rows += progress(decimation_rows(sequence, o), "coarser meshes")
    except DependencyError as error:  # pymeshlab wants libraries of the system; the other stages do not depend on it
        lacking = str(error)
        print(f"nbavatar tradeoff: warning: no coarser meshes are measured: {lacking}", file=sys.stderr)
    _write(out / "offline.csv", rows_csv(rows))
    _write(out / "offline.md", offline_markdown(rows))
    for suffix in ("png", "pdf"):
        with atomic_write(out / f"offline.{suffix}") as path:
            save_figure(offline_figure(rows), path)
    record = run_record("tradeoff", config=to_mapping(o), inputs={"meshes": args.meshes}, device=timed_device("cpu"))
    write_json(
        out / "offline.json", {"kind": "offline", "format": 1, "rows": rows, "lacking": lacking, "record": record}
    )
    print(f"{out}/offline.md: {len(rows)} rows")
    return 0


def _sweep(
    args: argparse.Namespace, sheet: TradeoffConfig, protocol: ProtocolConfig, device: str, packs: list[FramePack],
    trains: list[FramePack],
) -> int:  # fmt: skip
    from nbavatar.data.sequences import read_sequence
    from nbavatar.evaluation.render import check_parts
    from nbavatar.metrics.lpips import load_lpips
    from nbavatar.studies.tradeoff.session import Session
    from nbavatar.studies.tradeoff.sweep import PointLog

    out = Path(args.out)
    models = _models(args.model, device)
    sequence, _ = read_sequence(args.meshes)
    for model in models:
        check_parts(model.avatar, sequence)
    net = load_lpips(sheet.net).to(device)
    shots, size = _shots(args, sheet, protocol, sequence, models[0].avatar.parts, packs, net, device)
    label = timed_device(device)
    inputs = {f"model.{i}": path for i, path in enumerate(args.model)} | {"meshes": args.meshes}
    inputs |= {f"frames.{i}": path for i, path in enumerate(args.frames)}
    inputs |= {f"train_frames.{i}": path for i, path in enumerate(args.train_frames)}
    identity = {
        "data": {name: file_digest(path) for name, path in inputs.items() if not name.startswith("model")},
        "device": label,
        "background": protocol.background,
        "refined": protocol.refined,
        "net": sheet.net,
        "size": size,
        "values": 2,  # counted up when a point holds other figures
        "code": code_digest("render"),  # what draws; an edit of figures or words measures nothing anew
    }
    chooser = _Chooser(trains or packs, sequence, sheet.importance_views, device)
    if args.savings:
        rows = _savings(sheet, models[0], sequence, shots, chooser, net, device)
        record = run_record("tradeoff", config=to_mapping(sheet), inputs=inputs, device=label)
        _write_savings(out, rows, record)
        return 0
    began = time.monotonic()
    counts = {True: 0, False: 0}

    def told(point: Any, fresh: bool) -> None:
        counts[fresh] += 1
        if fresh:
            print(f"{point.model}: {point.label}: {point.speedup:.2f}x, {point.values['psnr']:.2f} dB", flush=True)

    session = Session(
        sheet, models, shots, chooser, net, PointLog(out / "points.jsonl"), identity, device=device, on_point=told
    )
    limit = None if args.max_minutes is None else 60.0 * args.max_minutes
    result = session.run(None if limit is None else lambda: time.monotonic() - began > limit)
    importance = chooser.largest(models[0]) if any(p.setting.billboards < 1 for p in result.points) else None
    truth = shots[0].truth.shape[-1], shots[0].truth.shape[-2]
    record = run_record(
        "tradeoff", config={"sheet": to_mapping(sheet), "protocol": to_mapping(protocol)}, inputs=inputs, device=label
    )
    _write_results(args, sheet, result, importance, models[0].digest, label, size, truth, len(shots), record)
    state = "complete" if result.complete else "stopped early, the same command goes on"
    print(f"{out}: {counts[True]} points measured, {counts[False]} remembered; {state}")
    return 0


def _savings(
    sheet: TradeoffConfig, model: Any, sequence: Any, shots: list[Any], chooser: "_Chooser", net: Any, device: str
) -> list[dict[str, Any]]:
    """The savings of pictures, and that of the contact stage where the meshes have head and hands."""
    from nbavatar.studies.tradeoff.contact import contact_only_rows, contact_scene
    from nbavatar.studies.tradeoff.savings import even_rows, measure_savings

    rows: list[dict[str, Any]] = []
    footprints = chooser.footprints(model)
    for row in measure_savings(model.avatar, shots, chooser(model), footprints, net, sheet, device=device):
        rows.append(row)
        print(f"{row['saving']} ({row['scene']}): {row['faster']:.2f}x", flush=True)
    scene = contact_scene(sequence, sheet.offline.contact_frames)
    return even_rows([*rows, *([] if scene is None else contact_only_rows(scene, sheet.repeats))])


def _write_savings(out: Path, rows: list[dict[str, Any]], record: dict[str, Any]) -> None:
    from nbavatar.studies.tradeoff.savings import savings_markdown
    from nbavatar.studies.tradeoff.tables import rows_csv

    _write(out / "savings.csv", rows_csv(rows))
    _write(out / "savings.md", savings_markdown(rows))
    write_json(out / "savings.json", {"kind": "savings", "format": 1, "rows": rows, "record": record})
    print(f"{out}/savings.md: {len(rows)} switches, on and off")


def _write_results(
    args: argparse.Namespace, sheet: TradeoffConfig, result: Any, importance: list[float] | None, digest: str,
    device: str, size: tuple[int, int], truth: tuple[int, int], images: int, record: dict[str, Any],
) -> None:  # fmt: skip
    from nbavatar.io.atomic import atomic_write
    from nbavatar.reporting.figures import save_figure
    from nbavatar.studies.tradeoff.figures import COSTS, front_figure
    from nbavatar.studies.tradeoff.front import steadied
    from nbavatar.studies.tradeoff.presets import preset_entry, presets_path, store_presets
    from nbavatar.studies.tradeoff.tables import point_rows, points_markdown, rows_csv
    from nbavatar.studies.tradeoff.words import knob_paragraphs

    out = Path(args.out)
    steady = dict(zip(map(id, result.points), points := steadied(result.points), strict=True))
    presets = {name: steady[id(point)] for name, point in result.presets.items()}
    exact, own = points[0], [point for point in points if point.model == points[0].model]
    caption = f"{device}; {size[0]}x{size[1]} px, {images} held-out images"
    if size != truth:
        caption += f" of {truth[0]}x{truth[1]} px"
    if not result.complete:
        caption += "; sweep stopped early"
    rows = point_rows(points, presets, device)
    _write(out / "points.csv", rows_csv(rows))
    _write(out / "points.md", f"{caption}\n\n{points_markdown(points, presets)}")
    paragraphs = knob_paragraphs(own, sheet)
    entries = {"accurate": preset_entry("accurate", exact, exact, None)}
    entries |= {name: preset_entry(name, point, exact, sheet.presets[name]) for name, point in presets.items()}
    text = [f"- **{name}**: {entry['label']}; {entry['why']}" for name, entry in entries.items()]
    _write(out / "knobs.md", "\n".join([*text, "", *(f"{value}\n" for value in paragraphs.values())]))
    for cost, name in zip(COSTS, ("ms", "memory", "bytes"), strict=True):
        figure = front_figure(points, presets, cost, caption)
        for suffix in ("png", "pdf"):
            with atomic_write(out / f"front_{name}.{suffix}") as path:
                save_figure(figure, path)
    places = [out / "presets.json"] + ([] if args.no_store else [presets_path(args.model[0])])
    for place in places:
        store_presets(place, model=digest, device=device, size=size, presets=entries, points=own, importance=importance)
    summary = {
        "kind": "tradeoff", "format": 1, "device": device, "size": list(size), "frames": list(truth),
        "images": images, "complete": result.complete, "presets": entries, "paragraphs": paragraphs, "points": rows,
        "record": record,
    }  # fmt: skip
    write_json(out / "tradeoff.json", summary)
    for name, entry in entries.items():
        print(f"{name}: {entry['label']} ({entry['why']})")


def _models(paths: list[str], device: str) -> list[Any]:
    """The avatars, named after the folders they lie in."""
    from nbavatar.methods.storage import load_avatar
    from nbavatar.studies.tradeoff.session import Candidate

    names = [Path(path).resolve().parent.name for path in paths]
    if len(set(names)) < len(names):
        names = [f"{name} ({number})" for number, name in enumerate(names, start=1)]
    return [
        Candidate(name, load_avatar(path, device), file_digest(path)) for name, path in zip(names, paths, strict=True)
    ]


def _shots(
    args: argparse.Namespace, sheet: TradeoffConfig, protocol: ProtocolConfig, sequence: Any, parts: list[str],
    packs: list[FramePack], net: Any, device: str,
) -> tuple[list[Any], tuple[int, int]]:  # fmt: skip
    """The held-out pictures that show someone, evenly spaced over cameras and time, and their size [px]."""
    from nbavatar.data.views import views_of
    from nbavatar.evaluation.protocols import select_frames
    from nbavatar.evaluation.truth import showing_someone
    from nbavatar.studies.tradeoff.measure import prepare_shots

    splits = [select_frames(pack.frames, pack.manifest.get("split", {}), protocol.split) for pack in packs]
    views = views_of(packs, sequence.frames, splits, layers=("rgb", "alpha"))
    views = showing_someone(views, lambda view: packs[view.pack].read("alpha", view.frame))
    chosen = [views[i] for i in _evenly(len(views), sheet.images)]
    size = chosen[0].width, chosen[0].height
    for view in chosen:
        if (view.width, view.height) != size:
            expected, found = f"{size[0]}x{size[1]} as the first camera", f"{view.width}x{view.height}"
            raise DataError.of(packs[view.pack].path, "size", expected=expected, found=found)
    truths = [
        (packs[v.pack].read("rgb", v.frame), packs[v.pack].read("alpha", v.frame), packs[v.pack].unseen(v.frame))
        for v in chosen
    ]
    times = max(1, math.ceil(args.side / max(size)))
    shots = prepare_shots(
        sequence, parts, chosen, truths, protocol.background, net, refined=protocol.refined, enlarge=times,
        device=device,
    )  # fmt: skip
    return shots, (times * size[0], times * size[1])


class _Chooser:
    """Some training views, and what a model's billboards are in them; computed once, when it is asked for."""

    def __init__(self, packs: list[FramePack], sequence: Any, count: int, device: str) -> None:
        self._packs, self._sequence, self._count, self._device = packs, sequence, count, device
        self._known: dict[str, Any] = {}

    def __call__(self, model: Any) -> Any:
        if model.digest not in self._known:
            self._known[model.digest] = self._compute(model)
        return self._known[model.digest]

    def largest(self, model: Any) -> list[float]:
        """The largest contribution of every billboard [px]."""
        return self(model).amax(0).tolist()

    def footprints(self, model: Any) -> Any:
        """The largest footprint of every billboard [px]."""
        import torch

        from nbavatar.methods.billboards.compression.footprint import largest_footprints

        meshes = {part: torch.from_numpy(self._sequence.parts[part].verts) for part in model.avatar.parts}
        return largest_footprints(model.avatar, meshes, self._views(), most_views=_SIZING_VIEWS)

    def _views(self) -> list[Any]:
        from nbavatar.data.views import views_of
        from nbavatar.evaluation.protocols import select_frames

        splits = [
            select_frames(pack.frames, pack.manifest.get("split", {}), "novel_view", _CHOOSERS) for pack in self._packs
        ]
        return views_of(self._packs, self._sequence.frames, splits)

    def _compute(self, model: Any) -> Any:
        import numpy as np
        import torch

        from nbavatar.studies.tradeoff.session import view_contributions

        views, shots = self._views(), []
        for index in _evenly(len(views), self._count):
            verts = {
                part: torch.from_numpy(np.asarray(self._sequence.parts[part].verts[views[index].row], np.float32))
                for part in model.avatar.parts
            }
            shots.append(({part: value.to(self._device) for part, value in verts.items()}, views[index]))
        return view_contributions(model.avatar, shots, self._device)


def _evenly(total: int, count: int) -> list[int]:
    """At most `count` indices, evenly spaced over all, without the ends where there is choice."""
    count = min(count, total)
    return [int((2 * i + 1) * total / (2 * count)) for i in range(count)]


def _write(path: Path, text: str) -> None:
    from nbavatar.io.atomic import atomic_write

    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
