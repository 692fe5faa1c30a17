rule interferogram:
    input:
        lambda wildcards: result_of(campaign, "interferogram", wildcards.two).sources,
    output:
        [
            f"results/interferometry/{{two}}/{export.file}"
            for export in exports_in("interferogram")
            if not export.pictured
        ],
        [
            report(
                f"results/interferometry/{{two}}/{export.file}",
                caption="../report/interferogram.rst",
                category="interferometry",
                labels={"image": "{two}"},
            )
            for export in exports_in("interferogram")
            if export.pictured
        ],
        "results/interferometry/{two}/interferogram.json",
        "results/interferometry/{two}/interferogram.manifest.json",
    log:
        "results/logs/interferometry/{two}.interferogram.log",
    benchmark:
        "results/benchmarks/interferometry/{two}.interferogram.tsv"
    conda:
        "../../environment.yml"
    threads: asked["interferogram"].threads
    resources:
        mem_mb=asked["interferogram"].mem_mb,
        runtime=asked["interferogram"].runtime,
    params:
        settings=lambda _: campaign.relevant("interferogram"),
        code=lambda wildcards: result_of(campaign, "interferogram", wildcards.two).code_sha256,
    message:
        "{wildcards.two}: comparing two images in phase"
    shell:
        "apertura step interferogram {wildcards.two} > {log} 2>&1"
