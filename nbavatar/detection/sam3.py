"""Head and hands by words: SAM 3 (Carion et al. 2025), as the package `transformers` has it, from local weights.

The model finds what a prompt names and follows it through the video. It sees one frame after another, and what it keeps
of earlier frames is bounded here: its memory reaches back a fixed number of frames, and all older ones are let go.
`transformers` wants torchvision for its own preprocessing, which is done here instead. Nothing is loaded over the
network, and no code from the model's folder is run: its weights have to be safetensors.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from nbavatar.errors import DependencyError, require
from nbavatar.io.framepack import UNSEEN

__all__ = ["GET", "LABELS", "Sam3"]

GET = "hf download facebook/sam3 --local-dir DIR, after its licence has been accepted there"
LABELS = {"head": 1, "right_hand": 2, "left_hand": 3, "covered": UNSEEN}
_TOKENS = 32
_KEPT = 40  # frames; the tracker looks back on 7 masks and 16 pointers


class Sam3:
    """The model, its tokens and what it is asked for.

    Args:
        folder: config.json, model.safetensors and the tokenizer's files.
        prompts: part, or `covered` for what hides them (label 255) -> words; what has no words is not looked for.
        device: where it runs.

    Raises:
        DependencyError: `transformers` is not installed or has no such model, or the folder is not a model's.
    """

    def __init__(self, folder: Path, prompts: Mapping[str, str], device: str = "cpu") -> None:
        transformers = require("transformers", "transformers", "segmentation by SAM 3")
        if not (folder / "config.json").is_file():
            raise DependencyError.of(folder, expected="a folder with SAM 3's weights", found="no config.json", fix=GET)
        try:
            self._model = transformers.Sam3VideoModel.from_pretrained(
                folder, local_files_only=True, use_safetensors=True
            )
            tokenizer = transformers.AutoTokenizer.from_pretrained(folder, local_files_only=True)
        except (AttributeError, ImportError) as error:
            version = getattr(transformers, "__version__", "?")
            raise DependencyError.of(
                f"transformers {version}", expected="a version with Sam3VideoModel (5 or newer)", found=str(error)[:120]
            ) from error
        except (OSError, ValueError, KeyError, RuntimeError, TypeError) as error:
            reason = " ".join(str(error).split())[:160]
            raise DependencyError.of(
                folder, expected="SAM 3's weights", found=f"other files ({reason})", fix=GET
            ) from error
        self._model = self._model.to(device).float().eval()
        self._side, self._device = int(self._model.config.image_size), device
        self._parts = [part for part in LABELS if prompts.get(part)]
        self._words = [prompts[part] for part in self._parts]
        self._tokens = tokenizer(
            self._words, padding="max_length", max_length=_TOKENS, truncation=True, return_tensors="pt"
        ).to(device)

    def run(self, images: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
        """Labels uint8 `[H, W]` of each picture uint8 `[H, W, 3]` RGB of one uncut run."""
        session = self._session()
        weights: dict[int, float] = {}
        with torch.inference_mode():
            for image in images:
                found = self._model(inference_session=session, frame=self._shown(image))
                number = max(session.processed_frames)
                yield self._labels(found, session, weights, image.shape[:2])
                _forget(session, number - _KEPT)

    def _session(self) -> Any:
        module = require("transformers.models.sam3_video.modeling_sam3_video", "transformers", "SAM 3")
        session = module.Sam3VideoInferenceSession(
            inference_device=self._device, inference_state_device=self._device, video_storage_device=self._device,
            dtype=torch.float32,
        )  # fmt: skip
        for row, words in enumerate(self._words):
            prompt = session.add_prompt(words)
            session.prompt_input_ids[prompt] = self._tokens["input_ids"][row : row + 1]
            session.prompt_attention_masks[prompt] = self._tokens["attention_mask"][row : row + 1]
        return session

    def _shown(self, image: np.ndarray) -> torch.Tensor:
        """The picture as the model wants it: float32 `[3, S, S]`, -1 for black to 1 for white."""
        planes = torch.from_numpy(np.ascontiguousarray(image)).to(self._device).permute(2, 0, 1)[None].float() / 255
        size = (self._side, self._side)
        return F.interpolate(planes, size, mode="bilinear", antialias=True, align_corners=False)[0].clamp(0, 1) * 2 - 1

    def _labels(self, found: Any, session: Any, weights: dict[int, float], shape: tuple[int, int]) -> np.ndarray:
        """One object a part, the one that has weighed most so far; where two overlap, the surer one."""
        for key, mask in found.obj_id_to_mask.items():
            share = float((mask > 0).float().mean())
            weights[key] = weights.get(key, 0.0) + float(found.obj_id_to_score.get(key, 0.0)) * share
        hidden = set(found.suppressed_obj_ids or ()) | set(found.removed_obj_ids or ())
        best = torch.zeros((), device=self._device)
        label = torch.zeros(shape, dtype=torch.uint8, device=self._device)
        for prompt, words in session.prompts.items():
            keys = [
                key for key, mask in found.obj_id_to_mask.items()
                if session.obj_id_to_prompt_id.get(key) == prompt and key not in hidden and bool((mask > 0).any())
            ]  # fmt: skip
            if not keys:
                continue
            mask = found.obj_id_to_mask[max(keys, key=lambda key: weights[key])].float()
            logits = F.interpolate(mask[None], shape, mode="bilinear", align_corners=False)[0, 0]
            part = self._parts[self._words.index(words)]
            label = torch.where(logits > best, LABELS[part], label)
            best = torch.maximum(best, logits)
        return label.to(torch.uint8).cpu().numpy()


def _forget(session: Any, before: int) -> None:
    """Lets go of frames, and of what was tracked in them, that the model never looks back on."""
    if before < 0:
        return
    session.processed_frames[before] = None  # the number of entries is the number of frames
    for outputs in session.output_dict_per_obj.values():
        kept = outputs["non_cond_frame_outputs"]
        for number in [number for number in kept if number <= before]:
            del kept[number]
