"""Frame packs + meshes -> head and hand masks, then crops with their intrinsics.

REQUIRED INPUTS: results/{run}/ingest/{subject}/{camera}.zip, results/{run}/tracks/{subject}.npz
OUTPUTS: results/{run}/masks/{subject}/{camera}.zip, results/{run}/crop/{crop}/{subject}/{camera}.zip
"""


rule masks:
    input:
        checked,
        frames=rules.ingest.output[0],
        meshes=rules.tracks.output[0],
    output:
        "results/{run}/masks/{subject}/{camera}.zip",
    log:
        "logs/{run}/masks/{subject}/{camera}.log",
    benchmark:
        "benchmarks/{run}/masks/{subject}/{camera}.jsonl"
    resources:
        mem="8GB",
        runtime="4h",
    params:
        files=lambda w: layouts.mask_digest(PLAN, w.subject, w.camera),
        capture=lambda w: (
            ["--capture", PLAN.subjects[w.subject].root] if PLAN.captured else []
        ),
        cfg=options("masks"),
        code=code_digest("masks"),
    shell:
        "nbavatar masks --frames {input.frames:q} --meshes {input.meshes:q} {params.capture:q} --out {output:q}"
        " --cfg {params.cfg:q} > {log:q} 2>&1"


rule crop:
    input:
        frames=rules.ingest.output[0],
        masks=rules.masks.output[0],
        meshes=rules.tracks.output[0],
    output:
        "results/{run}/crop/{crop}/{subject}/{camera}.zip",
    log:
        "logs/{run}/crop/{crop}/{subject}/{camera}.log",
    benchmark:
        "benchmarks/{run}/crop/{crop}/{subject}/{camera}.jsonl"
    resources:
        mem="4GB",
        runtime="2h",
    params:
        cfg=lambda w: parameters.crop_text(PLAN, w.crop),
        code=code_digest("crop"),
    shell:
        "nbavatar crop --frames {input.frames:q} --masks {input.masks:q} --meshes {input.meshes:q} --out {output:q}"
        " --cfg {params.cfg:q} > {log:q} 2>&1"
