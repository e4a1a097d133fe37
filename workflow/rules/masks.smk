"""Frame packs + meshes -> head and hand masks, then crops with their intrinsics.

REQUIRED INPUTS: results/{run}/ingest/{subject}/{camera}.zip, results/{run}/tracks/{subject}.npz
OUTPUTS: results/{run}/masks/{subject}/{camera}.zip, results/{run}/crop/{crop}/{subject}/{camera}.zip
"""


rule masks:
    input:
        checked,
        frames="results/{run}/ingest/{subject}/{camera}.zip",
        meshes="results/{run}/tracks/{subject}.npz",
    output:
        "results/{run}/masks/{subject}/{camera}.zip",
    log:
        "logs/{run}/masks/{subject}/{camera}.log",
    resources:
        mem="8GB",
        runtime="4h",
    params:
        files=files_of_masks,
        capture=lambda w: ["--capture", root(w)] if RUN.layout == "capture" else [],
        cfg=options("masks"),
        code=code_digest("masks"),
    shell:
        "nbavatar masks --frames {input.frames:q} --meshes {input.meshes:q} {params.capture:q} --out {output:q}"
        " --cfg {params.cfg:q} > {log:q} 2>&1"


rule crop:
    input:
        frames="results/{run}/ingest/{subject}/{camera}.zip",
        masks="results/{run}/masks/{subject}/{camera}.zip",
        meshes="results/{run}/tracks/{subject}.npz",
    output:
        "results/{run}/crop/{crop}/{subject}/{camera}.zip",
    log:
        "logs/{run}/crop/{crop}/{subject}/{camera}.log",
    resources:
        mem="4GB",
        runtime="2h",
    params:
        cfg=crop_options,
        code=code_digest("crop"),
    shell:
        "nbavatar crop --frames {input.frames:q} --masks {input.masks:q} --meshes {input.meshes:q} --out {output:q}"
        " --cfg {params.cfg:q} > {log:q} 2>&1"
