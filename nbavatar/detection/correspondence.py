"""From the detectors' points to those of FLAME's 68 landmarks and MANO's 21 joints.

Faces. The order is iBUG's, which FLAME's landmark file keeps: 0 to 16 contour from the subject's right ear over the
chin to the left, 17 to 21 right and 22 to 26 left brow, 27 to 30 bridge of the nose, 31 to 35 nostrils, 36 to 41 right
and 42 to 47 left eye, 48 to 59 outer and 60 to 67 inner lips. Which vertices of MediaPipe's face mesh (468) lie there
is taken from P. Yan's published table (github.com/PeizhiYan/Mediapipe_2_Dlib_Landmarks), made symmetric where it was
not, with the inner lips a quarter of their width apart as in iBUG. Eyes, bridge, nostrils and lips are marked points of
both sets. Brows are lines, along which points may slide, and the contour is the border of the mesh, along which they
slide much farther: on synthetic images their error was five times that of the others. These count less.

Hands. Both have 21 joints: wrist, and four a finger from palm to tip; only the order differs.
"""

import numpy as np

__all__ = ["FACE_MIRROR", "FACE_POINTS", "FACE_TRUST", "HAND_POINTS", "face_landmarks", "hand_joints"]

FACE_POINTS: tuple[tuple[int, ...], ...] = (
    (127,), (234,), (93,), (132, 58), (58, 172), (136,), (150,), (176,), (152,),
    (400,), (379,), (365,), (288, 397), (361, 288), (323,), (454,), (356,),
    (70,), (63,), (105,), (66,), (107,), (336,), (296,), (334,), (293,), (300,),
    (168, 6), (197, 195), (5,), (4,), (98,), (97,), (2,), (326,), (327,),
    (33,), (160,), (158,), (133,), (153,), (144,), (362,), (385,), (387,), (263,), (373,), (380,),
    (61,), (40,), (37,), (0,), (267,), (270,), (291,), (321,), (314,), (17,), (84,), (91,),
    (78,), (81,), (13,), (311,), (308,), (402,), (14,), (178,),
)  # fmt: skip
"""For each of the 68 landmarks, the vertices of the face mesh whose mean it is."""

FACE_MIRROR = (
    *range(16, -1, -1), *range(26, 16, -1), *range(27, 31), *range(35, 30, -1), 45, 44, 43, 42, 47, 46, 39, 38, 37, 36,
    41, 40, 54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65,
)  # fmt: skip
"""For each of the 68 landmarks, the one on the other side of the face."""

_CONTOUR, _BROWS = 0.1, 0.6
FACE_TRUST = np.array([_CONTOUR] * 17 + [_BROWS] * 10 + [1.0] * 41)
"""How well the 68 correspondences hold, as a factor on their confidence (ours)."""

HAND_POINTS = (0, 5, 6, 7, 9, 10, 11, 17, 18, 19, 13, 14, 15, 1, 2, 3, 4, 8, 12, 16, 20)
"""MediaPipe's joint for each of `nbavatar.bodymodels.mano.JOINT_NAMES`."""


def face_landmarks(mesh: np.ndarray) -> np.ndarray:
    """The 68 landmarks `[68, C]` of a face mesh `[468, C]`."""
    return np.stack([mesh[list(ids)].mean(0) for ids in FACE_POINTS])


def hand_joints(points: np.ndarray) -> np.ndarray:
    """The 21 joints `[21, C]` in this project's order, from MediaPipe's."""
    return points[list(HAND_POINTS)]
