"""The Decaf dataset on disk: which files there are, and where. Standard library only, because the workflow plans by it.

The release keeps each subject in ONE of two folders, `train` or `test`; both are searched. Body models and index files
are the user's own, below `assets`:

    ROOT/{train,test}/videos/S/CAM.mp4, segmentations/S/CAM.mp4      images, mattes of the person
                     {head,right_hand}_{keys,bbs}/S/CAM.npy          landmarks, detection boxes
                     cameras/S/cameras.pkl, cutIDs/S.pkl             calibration, cuts of the videos
                     params/S/params_smoothed.pkl                    parameters of the body models, all frames
                     deformations/S/deforms.npy                      dents of the head
                     contacts/S/contacts_{head,rh}.npy               vertices in contact
    ROOT/assets/generic_model.pkl, landmark_embedding.npy            FLAME
                mano_v1_2/models/MANO_{RIGHT,LEFT}.pkl               MANO
                FLAME_neck_idx.npy, neck_idx.npy                     vertices whose dents, whose contacts do not count
                accurate_shapes/S.pkl                                the subject's own shape
                transformation/{train,test}/S_RT_FromCanToRef_wo_poseparams.npy   head poses
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from nbavatar.errors import DataError, did_you_mean
from nbavatar.names import check_name

__all__ = [
    "CAMERAS",
    "FOLDERS",
    "PARTS",
    "Assets",
    "DecafSubject",
    "expected_subject",
    "find_subject",
    "list_subjects",
    "release_subject",
]

FOLDERS = ("train", "test")
CAMERAS = ("084", "100", "102", "108", "110", "111", "121", "122")
PARTS = ("head", "right_hand")
_TEST_SUBJECTS = ("S1", "S3", "S6")
_CONTACTS = {"head": "contacts_head.npy", "right_hand": "contacts_rh.npy"}


@dataclasses.dataclass(frozen=True)
class Assets:
    """Body models and index files of one folder."""

    folder: Path

    @property
    def flame(self) -> Path:
        """The head model."""
        return self.folder / "generic_model.pkl"

    @property
    def landmarks(self) -> Path:
        """Where its landmarks lie on its faces."""
        return self.folder / "landmark_embedding.npy"

    def mano(self, side: str = "right") -> Path:
        """The hand model of a side, `right` or `left`."""
        return self.folder / "mano_v1_2" / "models" / f"MANO_{side.upper()}.pkl"

    @property
    def body_models(self) -> list[Path]:
        """What stages that pose the models read."""
        return [self.flame, self.landmarks, self.mano()]

    @property
    def neck_of_dents(self) -> Path:
        """Head vertices whose dents are not valid."""
        return self.folder / "FLAME_neck_idx.npy"

    @property
    def neck_of_contacts(self) -> Path:
        """Head vertices whose contacts are not valid."""
        return self.folder / "neck_idx.npy"


@dataclasses.dataclass(frozen=True)
class DecafSubject:
    """One subject of one dataset.

    Attributes:
        root: the folder that holds `assets`, `train` and `test`.
        folder: `train` or `test`, wherever the subject was found.
        name: such as `S2`.
    """

    root: Path
    folder: str
    name: str

    def _file(self, kind: str, name: str = "") -> Path:
        return self.root / self.folder / kind / self.name / name

    @property
    def assets(self) -> Assets:
        """The dataset's body models and index files."""
        return Assets(self.root / "assets")

    @property
    def videos(self) -> Path:
        """Folder of the videos."""
        return self._file("videos")

    @property
    def cameras(self) -> list[str]:
        """Cameras that have a video, sorted."""
        return sorted(path.stem for path in self.videos.glob("*.mp4"))

    def video(self, camera: str) -> Path:
        """Images of one camera."""
        return self._file("videos", f"{camera}.mp4")

    def matte(self, camera: str) -> Path:
        """Mattes of the person, a video like that of the images."""
        return self._file("segmentations", f"{camera}.mp4")

    def keypoints(self, part: str, camera: str) -> Path:
        """Landmarks of a part in one camera."""
        return self._file(f"{part}_keys", f"{camera}.npy")

    def boxes(self, part: str, camera: str) -> Path:
        """Detection boxes of a part in one camera."""
        return self._file(f"{part}_bbs", f"{camera}.npy")

    @property
    def calibration(self) -> Path:
        """Intrinsics and extrinsics of all cameras."""
        return self._file("cameras", "cameras.pkl")

    @property
    def cut_file(self) -> Path:
        """The subject's cut ids."""
        return self.root / self.folder / "cutIDs" / f"{self.name}.pkl"

    @property
    def parameters(self) -> Path:
        """Smoothed parameters of the body models, of all frames."""
        return self._file("params", "params_smoothed.pkl")

    @property
    def deformations(self) -> Path:
        """Dents of the head."""
        return self._file("deformations", "deforms.npy")

    def contacts(self, part: str) -> Path:
        """Which vertices of a part are in contact."""
        return self._file("contacts", _CONTACTS[part])

    @property
    def head_poses(self) -> Path:
        """Stored canonical-to-world head poses."""
        return self.assets.folder / "transformation" / self.folder / f"{self.name}_RT_FromCanToRef_wo_poseparams.npy"

    @property
    def own_shape(self) -> Path:
        """The subject's own shape parameters."""
        return self.assets.folder / "accurate_shapes" / f"{self.name}.pkl"

    def camera_files(self, camera: str) -> list[Path]:
        """Files that one camera's frames come from."""
        return [self.video(camera), self.matte(camera), self.calibration, self.cut_file]

    def detections(self, cameras: Sequence[str]) -> list[Path]:
        """Landmarks and boxes of all parts, in some cameras."""
        kinds = (self.keypoints, self.boxes)
        return [file(part, camera) for file in kinds for part in PARTS for camera in cameras]

    def track_files(self, cameras: Sequence[str]) -> list[Path]:
        """Files that the subject's parameters and meshes come from."""
        return [
            *(self.parameters, self.calibration, self.cut_file, self.deformations),
            *map(self.contacts, PARTS),
            *self.detections(cameras),
            *self.assets.body_models,
        ]


