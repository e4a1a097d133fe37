"""How far PSNR, SSIM and LPIPS of one avatar move when only the protocol changes.

    --render    frame pack of `nbavatar render`: layers rgb (on the protocol's background) and alpha
    --frames    frame packs of `nbavatar crop`, the truth of every rendered camera: layers rgb and alpha
    --protocol  the protocol of the render: JSON text, file or name (its background is what the render stands on)
    --out       STEM.json (record), STEM.csv (one line a setting), STEM.png and STEM.pdf (plot)

Crop and padding, sequence or frame box, background, resize filter and mask change one at a time; stored images are
judged anew, nothing is rendered. Images that show nobody are left out, as in evaluation. Half sizes need 62 px or more
(LPIPS by AlexNet: 31 px a side).
"""

import argparse
import csv
import io
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from nbavatar.cli.common import progress
from nbavatar.cli.evaluate import read_protocol
from nbavatar.config.core import to_mapping
from nbavatar.devices import lease_device
from nbavatar.errors import DataError
from nbavatar.io.atomic import atomic_write
from nbavatar.io.framepack import FramePack
from nbavatar.io.records import write_json
from nbavatar.preprocess.crop import blank_unseen
from nbavatar.provenance import run_record

if TYPE_CHECKING:
    import numpy as np

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar protocol-sensitivity`."""
    parser.add_argument("--render", required=True, metavar="ZIP", help="rendered images")
    parser.add_argument("--frames", required=True, nargs="+", metavar="ZIP", help="ground-truth crops")
    parser.add_argument("--protocol", required=True, metavar="JSON|FILE|NAME", help="protocol of the render")
    parser.add_argument("--max-frames", type=int, default=8, metavar="N", help="frames judged, evenly spaced")
    parser.add_argument("--nets", nargs="*", default=["alex", "vgg"], choices=("alex", "vgg"), help="LPIPS backbones")
    parser.add_argument("--out", required=True, metavar="STEM", help="where to write, without suffix")


def main(args: argparse.Namespace) -> int:
    """Writes record, table and plot."""
    protocol = read_protocol(args.protocol, Path(args.render).stem)
    inputs = {"render": args.render} | {f"frames.{i}": path for i, path in enumerate(args.frames)}
    with ExitStack() as stack:
        stack.enter_context(lease_device("cpu"))
        from nbavatar.evaluation.sensitivity import Images, foreground_box, sweep
        from nbavatar.evaluation.truth import showing_someone
        from nbavatar.metrics.lpips import load_lpips
        from nbavatar.reporting.figures import save_figure, sensitivity_figure
        from nbavatar.reporting.pictures import spread

        render = stack.enter_context(FramePack(args.render))
        truths = {}
        for path in args.frames:
            pack = stack.enter_context(FramePack(path))
            truths[str(pack.manifest["camera"])] = pack
        boxes = {}
        for camera in sorted({name.partition("/")[0] for name in render.frames}):
            if camera not in truths:
                raise DataError.of(args.render, f"camera {camera}", expected="its crop in --frames", found="none")
            found = [foreground_box(truths[camera].read("alpha", frame)) for frame in truths[camera].frames]
            known = [box for box in found if box is not None]
            if known:
                x0, y0, x1, y1 = zip(*known, strict=True)
                boxes[camera] = (min(x0), min(y0), max(x1), max(y1))

        def images(name: str) -> Images:
            camera, _, frame = name.partition("/")
            pack = truths[camera]
            opacity, unseen = render.read("alpha", name) if "alpha" in render.layers else None, pack.unseen(frame)
            if opacity is not None and unseen is not None:
                opacity[unseen] = 0
            rgb = blank_unseen(render.read("rgb", name), unseen, protocol.background)
            return Images(camera, rgb, opacity, pack.read("rgb", frame), pack.read("alpha", frame), unseen)

        def truth(name: str) -> "np.ndarray":
            camera, _, frame = name.partition("/")
            return truths[camera].read("alpha", frame)

        names = spread(showing_someone(render.frames, truth), args.max_frames)
        nets = {net: load_lpips(net) for net in args.nets}
        rows = sweep((images(n) for n in progress(names, "sensitivity")), protocol.background, nets, boxes)
    config = {"protocol": to_mapping(protocol), "nets": args.nets, "max_frames": args.max_frames}
    record = run_record("protocol-sensitivity", config=config, inputs=inputs)
    write_json(f"{args.out}.json", {"kind": "sensitivity", "frames": names, "rows": rows, "record": record})
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with atomic_write(f"{args.out}.csv") as path:
        path.write_text(stream.getvalue(), encoding="utf-8")
    figure = sensitivity_figure(rows)
    for suffix in ("png", "pdf"):
        with atomic_write(f"{args.out}.{suffix}") as path:
            save_figure(figure, path)
    for row in rows:
        shown = ", ".join(f"{name} {row[name]:.4g} ({row['d_' + name]:+.3g})" for name in rows[0] if f"d_{name}" in row)
        print(f"{row['factor']:<11} {row['setting']:<28} {shown}")
    return 0
