"""Names to ask for parts of the work: `snakemake subject_S2`, `snakemake table_ablation`, `snakemake stage_fit`."""


def stage_files(stage):
    """Every file of one stage that the whole run needs."""
    subjects = list(dict.fromkeys(row.subject for row in ROWS))
    cameras = [(s, c) for s in subjects for c in SUBJECTS[s].cameras]
    files = {
        "ingest": [f"{R}/ingest/{s}/{c}.zip" for s, c in cameras],
        "tracks": [f"{R}/tracks/{s}.npz" for s in subjects],
        "masks": [f"{R}/masks/{s}/{c}.zip" for s, c in cameras],
        "crop": [
            f"{R}/crop/{crop}/{s}/{c}.zip" for crop in RUN.crops for s, c in cameras
        ],
        "spectral": [f"{R}/spectral/{s}.npz" for s in subjects],
        "deform": [f"{R}/deform/{s}.npz" for s in subjects],
        "train": [f"{R}/train/{s}/{v}/model.pt" for s, v in avatars()],
        "render": renders_of(ROWS),
        "evaluate": evals_of(ROWS),
        "speed": sorted({path for table in TABLES for path in speeds_of(table)}),
        # The whole of it, also where the run itself sweeps nothing.
        "tradeoff": tradeoffs(
            RUN.tradeoff.variants or list(RUN.variants)[:1], ("savings", "offline")
        ),
    }
    if RUN.layout == "decaf":
        files["fit"] = [f"{R}/fit/{s}.npz" for s in subjects]
    if RUN.layout == "capture":
        files["check"] = looked_at(subjects)
    if ALIGNED:
        files["align"] = [f"{R}/align/{s}.npz" for s in subjects]
    if SHELLED:
        files["shell"] = [f"{R}/shell/{s}.npz" for s in subjects]
    return files[stage]


for _subject in SUBJECTS:

    rule:
        name:
            f"subject_{_subject}"
        input:
            evals_of([row for row in ROWS if row.subject == _subject]),
            looked_at([_subject]),


for _table in TABLES:

    rule:
        name:
            f"table_{_table}"
        input:
            [f"{R}/tables/{_table}.{suffix}" for suffix in ("csv", "md", "tex")],
            looked_at(SUBJECTS),


for _stage in (
    *(["check"] if RUN.layout == "capture" else []),
    "ingest",
    "tracks",
    "masks",
    "crop",
    *(["fit"] if RUN.layout == "decaf" else []),
    *(["align"] if ALIGNED else []),
    *(["shell"] if SHELLED else []),
    "spectral",
    "deform",
    "train",
    "render",
    "evaluate",
    "speed",
    "tradeoff",
):

    rule:
        name:
            f"stage_{_stage}"
        input:
            stage_files(_stage),
            looked_at(SUBJECTS),
