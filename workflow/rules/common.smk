"""Sheets, checks, and the functions that rules share. Nothing here computes, and nothing imports torch."""

import json
import re
import shlex
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

from snakemake.exceptions import WorkflowError

from nbavatar.config.compare import compared
from nbavatar.config.core import to_mapping
from nbavatar.config.figures import read_figures
from nbavatar.config.inputs import (
    files_digest,
    given_digest,
    mesh_digest,
    rig_digest,
    supplied_digest,
)
from nbavatar.config.run import load_run, stage_options
from nbavatar.config.sheets import (
    Row,
    capture_subjects,
    read_rows,
    read_subjects,
    refuse_namesakes,
)
from nbavatar.config.synthetic import refuse_others
from nbavatar.config.tables import read_tables
from nbavatar.errors import NBAvatarError, did_you_mean
from nbavatar.provenance import code_digest


def novel(protocol):
    """Whether a protocol judges the camera that is held out."""
    known = RUN.protocols.get(protocol)
    return known is not None and known.split == "novel_view"


try:
    RUN = load_run(config)
    if RUN.layout == "capture":
        SUBJECTS = capture_subjects(RUN.data_root, RUN.test_camera)
        refuse_namesakes(SUBJECTS, f"results/{RUN.run}/check")
    else:
        SUBJECTS = read_subjects(RUN.subjects, RUN.data_root)
    # Before snakemake knows that these files are outputs: those of a job are removed before it starts.
    if RUN.synthetic:
        refuse_others(RUN.data_root)
    COMPARED = compared(RUN.compare)
    # A comparison has rows of its own, the smallest budget of all subjects first.
    ROWS = [
        Row(subject, one.name, protocol)
        for one in COMPARED
        for subject in SUBJECTS
        for protocol in RUN.compare.protocols
    ] or read_rows(RUN.runs, list(SUBJECTS))
    for row in ROWS:
        for kind, name, known in (
            ("variant", row.variant, RUN.variants),
            ("protocol", row.protocol, RUN.protocols),
        ):
            if name not in known:
                raise NBAvatarError(
                    f"{RUN.runs}: unknown {kind} '{name}'; {did_you_mean(name, known)}"
                )
    TABLES = {} if COMPARED else read_tables(RUN.tables)
    FIGURES = read_figures(RUN.figures) if RUN.figures and not COMPARED else {}
    # Where one camera recorded a subject none is held out: there are no novel views of it to judge, or to show.
    ROWS = [
        row
        for row in ROWS
        if SUBJECTS[row.subject].test_camera or not novel(row.protocol)
    ]
    if not any(subject.test_camera for subject in SUBJECTS.values()):
        TABLES = {
            name: table
            for name, table in TABLES.items()
            if table.speeds or not all(map(novel, table.protocols))
        }
        FIGURES = {
            name: figure
            for name, figure in FIGURES.items()
            if not novel(figure.protocol)
        }
    for pair in RUN.reenact:
        for name in pair.split("/"):
            if name not in SUBJECTS:
                raise NBAvatarError(
                    f"reenact: unknown subject '{name}'; {did_you_mean(name, SUBJECTS)}"
                )
except NBAvatarError as error:
    raise WorkflowError(str(error)) from None

R = f"results/{RUN.run}"

# A capture brings meshes: nothing is refitted, but they may be aligned to its pictures.
ALIGNED = RUN.layout == "capture" and RUN.stages.align.iterations > 0

# What they lack is carved from the masks of the training cameras.
SHELLED = RUN.layout == "capture" and RUN.stages.shell.reach > 0


def one_of(names):
    """Regular expression that matches exactly these names."""
    return "|".join(map(re.escape, sorted(names)))


# `.venv/bin/snakemake` works without activating its environment, also where another one is active: its commands are
# then found beside it.
BESIDE = Path(sys.executable).parent
if shutil.which("snakemake") != str(BESIDE / "snakemake"):
    shell.prefix(f'export PATH={shlex.quote(str(BESIDE))}:"$PATH"; ')


wildcard_constraints:
    run=one_of([RUN.run]),
    subject=one_of(SUBJECTS),
    camera=one_of({c for s in SUBJECTS.values() for c in s.cameras}),
    crop=one_of(RUN.crops),
    variant=one_of(RUN.variants),
    protocol=one_of(RUN.protocols),
    table=one_of(TABLES),
    figure=one_of(FIGURES),
    source=one_of(SUBJECTS),
    target=one_of(SUBJECTS),
    kind="driven|turntable",


def options(stage):
    """The resolved options of a stage, as the JSON text that reaches its command and triggers re-runs."""

    def resolve(wildcards):
        variant = getattr(wildcards, "variant", None)
        return json.dumps(stage_options(RUN, stage, variant), sort_keys=True)

    return resolve


