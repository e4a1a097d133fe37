"""What a report opens with: one image that stands for a run, its truth and error, and the figures that matter."""

from collections.abc import Mapping, Sequence
from typing import Any

from nbavatar.io.framepack import FramePack
from nbavatar.reporting.comparison import Rendered, compare_frame, find_truth
from nbavatar.reporting.page import Card, Opening
from nbavatar.reporting.pictures import ERROR_MAX, data_uri, reduce_picture

__all__ = ["opening_of", "representative"]

# Metrics, of which the first that was measured is shown, with name, digits and direction.
_FIGURES = (
    ({"psnr": "PSNR [dB]"}, 2, "higher is better"),
    ({"ssim": "SSIM"}, 3, "higher is better"),
    ({"lpips_vgg": "LPIPS, VGG", "lpips_alex": "LPIPS, AlexNet"}, 3, "lower is better"),
)


def representative(render: Rendered) -> str:
    """The image ``<camera>/<frame>`` whose PSNR is the median of its protocol: neither the best nor the worst.

    Of an even number it is the lower of the middle two. Without figures it is the middle one of all.
    """
    names = list(render.pack.frames)
    rows = ((name, render.per_image.get(name, {}).get("psnr")) for name in names)
    judged = [(value, name) for name, value in rows if value is not None]
    return sorted(judged)[(len(judged) - 1) // 2][1] if judged else names[len(names) // 2]


def opening_of(
    renders: Sequence[Rendered],
    crops: Sequence[FramePack],
    evaluations: Mapping[tuple[str, str, str], Mapping[str, Any]],
    films: Mapping[tuple[str, str], str],
    *,
    max_side: int,
) -> Opening | None:
    """The opening of a report, or None if nothing was rendered.

    The first render (the run's sheet lists them) that has most of truth, figures and turntable stands for the run.

    Args:
        renders: every method's renders.
        crops: ground-truth crops.
        evaluations: (subject, variant, protocol) -> result of ``nbavatar evaluate``.
        films: (subject, variant) -> address of a turntable.
        max_side: pictures are reduced to this side [px].
    """
    renders = [render for render in renders if render.pack.frames]
    if not renders:
        return None

    def known(render: Rendered) -> int:
        truth = find_truth(render.pack, render.pack.frames[0], crops) is not None
        judged = (render.subject, render.variant, render.protocol) in evaluations
        return truth + judged + ((render.subject, render.variant) in films)

    lead = max(renders, key=known)
    name = representative(lead)
    pictures = {column.title: column.pictures for column in compare_frame(name, [lead], crops).columns}
    own = pictures[lead.variant]
    shown = [("Truth", pictures.get("Ground truth", {}).get("whole"), "what the camera saw")]
    shown += [("Render", own["whole"], lead.variant)]
    shown += [("Error", own.get("error"), f"0 black, {ERROR_MAX:g} pale")]
    camera, _, frame = name.partition("/")
    where = f"camera {camera}, frame {frame}"
    small = max(own["whole"].shape[:2]) <= 128
    cards = [
        Card(title, [(data_uri(reduce_picture(picture, max_side)), f"{title} ({where})")], caption, small)
        for title, picture, caption in shown
        if picture is not None
    ]
    judged = evaluations.get((lead.subject, lead.variant, lead.protocol), {})
    figures = _figures(judged.get("metrics", {}))
    told = f"{lead.variant} of {lead.subject}, protocol {lead.protocol}, {where}"
    if any(row.get("psnr") is not None for row in lead.per_image.values()):
        told += ": the image of median PSNR"
    if figures:
        told += f". The figures are means over {judged['count']} images"
    return Opening(f"{told}.", cards, figures, films.get((lead.subject, lead.variant), ""), small)


def _figures(metrics: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    found = []
    for names, digits, direction in _FIGURES:
        key = next((key for key in names if metrics.get(key) is not None), None)
        if key is not None:
            found.append((names[key], f"{metrics[key]:.{digits}f}", direction))
    return found
