"""Speed against accuracy of an avatar, and every kernel at its limits.

REQUIRED INPUTS: results/{run}/train/{subject}/{variant}/model.pt, crops, meshes, the sheet of knobs
OUTPUTS: results/{run}/tradeoff/{subject}/{variant}/..., results/{run}/tradeoff/{subject}/offline/offline..., results/{run}/extremes/...
"""


# Timing again: all cores. The log of points is no output, so that a sweep that was stopped goes on; the presets are
# put beside the model by hand, because a job does not change another's output.
rule tradeoff:
    input:
        model=rules.train.output.model,
        meshes=meshes_of,
        frames=lambda w: judged_frames(w.subject, RUN.tradeoff.protocol),
        train=train_frames,
        sheet=RUN.tradeoff.sheet,
    output:
        result="results/{run}/tradeoff/{subject}/{variant}/tradeoff.json",
        points="results/{run}/tradeoff/{subject}/{variant}/points.csv",
        presets="results/{run}/tradeoff/{subject}/{variant}/presets.json",
        plots=[
            report(
                f"results/{{run}}/tradeoff/{{subject}}/{{variant}}/front_{name}.png",
                category="Speed against accuracy",
                labels={
                    "subject": "{subject}",
                    "shown": f"{{variant}}: quality against {cost}",
                },
                caption="../report/tradeoff.rst",
            )
            for name, cost in (("ms", "time"), ("memory", "memory"), ("bytes", "size"))
        ],
    log:
        "logs/{run}/tradeoff/{subject}/{variant}.log",
    benchmark:
        "benchmarks/{run}/tradeoff/{subject}/{variant}.jsonl"
    threads: workflow.resource_settings.cores or 4
    resources:
        gpu=1,
        mem="16GB",
        runtime="8h",
    params:
        what="--no-store",
        given=given_digest([RUN.tradeoff.sheet]),
        device=RUN.device,
        folder=lambda w, output: Path(output.result).parent,
        protocol=lambda w: parameters.protocol_text(PLAN, RUN.tradeoff.protocol),
        side=RUN.tradeoff.side,
        code=code_of("tradeoff"),
    shell:
        "nbavatar tradeoff {params.what:q} --model {input.model:q} --meshes {input.meshes:q} --frames {input.frames:q}"
        " --train-frames {input.train:q} --protocol {params.protocol:q} --sheet {input.sheet:q} --side {params.side:q}"
        " --out {params.folder:q} --device {params.device:q} > {log:q} 2>&1"


# Every switch of "only what a scene requires", on and off.
use rule tradeoff as savings with:
    output:
        result="results/{run}/tradeoff/{subject}/{variant}/savings.json",
        rows="results/{run}/tradeoff/{subject}/{variant}/savings.csv",
        table="results/{run}/tradeoff/{subject}/{variant}/savings.md",
    log:
        "logs/{run}/tradeoff/{subject}/{variant}.savings.log",
    benchmark:
        "benchmarks/{run}/tradeoff/{subject}/{variant}.savings.jsonl"
    resources:
        gpu=1,
        mem="16GB",
        runtime="2h",
    params:
        what="--savings",


# The stages before training: what their knobs cost in time, and in millimetres.
rule offline:
    input:
        meshes=lambda w: mesh_file(units.fitted(PLAN, w.subject)),
        sheet=RUN.tradeoff.sheet,
    output:
        result="results/{run}/tradeoff/{subject}/offline/offline.json",
        rows="results/{run}/tradeoff/{subject}/offline/offline.csv",
        table="results/{run}/tradeoff/{subject}/offline/offline.md",
        plot=report(
            "results/{run}/tradeoff/{subject}/offline/offline.png",
            category="Speed against accuracy",
            labels={"subject": "{subject}", "shown": "stages before training"},
            caption="../report/tradeoff.rst",
        ),
    log:
        "logs/{run}/tradeoff/{subject}.offline.log",
    benchmark:
        "benchmarks/{run}/tradeoff/{subject}.offline.jsonl"
    threads: workflow.resource_settings.cores or 4
    resources:
        mem="16GB",
        runtime="4h",
    params:
        folder=lambda w, output: Path(output.result).parent,
        given=given_digest([RUN.tradeoff.sheet]),
        code=code_digest("tradeoff"),
    shell:
        "nbavatar tradeoff --offline --meshes {input.meshes:q} --sheet {input.sheet:q} --out {params.folder:q}"
        " > {log:q} 2>&1"


rule extremes:
    output:
        table="results/{run}/extremes/table.md",
        rows="results/{run}/extremes/table.csv",
        heatmap=report(
            "results/{run}/extremes/heatmap.png",
            category="Extremes",
            labels={"shown": "verdicts"},
            caption="../report/extremes.rst",
        ),
        curves=report(
            "results/{run}/extremes/curves.png",
            category="Extremes",
            labels={"shown": "errors by level"},
            caption="../report/extremes.rst",
        ),
        record="results/{run}/extremes/record.json",
    log:
        "logs/{run}/extremes.log",
    benchmark:
        "benchmarks/{run}/extremes.jsonl"
    resources:
        mem="8GB",
        runtime="1h",
    params:
        folder=lambda w, output: Path(output.table).parent,
        quick="--quick" if RUN.extremes == "quick" else "",
        code=code_digest("extremes"),
    shell:
        "nbavatar extremes --out {params.folder:q} {params.quick:q} --strict > {log:q} 2>&1"
