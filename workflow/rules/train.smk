"""Training: one job a subject and variant.

REQUIRED INPUTS: results/{run}/crop/{crop}/{subject}/*.zip, meshes, results/{run}/spectral/{subject}.npz
OUTPUTS: results/{run}/train/{subject}/{variant}/model.pt, history.jsonl
"""


# The state to resume from lives in `model.pt.state/`, which is not an output on purpose: outputs of a job that failed
# or was killed are deleted, and a day of training must survive that.
rule train:
    input:
        frames=train_frames,
        meshes=meshes_of,
        spectral="results/{run}/spectral/{subject}.npz",
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
        code=code_digest("train"),
    shell:
        "nbavatar train --frames {input.frames} --meshes {input.meshes} --spectral {input.spectral}"
        " --out {output.model} --history {output.history} --device {params.device} --cfg {params.cfg:q} > {log} 2>&1"
