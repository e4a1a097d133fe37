"""Figures for print, cross-reenactment and videos.

REQUIRED INPUTS: results/{run}/{render,eval,speed,train,crop}/**, meshes, config/figures.yaml
OUTPUTS: results/{run}/figures/{figure}.{png,pdf,json}, results/{run}/reenact/{source}/{target}.npz,
         results/{run}/video/{subject}/{variant}/{kind}.mp4
"""


# Poses are exchanged between heads without contact; the contact stage then dents the head that is shown.
rule reenact:
    input:
        source=lambda w: mesh_file(units.fitted(PLAN, w.source)),
        target=lambda w: mesh_file(units.fitted(PLAN, w.target)),
    output:
        "results/{run}/reenact/{source}/{target}.before.npz",
    log:
        "logs/{run}/reenact/{source}/{target}.log",
    benchmark:
        "benchmarks/{run}/reenact/{source}/{target}.jsonl"
    resources:
        mem="8GB",
        runtime="1h",
    params:
        assets=([] if PLAN.captured else ["--assets", str(layouts.assets(PLAN).folder)]),
        given=(
            ""
            if PLAN.captured
            else layouts.data_digest(PLAN, layouts.assets(PLAN).body_models)
        ),
        code=code_digest("reenact"),
    shell:
        "nbavatar reenact --source {input.source:q} --target {input.target:q} {params.assets:q}"
        " --out {output:q} > {log:q} 2>&1"


rule reenact_contact:
    input:
        rules.reenact.output,
    output:
        "results/{run}/reenact/{source}/{target}.npz",
    log:
        "logs/{run}/reenact_contact/{source}/{target}.log",
    benchmark:
        "benchmarks/{run}/reenact_contact/{source}/{target}.jsonl"
    threads: 4
    resources:
        mem="8GB",
        runtime="4h",
    params:
        cfg=options("deform"),
        code=code_digest("deform"),
    shell:
        "nbavatar deform --meshes {input:q} --out {output:q} --cfg {params.cfg:q} > {log:q} 2>&1"


rule video:
    input:
        model=rules.train.output.model,
        meshes=meshes_of,
        camera=lambda w: train_frames(w)[0],
    output:
        video=report(
            "results/{run}/video/{subject}/{variant}/{kind}.mp4",
            category="Videos",
            labels={"subject": "{subject}", "variant": "{variant}", "video": "{kind}"},
            caption="../report/video.rst",
        ),
        record="results/{run}/video/{subject}/{variant}/{kind}.mp4.json",
    log:
        "logs/{run}/video/{subject}/{variant}/{kind}.log",
    benchmark:
        "benchmarks/{run}/video/{subject}/{variant}/{kind}.jsonl"
    threads: 4
    resources:
        gpu=1,
        mem="8GB",
        runtime="2h",
    params:
        device=RUN.device,
        cfg=options("video"),
        code=code_of("video"),
    shell:
        "nbavatar video --model {input.model:q} --meshes {input.meshes:q} --camera {input.camera:q} --kind {wildcards.kind:q}"
        " --out {output.video:q} --device {params.device:q} --cfg {params.cfg:q} > {log:q} 2>&1"


# A figure asks for the results that it shows, and for no others.
rule figure:
    input:
        layout=RUN.figures,
        renders=lambda w: files(rules.render.output, shown(PLAN, w.figure).renders),
        frames=lambda w: sorted(files(rules.crop.output, shown(PLAN, w.figure).frames)),
        evals=lambda w: files(
            rules.evaluate.output.record, shown(PLAN, w.figure).evaluations
        ),
        speeds=lambda w: files(rules.speed.output, shown(PLAN, w.figure).timings),
        histories=lambda w: files(
            rules.train.output.history, shown(PLAN, w.figure).histories
        ),
        models=lambda w: files(rules.train.output.model, shown(PLAN, w.figure).models),
        sequences=lambda w: [
            *map(mesh_file, shown(PLAN, w.figure).meshes),
            *files(rules.reenact_contact.output, shown(PLAN, w.figure).reenacted),
        ],
    output:
        png=report(
            "results/{run}/figures/{figure}.png",
            category="Figures",
            labels={"figure": "{figure}"},
            caption="../report/figure.rst",
        ),
        pdf="results/{run}/figures/{figure}.pdf",
        record="results/{run}/figures/{figure}.json",
    log:
        "logs/{run}/figures/{figure}.log",
    benchmark:
        "benchmarks/{run}/figures/{figure}.jsonl"
    resources:
        mem="8GB",
        runtime="30m",
    params:
        stem=lambda w, output: output.png[:-4],
        label=RUN.size_label,
        given=given_digest([RUN.figures] if RUN.figures else []),
        code=lambda w: parameters.figure_code(PLAN, w.figure),
    shell:
        "nbavatar figure --figure {wildcards.figure:q} --layout {input.layout:q} --renders {input.renders:q}"
        " --frames {input.frames:q} --evals {input.evals:q} --speeds {input.speeds:q} --histories {input.histories:q}"
        " --models {input.models:q} --sequences {input.sequences:q} --size-label={params.label:q}"
        " --out-stem {params.stem:q} > {log:q} 2>&1"
