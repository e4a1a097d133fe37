"""Raw data -> frame packs and mesh sequences.

REQUIRED INPUTS: the dataset at `data_root` (made by `synthesize` where the configuration says `synthetic: true`).
OUTPUTS: results/{run}/ingest/{subject}/{camera}.zip, results/{run}/tracks/{subject}.npz
"""

if RUN.synthetic:

    # One job writes the whole dataset; every raw file is one of its outputs.
    rule synthesize:
        output:
            [
                str(path)
                for s in SUBJECTS
                for path in dict.fromkeys(
                    [
                        *raw_tracks(SimpleNamespace(subject=s)),
                        *(
                            path
                            for c in SUBJECTS[s].cameras
                            for path in raw_files(SimpleNamespace(subject=s, camera=c))
                        ),
                    ]
                )
            ],
        log:
            f"logs/{RUN.run}/synthesize.log",
        params:
            cfg=options("synthesize"),
            code=code_digest("synthesize"),
            root=data_root,
        shell:
            "nbavatar synthesize --out {params.root:q} --cfg {params.cfg:q} > {log:q} 2>&1"


rule ingest:
    input:
        raw_files,
    output:
        "results/{run}/ingest/{subject}/{camera}.zip",
    log:
        "logs/{run}/ingest/{subject}/{camera}.log",
    resources:
        mem="4GB",
        runtime="4h",
    params:
        root=root,
        layout=RUN.layout,
        cfg=options("ingest"),
        code=code_digest("ingest"),
    shell:
        "nbavatar ingest --layout {params.layout:q} --root {params.root:q} --subject {wildcards.subject:q}"
        " --camera {wildcards.camera:q} --out {output:q} --cfg {params.cfg:q} > {log:q} 2>&1"


rule tracks:
    input:
        raw_tracks,
    output:
        "results/{run}/tracks/{subject}.npz",
    log:
        "logs/{run}/tracks/{subject}.log",
    resources:
        mem="8GB",
        runtime="1h",
    params:
        root=root,
        layout=RUN.layout,
        cameras=cameras,
        cfg=options("tracks"),
        code=code_digest("tracks"),
    shell:
        "nbavatar tracks --layout {params.layout:q} --root {params.root:q} --subject {wildcards.subject:q}"
        " --cameras {params.cameras:q} --out {output:q} --cfg {params.cfg:q} > {log:q} 2>&1"
