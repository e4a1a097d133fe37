"""Training: one job a subject and variant.

REQUIRED INPUTS: results/{run}/crop/{crop}/{subject}/*.zip, meshes, results/{run}/spectral/{subject}.npz; where there
is one, results/{run}/light/{subject}.npz; where the variant starts from another avatar, its model.pt
OUTPUTS: results/{run}/train/{subject}/{variant}/model.pt, history.jsonl
"""


# The state to resume from lives in `model.pt.state/`, which is not an output on purpose: outputs of a job that failed
# or was killed are deleted, and a day of training must survive that.
# `--light` and `--start` have nothing after them where there is nothing to say.
rule train:
    input:
        frames=train_frames,
        meshes=meshes_of,
        spectral=rules.spectral.output.meshes,
        light=light_of,
        start=start_of,
    output:
        model="results/{run}/train/{subject}/{variant}/model.pt",
        history="results/{run}/train/{subject}/{variant}/history.jsonl",
    log:
        "logs/{run}/train/{subject}/{variant}.log",
    benchmark:
        "benchmarks/{run}/train/{subject}/{variant}.jsonl"
    retries: 2
    threads: 4
    resources:
        gpu=1,
        mem="32GB",
        runtime="24h",
    params:
        device=RUN.device,
        cfg=options("train"),
        given=lambda w: parameters.start_digest(PLAN, w.subject, w.variant),
        code=code_of("train"),
    shell:
        "nbavatar train --frames {input.frames:q} --meshes {input.meshes:q} --spectral {input.spectral:q}"
        " --light {input.light:q} --start {input.start:q}"
        " --out {output.model:q} --history {output.history:q} --device {params.device:q} --cfg {params.cfg:q} > {log:q} 2>&1"
