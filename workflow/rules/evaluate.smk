"""Renders, metrics, timing. Rendering and judging are apart: metrics are recomputed without a GPU, and disputed
without training again.

REQUIRED INPUTS: results/{run}/train/{subject}/{variant}/model.pt, crops, meshes
OUTPUTS: results/{run}/render/..., results/{run}/eval/..., results/{run}/speed/...
"""


rule render:
    input:
        model=rules.train.output.model,
        meshes=meshes_of,
        frames=lambda w: judged_frames(w.subject, w.protocol),
    output:
        "results/{run}/render/{subject}/{variant}/{protocol}.zip",
    log:
        "logs/{run}/render/{subject}/{variant}/{protocol}.log",
    benchmark:
        "benchmarks/{run}/render/{subject}/{variant}/{protocol}.jsonl"
    threads: 4
    resources:
        gpu=1,
        mem="16GB",
        runtime="4h",
    params:
        device=RUN.device,
        protocol=lambda w: parameters.protocol_text(PLAN, w.protocol),
        code=code_of("render"),
    shell:
        "nbavatar render --model {input.model:q} --meshes {input.meshes:q} --frames {input.frames:q}"
        " --protocol {params.protocol:q} --out {output:q} --device {params.device:q} > {log:q} 2>&1"


rule evaluate:
    input:
        render=rules.render.output[0],
        frames=lambda w: judged_frames(w.subject, w.protocol),
        train=lambda w: files(
            rules.crop.output, units.trivial_answers(PLAN, w.subject, w.protocol)
        ),
    output:
        record="results/{run}/eval/{subject}/{variant}/{protocol}.json",
        images="results/{run}/eval/{subject}/{variant}/{protocol}.csv",
    log:
        "logs/{run}/eval/{subject}/{variant}/{protocol}.log",
    benchmark:
        "benchmarks/{run}/eval/{subject}/{variant}/{protocol}.jsonl"
    threads: 2
    resources:
        mem="16GB",
        runtime="8h",
    params:
        protocol=lambda w: parameters.protocol_text(PLAN, w.protocol),
        cfg=options("evaluate"),
        code=code_digest("evaluate"),
    shell:
        "nbavatar evaluate --render {input.render:q} --frames {input.frames:q} --train-frames {input.train:q}"
        " --protocol {params.protocol:q} --out {output.record:q} --csv {output.images:q}"
        " --cfg {params.cfg:q} > {log:q} 2>&1"


# Timing wants the machine for itself: it takes every core, so no other job of this workflow runs beside it. (On a cluster,
# where no number of cores is given, it gets what other GPU jobs get.)
rule speed:
    input:
        model=rules.train.output.model,
        meshes=meshes_of,
        frames=train_frames,
    output:
        "results/{run}/speed/{subject}/{variant}.json",
    log:
        "logs/{run}/speed/{subject}/{variant}.log",
    benchmark:
        "benchmarks/{run}/speed/{subject}/{variant}.jsonl"
    threads: workflow.resource_settings.cores or 4
    resources:
        gpu=1,
        mem="16GB",
        runtime="30m",
    params:
        device=RUN.device,
        cfg=options("speed"),
        code=code_of("speed"),
    shell:
        "nbavatar speed --model {input.model:q} --meshes {input.meshes:q} --frames {input.frames[0]:q}"
        " --out {output:q} --device {params.device:q} --cfg {params.cfg:q} > {log:q} 2>&1"
