"""Raw data -> frame packs and mesh sequences.

REQUIRED INPUTS: the dataset at `data_root` (made by `synthesize` where the configuration says `synthetic: true`).
OUTPUTS: results/{run}/check/{subject}/{record.json,overview.png} of captures,
         results/{run}/ingest/{subject}/{camera}.zip, results/{run}/tracks/{subject}.npz
"""

if RUN.synthetic:

    # One job writes the whole dataset; every raw file is one of its outputs.
    rule synthesize:
        output:
            layouts.dataset(PLAN),
        log:
            f"logs/{RUN.run}/synthesize.log",
        benchmark:
            f"benchmarks/{RUN.run}/synthesize.jsonl"
        params:
            cfg=options("synthesize"),
            code=code_digest("synthesize"),
            root=lambda w: RUN.data_root,
        shell:
            "nbavatar synthesize --out {params.root:q} --cfg {params.cfg:q} > {log:q} 2>&1"


# A capture is looked at as a whole before time is spent on it: what is made of it waits for the record, but is not made
# again because a capture has been checked again. What `check` depends on is therefore no input or parameter of it
# (Snakemake would then not look for other changes behind it), but of `check_sheet`, which asks for a picture that only
# a new check makes. That the record stays when a check fails leaves what follows as it is, too.
if PLAN.captured:

    rule check:
        output:
            record=update("results/{run}/check/{subject}/record.json"),
            picture=temp("results/{run}/check/{subject}/checked.png"),
        log:
            "logs/{run}/check/{subject}.log",
        priority: 20
        resources:
            mem="8GB",
            runtime="4h",
            root=lambda w: PLAN.subjects[w.subject].root,
            supplied=f"--supplied={RUN.stages.masks.supplied}",
            center=f"--pixel-center={RUN.frames.pixel_center}",
            cfg=options("check"),
        shell:
            "nbavatar check {resources.root:q} --subject {wildcards.subject:q} {resources.supplied:q}"
            " {resources.center:q} --overview {output.picture:q} --record {output.record:q}"
            " --cfg {resources.cfg:q} > {log:q} 2>&1"

    rule check_sheet:
        input:
            rules.check.output.picture,
        output:
            report(
                "results/{run}/check/{subject}/overview.png",
                category="Inputs",
                labels={"stage": "check", "subject": "{subject}"},
                caption="../report/check.rst",
            ),
        log:
            "logs/{run}/check_sheet/{subject}.log",
        resources:
            mem="1GB",
            runtime="10m",
        params:
            root=lambda w: PLAN.subjects[w.subject].root,
            supplied=RUN.stages.masks.supplied,
            center=RUN.frames.pixel_center,
            files=lambda w: layouts.capture_digests(PLAN, w.subject),
            cfg=options("check"),
            code=code_digest("check"),
        shell:
            "cp {input:q} {output:q} > {log:q} 2>&1"


rule ingest:
    input:
        lambda w: layouts.camera_files(PLAN, w.subject, w.camera),
        checked,
    output:
        "results/{run}/ingest/{subject}/{camera}.zip",
    log:
        "logs/{run}/ingest/{subject}/{camera}.log",
    benchmark:
        "benchmarks/{run}/ingest/{subject}/{camera}.jsonl"
    resources:
        mem="4GB",
        runtime="4h",
    params:
        root=lambda w: PLAN.subjects[w.subject].root,
        layout=RUN.layout,
        files=lambda w: layouts.image_digest(PLAN, w.subject, w.camera),
        given=lambda w: layouts.data_digest(
            PLAN, layouts.camera_files(PLAN, w.subject, w.camera)
        ),
        only="--images-only" if PLAN.captured else "",
        cfg=options("ingest"),
        code=code_digest("ingest"),
    shell:
        "nbavatar ingest --layout {params.layout:q} --root {params.root:q} --subject {wildcards.subject:q}"
        " --camera {wildcards.camera:q} {params.only:q} --out {output:q} --cfg {params.cfg:q} > {log:q} 2>&1"


rule tracks:
    input:
        lambda w: layouts.track_files(PLAN, w.subject),
        checked,
    output:
        "results/{run}/tracks/{subject}.npz",
    log:
        "logs/{run}/tracks/{subject}.log",
    benchmark:
        "benchmarks/{run}/tracks/{subject}.jsonl"
    resources:
        mem="8GB",
        runtime="1h",
    params:
        root=lambda w: PLAN.subjects[w.subject].root,
        layout=RUN.layout,
        cameras=lambda w: PLAN.subjects[w.subject].cameras,
        files=lambda w: layouts.meshes_digest(PLAN, w.subject),
        given=lambda w: layouts.data_digest(PLAN, layouts.track_files(PLAN, w.subject)),
        cfg=options("tracks"),
        code=code_digest("tracks"),
    shell:
        "nbavatar tracks --layout {params.layout:q} --root {params.root:q} --subject {wildcards.subject:q}"
        " --cameras {params.cameras:q} --out {output:q} --cfg {params.cfg:q} > {log:q} 2>&1"