def code_of(verb):
    """Digest of the code behind a verb, of what the method of the variant in hand can reach."""

    def resolve(wildcards):
        return code_digest(verb, (method_of(wildcards.variant),))

    return resolve


def method_of(variant):
    """Name of the method that a variant trains."""
    return stage_options(RUN, "train", variant)["method"]


def crop_options(wildcards):
    from nbavatar.config.core import to_mapping

    return json.dumps(to_mapping(RUN.crops[wildcards.crop]), sort_keys=True)


def protocol_text(name):
    from nbavatar.config.core import to_mapping

    return json.dumps(to_mapping(RUN.protocols[name]) | {"name": name}, sort_keys=True)


def protocol_options(wildcards):
    return protocol_text(wildcards.protocol)


def data_root(wildcards):
    """Folder of the whole dataset."""
    return RUN.data_root


def root(wildcards):
    """Folder of one subject's data."""
    return SUBJECTS[wildcards.subject].root


def cameras(wildcards):
    """Cameras of one subject that the run uses."""
    return SUBJECTS[wildcards.subject].cameras


def split_folder(subject):
    """`train` or `test`: Decaf splits its release by subject."""
    base = Path(SUBJECTS[subject].root)
    found = [
        name
        for name in ("train", "test")
        if (base / name / "params" / subject).is_dir()
    ]
    return base / (
        found[0]
        if found
        else {"S1": "test", "S3": "test", "S6": "test"}.get(subject, "train")
    )


def raw_files(wildcards):
    """Files of the dataset that one camera's frames come from."""
    subject, camera = wildcards.subject, wildcards.camera
    if RUN.layout == "capture":
        base = Path(SUBJECTS[subject].root)
        return [base / "cameras.json", base / "splits.json"]
    base = split_folder(subject)
    return [
        base / "videos" / subject / f"{camera}.mp4",
        base / "segmentations" / subject / f"{camera}.mp4",
        base / "cameras" / subject / "cameras.pkl",
        base / "cutIDs" / f"{subject}.pkl",
    ]


def checked(wildcards):
    """What has to be there, however old, before anything is made of a capture."""
    if RUN.layout != "capture":
        return []
    return [ancient(f"{R}/check/{wildcards.subject}/record.json")]


def looked_at(subjects):
    """Pictures of captures that have been checked as they are now."""
    if RUN.layout != "capture":
        return []
    return [f"{R}/check/{subject}/overview.png" for subject in subjects]


def given(files):
    """Digest of input files that the user gave, for `params`: of these an older one is another one, too."""

    def digest(wildcards):
        found = files(wildcards) if callable(files) else files
        return given_digest([str(path) for path in found])

    return digest


def given_data(files):
    """The same for files of the dataset, which are the run's own where it is synthetic."""
    return "" if RUN.synthetic else given(files)


# The folders of a capture hold too many files to be inputs one by one, and the times of folders do not tell of files
# that were changed in place. Their digests are parameters.
def files_of_images(wildcards):
    """Digest of the images of one camera of a capture."""
    if RUN.layout != "capture":
        return ""
    return files_digest(root(wildcards), wildcards.camera, ["images"])


def files_of_masks(wildcards):
    """Digest of one camera's masks, of a capture or supplied by the user."""
    supplied = RUN.stages.masks.supplied
    if supplied:
        return supplied_digest(supplied, wildcards.subject, wildcards.camera)
    if RUN.layout != "capture":
        return ""
    return files_digest(root(wildcards), wildcards.camera, ["masks", "alpha"])


def files_of_meshes(wildcards):
    """Digest of the meshes of a capture."""
    return mesh_digest(root(wildcards)) if RUN.layout == "capture" else ""


def files_of_capture(wildcards):
    """Digests of all files of a capture that `check` reads."""
    folder, supplied = root(wildcards), RUN.stages.masks.supplied
    found = [
        rig_digest(folder),
        mesh_digest(folder),
    ]
    for camera in cameras(wildcards):
        found.append(files_digest(folder, camera, ["images", "masks", "alpha"]))
        found.append(supplied_digest(supplied, wildcards.subject, camera))
    return found


def raw_tracks(wildcards):
    """Files of the dataset that a subject's parameters and meshes come from."""
    subject = wildcards.subject
    if RUN.layout == "capture":
        base = Path(SUBJECTS[subject].root)
        return [base / "cameras.json", base / "splits.json"]
    base = split_folder(subject)
    cameras = SUBJECTS[subject].cameras
    keyed = ("head_keys", "right_hand_keys", "head_bbs", "right_hand_bbs")
    return [
        base / "params" / subject / "params_smoothed.pkl",
        base / "cameras" / subject / "cameras.pkl",
        base / "cutIDs" / f"{subject}.pkl",
        base / "deformations" / subject / "deforms.npy",
        base / "contacts" / subject / "contacts_head.npy",
        base / "contacts" / subject / "contacts_rh.npy",
        *(
            base / name / subject / f"{camera}.npy"
            for name in keyed
            for camera in cameras
        ),
        *assets(),
    ]


