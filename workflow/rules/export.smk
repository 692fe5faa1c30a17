rule export:
    input:
        "results/{flight}/{pair}/image.manifest.json",
        "results/scene.json",
    output:
        multiext("results/{flight}/{pair}/", "slc.tif", "power.tif", "db.tif"),
        report(
            "results/{flight}/{pair}/quicklook.png",
            caption="../report/quicklook.rst",
            category="{flight}",
            labels={"image": "{pair}"},
        ),
    log:
        "results/logs/{flight}/{pair}.export.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.export.tsv"
    conda:
        "../../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        code=code_sha256("apertura.steps.export"),
    message:
        "{wildcards.flight}: writing the GeoTIFFs of {wildcards.pair}"
    shell:
        "apertura step export {wildcards.flight} {wildcards.pair} > {log} 2>&1"


rule export_fused:
    input:
        "results/cube.manifest.json",
        "results/scene.json",
        lambda wildcards: [
            campaign.manifest("image", wildcards.flight, pair) for pair in campaign.flight(wildcards.flight).pairs
        ],
    output:
        multiext("results/{flight}/fused/coherent_", "slc.tif", "power.tif", "db.tif"),
        multiext("results/{flight}/fused/noncoherent_", "power.tif", "db.tif"),
        report(
            "results/{flight}/fused/quicklook.png",
            caption="../report/quicklook.rst",
            category="{flight}",
            labels={"image": "fused"},
        ),
        "results/{flight}/fused/image.json",
    log:
        "results/logs/{flight}/fused.export.log",
    benchmark:
        "results/benchmarks/{flight}/fused.export.tsv"
    conda:
        "../../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        code=code_sha256("apertura.steps.export"),
    message:
        "{wildcards.flight}: writing what the pairs add up to"
    shell:
        "apertura step export {wildcards.flight} fused > {log} 2>&1"