def list_subjects(root: Path) -> dict[str, str]:
    """Subjects that have a folder of videos or parameters: name -> `train` or `test`."""
    found: dict[str, str] = {}
    for folder in FOLDERS:
        for kind in ("videos", "params"):
            for path in sorted((root / folder / kind).glob("*")):
                if path.is_dir():
                    found.setdefault(path.name, folder)
    return found


def find_subject(root: str | Path, name: str) -> DecafSubject:
    """Looks for a subject in both folders.

    Raises:
        DataError: no such dataset, no such subject (those that exist are said), or the subject is in both folders.
    """
    root = Path(root)
    if not root.is_dir():
        raise DataError.of(root, expected="the folder of the Decaf dataset", found="no such folder")
    check_name(name, root, "subject", error=DataError)
    subjects = list_subjects(root)
    if not subjects:
        raise DataError.of(root, expected="train/videos/<subject> and test/videos/<subject>", found="neither")
    if name not in subjects:
        raise DataError(f"{root}: unknown subject '{name}'; {did_you_mean(name, subjects)}")
    if all((root / folder / "params" / name).is_dir() for folder in FOLDERS):
        raise DataError.of(root, name, expected="the subject in train or in test", found="it in both folders")
    return DecafSubject(root, subjects[name], name)


def release_subject(root: str | Path, name: str) -> DecafSubject:
    """A subject in the folder in which the release has it; where synthetic datasets put theirs."""
    return DecafSubject(Path(root), "test" if name in _TEST_SUBJECTS else "train", name)


def expected_subject(root: str | Path, name: str) -> DecafSubject:
    """The same for planning, where nothing need be there yet: in the folder of its parameters, else the release's."""
    places = [DecafSubject(Path(root), folder, name) for folder in FOLDERS]
    return next((place for place in places if place.parameters.parent.is_dir()), release_subject(root, name))
