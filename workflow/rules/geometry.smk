"""Refit or alignment, what the meshes lack, the studio's light, spectral coordinates, contact deformation.

REQUIRED INPUTS: results/{run}/tracks/{subject}.npz, results/{run}/ingest/{subject}/*.zip
OUTPUTS: results/{run}/fit/{subject}.{npz,png} or results/{run}/align/{subject}.npz,
         results/{run}/shell/{subject}.{npz,png}, results/{run}/light/{subject}.{npz,png},
         results/{run}/spectral/{subject}.npz, results/{run}/deform/{subject}.{npz,exr.zip}
"""

# A capture brings final meshes: there is nothing to refit.
if not PLAN.captured:

    rule fit:
        input:
            tracks=rules.tracks.output[0],
            frames=lambda w: files(
                rules.ingest.output, units.training_views(PLAN, w.subject)
            ),
            assets=layouts.assets(PLAN).body_models,
        output:
            meshes="results/{run}/fit/{subject}.npz",
            sheet=report(
                "results/{run}/fit/{subject}.png",
                category="Geometry",
                labels={"stage": "refit", "subject": "{subject}"},
                caption="../report/fit.rst",
            ),
        log:
            "logs/{run}/fit/{subject}.log",
        benchmark:
            "benchmarks/{run}/fit/{subject}.jsonl"
        # Trainings wait for this chain; crops are many and can be made beside it.
        priority: 10
        threads: 4
        resources:
            mem="16GB",
            runtime="8h",
        params:
            assets=layouts.assets(PLAN).folder,
            given=layouts.data_digest(PLAN, layouts.assets(PLAN).body_models),
            cfg=options("fit"),
            code=code_digest("fit"),
        shell:
            "nbavatar fit --tracks {input.tracks:q} --assets {params.assets:q} --frames {input.frames:q}"
            " --out {output.meshes:q} --sheet {output.sheet:q} --cfg {params.cfg:q} > {log:q} 2>&1"


if PLAN.aligned:

    rule align:
        input:
            meshes=rules.tracks.output[0],
            frames=lambda w: files(
                rules.ingest.output, units.training_views(PLAN, w.subject)
            ),
            masks=lambda w: (
                files(rules.masks.output, units.training_views(PLAN, w.subject))
                if RUN.stages.align.modes
                else []
            ),
        output:
            "results/{run}/align/{subject}.npz",
        log:
            "logs/{run}/align/{subject}.log",
        benchmark:
            "benchmarks/{run}/align/{subject}.jsonl"
        priority: 10
        resources:
            mem="8GB",
            runtime="4h",
        params:
            cfg=options("align"),
            code=code_digest("align"),
        shell:
            "nbavatar align --meshes {input.meshes:q} --frames {input.frames:q} --masks {input.masks:q}"
            " --out {output:q} --cfg {params.cfg:q} > {log:q} 2>&1"


if PLAN.shelled:

    rule shell:
        input:
            meshes=lambda w: mesh_file(units.fitted(PLAN, w.subject)),
            masks=lambda w: files(
                rules.masks.output, units.training_views(PLAN, w.subject)
            ),
        output:
            meshes="results/{run}/shell/{subject}.npz",
            picture=report(
                "results/{run}/shell/{subject}.png",
                category="Geometry",
                labels={"stage": "shell", "subject": "{subject}"},
                caption="../report/shell.rst",
            ),
        log:
            "logs/{run}/shell/{subject}.log",
        benchmark:
            "benchmarks/{run}/shell/{subject}.jsonl"
        priority: 10
        resources:
            mem="4GB",
            runtime="1h",
        params:
            cfg=options("shell"),
            code=code_digest("shell"),
        shell:
            "nbavatar shell --meshes {input.meshes:q} --masks {input.masks:q} --out {output.meshes:q}"
            " --picture {output.picture:q} --cfg {params.cfg:q} > {log:q} 2>&1"


if PLAN.lit:

    rule light:
        input:
            meshes=lambda w: mesh_file(units.whole(PLAN, w.subject)),
            frames=lambda w: files(
                rules.ingest.output, units.training_views(PLAN, w.subject)
            ),
            masks=lambda w: files(
                rules.masks.output, units.training_views(PLAN, w.subject)
            ),
        output:
            lights="results/{run}/light/{subject}.npz",
            picture=report(
                "results/{run}/light/{subject}.png",
                category="Geometry",
                labels={"stage": "light", "subject": "{subject}"},
                caption="../report/light.rst",
            ),
        log:
            "logs/{run}/light/{subject}.log",
        benchmark:
            "benchmarks/{run}/light/{subject}.jsonl"
        priority: 10
        resources:
            mem="4GB",
            runtime="1h",
        params:
            cfg=options("light"),
            code=code_digest("light"),
        shell:
            "nbavatar light --meshes {input.meshes:q} --frames {input.frames:q} --masks {input.masks:q}"
            " --out {output.lights:q} --picture {output.picture:q} --cfg {params.cfg:q} > {log:q} 2>&1"


rule spectral:
    input:
        lambda w: mesh_file(units.whole(PLAN, w.subject)),
    output:
        meshes="results/{run}/spectral/{subject}.npz",
        picture=report(
            "results/{run}/spectral/{subject}.png",
            category="Geometry",
            labels={"stage": "spectral coordinates", "subject": "{subject}"},
            caption="../report/spectral.rst",
        ),
    log:
        "logs/{run}/spectral/{subject}.log",
    benchmark:
        "benchmarks/{run}/spectral/{subject}.jsonl"
    priority: 10
    resources:
        mem="4GB",
        runtime="30m",
    params:
        cfg=options("spectral"),
        code=code_digest("spectral"),
    shell:
        "nbavatar spectral --meshes {input:q} --out {output.meshes:q} --picture {output.picture:q}"
        " --cfg {params.cfg:q} > {log:q} 2>&1"


rule deform:
    input:
        lambda w: mesh_file(units.whole(PLAN, w.subject)),
    output:
        meshes="results/{run}/deform/{subject}.npz",
        maps="results/{run}/deform/{subject}.exr.zip",
        table="results/{run}/deform/{subject}.csv",
        picture=report(
            "results/{run}/deform/{subject}.png",
            category="Geometry",
            labels={"stage": "contact", "subject": "{subject}"},
            caption="../report/deform.rst",
        ),
    log:
        "logs/{run}/deform/{subject}.log",
    benchmark:
        "benchmarks/{run}/deform/{subject}.jsonl"
    priority: 10
    threads: 4
    resources:
        mem="8GB",
        runtime="4h",
    params:
        cfg=options("deform"),
        code=code_digest("deform"),
    shell:
        "nbavatar deform --meshes {input:q} --out {output.meshes:q} --exr {output.maps:q} --validate {output.picture:q}"
        " --table {output.table:q}"
        " --cfg {params.cfg:q} > {log:q} 2>&1"