def assets():
    """Body models, supplied by the user."""
    base = Path(RUN.data_root) / "assets"
    return [
        base / "generic_model.pkl",
        base / "landmark_embedding.npy",
        base / "mano_v1_2" / "models" / "MANO_RIGHT.pkl",
    ]


def crops_of(crop, subject, cameras):
    return [f"{R}/crop/{crop}/{subject}/{camera}.zip" for camera in cameras]


def train_frames(wildcards):
    """Crops of the training cameras."""
    crop, subject = RUN.variants[wildcards.variant].crop, wildcards.subject
    return crops_of(crop, subject, SUBJECTS[subject].train_cameras)


def meshes_of(wildcards):
    """The meshes that carry a variant."""
    return meshes_for(wildcards.subject, wildcards.variant)


def meshes_for(subject, variant):
    stage = RUN.variants[variant].meshes
    if stage == "deform" and RUN.layout == "capture":
        stage = "fit" if RUN.stages.tracks.contact == "given" else stage
    if stage == "fit" and SHELLED and RUN.variants[variant].shell:
        return f"{R}/shell/{subject}.npz"
    return fitted_of(subject) if stage == "fit" else f"{R}/{stage}/{subject}.npz"


def fitted(wildcards):
    """Meshes before contact: refitted ones, or those that a capture brings, aligned or not."""
    return fitted_of(wildcards.subject)


def whole(wildcards):
    """The same with all parts that a variant may have."""
    if SHELLED:
        return f"{R}/shell/{wildcards.subject}.npz"
    return fitted(wildcards)


def fitted_of(subject):
    stage = "fit" if RUN.layout == "decaf" else "align" if ALIGNED else "tracks"
    return f"{R}/{stage}/{subject}.npz"


def frames_under(protocol, subject):
    """Crops that a protocol looks at: the held-out camera for novel views, the training cameras for held-out poses."""
    cameras = SUBJECTS[subject]
    if novel(protocol) and not cameras.test_camera:
        raise WorkflowError(
            f"{subject}: one camera recorded it, and none is held out for protocol '{protocol}'; "
            "take a protocol of split self_reenactment"
        )
    protocol = RUN.protocols[protocol]
    cameras = (
        [cameras.test_camera]
        if protocol.split == "novel_view"
        else cameras.train_cameras
    )
    return crops_of(protocol.crop, subject, cameras)


def protocol_frames(wildcards):
    return frames_under(wildcards.protocol, wildcards.subject)


def protocol_train_frames(wildcards):
    """Training crops of the same kind: the mean training image is one of the trivial answers."""
    crop, subject = RUN.protocols[wildcards.protocol].crop, wildcards.subject
    return crops_of(crop, subject, SUBJECTS[subject].train_cameras)


def evals_of(rows):
    return [f"{R}/eval/{row.subject}/{row.variant}/{row.protocol}.json" for row in rows]


def renders_of(rows):
    return [
        f"{R}/render/{row.subject}/{row.variant}/{row.protocol}.zip" for row in rows
    ]


def avatars():
    """(subject, variant) of every avatar, in the order of the sheet."""
    return list(dict.fromkeys((row.subject, row.variant) for row in ROWS))


def rows_of(table):
    """The rows of the sheet that a table shows."""
    variants, protocols = TABLES[table].variants, TABLES[table].protocols
    return [
        row for row in ROWS if row.variant in variants and row.protocol in protocols
    ]


def speeds_of(table):
    """Timings that a table shows: of the first subject that has the variant."""
    first = {}
    for subject, variant in avatars():
        if variant in TABLES[table].speeds:
            first.setdefault(variant, subject)
    return [f"{R}/speed/{subject}/{variant}.json" for variant, subject in first.items()]


def report_pictures():
    """Pictures of the geometry stages, for the report."""
    stages = (
        ("fit", "spectral", "deform")
        if RUN.layout == "decaf"
        else ("spectral", "deform")
    )
    if RUN.layout == "capture" and RUN.stages.tracks.contact == "given":
        stages = ("spectral",)
    if SHELLED:
        stages = ("shell", *stages)
    subjects = list(dict.fromkeys(row.subject for row in ROWS))
    return [
        *(f"{R}/figures/{figure}.png" for figure in FIGURES),
        *looked_at(subjects),
        *(f"{R}/{stage}/{subject}.png" for stage in stages for subject in subjects),
    ]


