"""Speed against accuracy of an avatar, and every kernel at its limits.

REQUIRED INPUTS: results/{run}/train/{subject}/{variant}/model.pt, crops, meshes, the sheet of knobs
OUTPUTS: results/{run}/tradeoff/{subject}/{variant}/..., results/{run}/extremes/...
"""


# Timing again: all cores. The log of points is no output, so that a sweep that was stopped goes on; the presets are
# put beside the model by hand, because a job does not change another's output.
rule tradeoff:
    input:
        model="results/{run}/train/{subject}/{variant}/model.pt",
        meshes=meshes_of,
        frames=lambda w: frames_under(RUN.tradeoff.protocol, w.subject),
        train=train_frames,
        sheet=RUN.tradeoff.sheet,
    output:
        result="results/{run}/tradeoff/{subject}/{variant}/tradeoff.json",
        points="results/{run}/tradeoff/{subject}/{variant}/points.csv",
        presets="results/{run}/tradeoff/{subject}/{variant}/presets.json",
        plots=report(
            expand(
                "results/{{run}}/tradeoff/{{subject}}/{{variant}}/front_{cost}.png",
                cost=("ms", "memory", "bytes"),
            ),
            category="Speed against accuracy",
            caption="../report/tradeoff.rst",
        ),
    log:
        "logs/{run}/tradeoff/{subject}/{variant}.log",
    threads: workflow.resource_settings.cores or 4
    resources:
        gpu=1,
        mem="16GB",
        runtime="8h",
    params:
        device=RUN.device,
        folder=lambda w, output: Path(output.result).parent,
        protocol=lambda w: protocol_text(RUN.tradeoff.protocol),
        code=code_digest("tradeoff"),
    shell:
        "nbavatar tradeoff --model {input.model} --meshes {input.meshes} --frames {input.frames}"
        " --train-frames {input.train} --protocol {params.protocol:q} --sheet {input.sheet} --out {params.folder}"
        " --no-store --device {params.device} > {log} 2>&1"


rule extremes:
    output:
        table=report(
            "results/{run}/extremes/table.md",
            category="Extremes",
            caption="../report/extremes.rst",
        ),
        rows="results/{run}/extremes/table.csv",
        heatmap=report(
            "results/{run}/extremes/heatmap.png",
            category="Extremes",
            caption="../report/extremes.rst",
        ),
        curves="results/{run}/extremes/curves.png",
        record="results/{run}/extremes/record.json",
    log:
        "logs/{run}/extremes.log",
    resources:
        mem="8GB",
        runtime="1h",
    params:
        folder=lambda w, output: Path(output.table).parent,
        quick="--quick" if RUN.extremes == "quick" else "",
        code=code_digest("extremes"),
    shell:
        "nbavatar extremes --out {params.folder} {params.quick} --strict > {log} 2>&1"
