"""Options of the networks that look at pictures: the keypoint detector, the segmenter."""

import dataclasses

from nbavatar.config.core import option

__all__ = ["DetectConfig", "SegmentConfig"]


@dataclasses.dataclass(frozen=True)
class DetectConfig:
    """Keypoints of faces and hands in images."""

    parts: list[str] = option(["head", "right_hand", "left_hand"], "What to look for.",
                              choices=("head", "right_hand", "left_hand"))  # fmt: skip
    face_score: float = option(0.5, "Certainty below which a face is missing [1].", min=0.0, max=1.0)
    hand_score: float = option(0.5, "Certainty below which a hand is missing [1].", min=0.0, max=1.0)
    search_score: float = option(
        0.3, "Certainty from which a box of the first, coarse search is looked at [1].", min=0.01, max=1.0
    )
    rounds: int = option(
        2, "How often points are placed, each time in the square that the last ones give.", min=1, max=8
    )
    follow: bool = option(
        True, "Look first where the frame before had its face and hands; all is searched where that fails."
    )
    masks: bool = option(
        True, "Use the pack's masks: search around the person and the hands, and take the side of a hand from labels."
    )
    hidden: float = option(
        0.0, "Factor on the confidence of face points that the head itself hides [1].", min=0.0, max=1.0
    )
    least_share: float = option(
        0.05, "A part that two cameras see in fewer than this share of frames is left out [1].", min=0.0, max=1.0
    )
    sheet_frames: int = option(4, "Frames on the sheet.", min=1, max=64)
    sheet_tile: int = option(320, "Height of a picture on the sheet [px].", min=64, max=2048)


@dataclasses.dataclass(frozen=True)
class SegmentConfig:
    """Masks from pictures alone."""

    prompts: dict[str, str] = option(
        {"head": "head", "right_hand": "right hand"},
        "sam3: what the model is asked for, by part (head, right_hand, left_hand), and as `covered` what hides parts, "
        "such as clothes (label 255). It follows one object a prompt.",
    )
    refine: bool = option(
        True, "person: look a second time, at the person only, and fit the matte's edge to the picture's."
    )
    sheet_frames: int = option(6, "Frames on the picture of each camera.", min=1, max=64)
    sheet_tile: int = option(320, "Side of a tile of it [px].", min=64, max=2048)