def contact_tables():
    """Millimetres of the contact stage, where it is part of the run."""
    if RUN.layout == "capture" and RUN.stages.tracks.contact == "given":
        return []
    return [f"{R}/deform/{s}.csv" for s in dict.fromkeys(row.subject for row in ROWS)]


def figure_rows(name):
    """Rows of the sheet that a figure shows: its variants, or those whose avatars stand for all subjects."""
    layout = FIGURES[name]
    return [
        row
        for row in ROWS
        if layout.shows(row.subject)
        and row.protocol == layout.protocol
        and (row.variant in layout.variants or not layout.variants)
    ]


def figure_files(name, what):
    """What a figure needs of one kind."""
    layout, rows = FIGURES[name], figure_rows(name)
    subjects = list(dict.fromkeys(row.subject for row in rows))
    pairs = [pair.split("/") for pair in RUN.reenact]
    shown = [(s, t) for s, t in pairs if (s, layout.variant) in avatars()]
    needs = {
        "comparison": ("renders", "frames", "evals"),
        "features": ("models", "sequences", "frames"),
        "reenactment": ("models", "sequences", "frames"),
        "contact": ("sequences", "frames"),
        "curves": ("histories",),
        "pareto": ("evals", "speeds"),
    }[layout.kind]
    if what not in needs:
        return []
    if what == "renders":
        return renders_of(rows)
    if what == "evals":
        return evals_of(rows)
    if what == "speeds":
        return [f"{R}/speed/{s}/{v}.json" for s, v in timed_avatars(rows)]
    if what == "histories":
        return [f"{R}/train/{s}/{v}/history.jsonl" for s, v in avatars()]
    if layout.kind == "reenactment":
        sources = list(dict.fromkeys(source for source, _ in shown))
        if what == "models":
            return [f"{R}/train/{s}/{layout.variant}/model.pt" for s in sources]
        if what == "sequences":
            return [f"{R}/reenact/{s}/{t}.npz" for s, t in shown]
        subjects = list(dict.fromkeys(name for pair in shown for name in pair))
    if what == "models":
        return [f"{R}/train/{s}/{layout.variant}/model.pt" for s in subjects]
    if what == "sequences":
        return [meshes_for(s, layout.variant) for s in subjects]
    return sorted({f for s in subjects for f in frames_under(layout.protocol, s)})


def figure_code(wildcards):
    """Digest of the code behind a figure, of what the methods of its avatars can reach."""
    layout = FIGURES[wildcards.figure]
    shown = figure_files(wildcards.figure, "models")
    return code_digest("figure", (method_of(layout.variant),) if shown else ())


def timed_avatars(rows):
    """Of these rows, the avatars that some table times: timing takes the machine for itself, so no more than needed."""
    timed = {path for table in TABLES for path in speeds_of(table)}
    return [
        (row.subject, row.variant)
        for row in rows
        if f"{R}/speed/{row.subject}/{row.variant}.json" in timed
    ]


def videos():
    return [
        f"{R}/video/{subject}/{variant}/{kind}.mp4"
        for subject, variant in avatars()
        if variant in RUN.videos
        for kind in ("turntable", "driven")
    ]


def tradeoffs(variants, also):
    """Sweeps of some variants, each for the first subject that has it, and what is measured besides."""
    first = {}
    for subject, variant in avatars():
        if variant in variants:
            first.setdefault(variant, subject)
    kinds = ["tradeoff", *(["savings"] if "savings" in also else [])]
    files = [
        f"{R}/tradeoff/{s}/{v}/{kind}.json" for v, s in first.items() for kind in kinds
    ]
    offline = [
        f"{R}/tradeoff/{subject}/offline/offline.json"
        for subject in dict.fromkeys(first.values())
    ]
    return files + (offline if "offline" in also else [])


TRADEOFFS = tradeoffs(RUN.tradeoff.variants, RUN.tradeoff.also)


COMPARISON = [
    f"{R}/compare/compare.md",
    f"{R}/compare/compare.csv",
    *(
        f"{R}/compare/{subject}_{protocol}.png"
        for subject, protocol in dict.fromkeys(
            (row.subject, row.protocol) for row in ROWS
        )
    ),
]

EVERYTHING = (
    COMPARISON
    if COMPARED
    else [
        *videos(),
        *TRADEOFFS,
        *([f"{R}/extremes/table.md"] if RUN.extremes else []),
        *(f"{R}/figures/{figure}.png" for figure in FIGURES),
        *evals_of(ROWS),
        f"{R}/results.csv",
        *(
            f"{R}/tables/{table}.{suffix}"
            for table in TABLES
            for suffix in ("csv", "md", "tex")
        ),
        f"{R}/report/index.html",
    ]
)
