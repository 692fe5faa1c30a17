# A row of `apertura.formats.export.EXPORTS` is all that a product needs: the outputs follow from it.
rule export:
    input:
        lambda wildcards: result_of(campaign, "export", wildcards.flight, wildcards.pair).sources,
    output:
        [f"results/{{flight}}/{{pair}}/{export.file}" for export in exports_in("pair") if not export.pictured],
        [
            report(
                f"results/{{flight}}/{{pair}}/{export.file}",
                caption="../report/quicklook.rst",
                category="{flight}",
                labels={"image": "{pair}", "shows": "image"},
            )
            for export in exports_in("pair")
            if export.pictured
        ],
        "results/{flight}/{pair}/image.json",
        "results/{flight}/{pair}/export.manifest.json",
    log:
        "results/logs/{flight}/{pair}.export.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.export.tsv"
    conda:
        "../../environment.yml"
    threads: asked["export"].threads
    resources:
        mem_mb=asked["export"].mem_mb,
        runtime=asked["export"].runtime,
    params:
        settings=lambda _: campaign.settings.campaign,
        code=lambda wildcards: result_of(campaign, "export", wildcards.flight, wildcards.pair).code_sha256,
    message:
        "{wildcards.flight}: writing the files of {wildcards.pair}"
    shell:
        "apertura step export {wildcards.flight} {wildcards.pair} > {log} 2>&1"


# As large as the echo: made where somebody asks for it, by its name or by rule phase_history.
rule cphd:
    input:
        lambda wildcards: result_of(campaign, "cphd", wildcards.flight, wildcards.pair).sources,
    output:
        f"results/{{flight}}/{{pair}}/{PHASE_HISTORY}",
        "results/{flight}/{pair}/cphd.manifest.json",
    log:
        "results/logs/{flight}/{pair}.cphd.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.cphd.tsv"
    conda:
        "../../environment.yml"
    threads: asked["cphd"].threads
    resources:
        mem_mb=asked["cphd"].mem_mb,
        runtime=asked["cphd"].runtime,
    params:
        settings=lambda _: campaign.settings.campaign,
        code=lambda wildcards: result_of(campaign, "cphd", wildcards.flight, wildcards.pair).code_sha256,
    message:
        "{wildcards.flight}: writing the phase history of {wildcards.pair}"
    shell:
        "apertura step cphd {wildcards.flight} {wildcards.pair} > {log} 2>&1"


rule export_fused:
    input:
        lambda wildcards: result_of(campaign, "fused", wildcards.flight).sources,
    output:
        [f"results/{{flight}}/fused/{export.file}" for export in exports_in("fused") if not export.pictured],
        [
            report(
                f"results/{{flight}}/fused/{export.file}",
                caption="../report/quicklook.rst",
                category="{flight}",
                labels={"image": "fused", "shows": "image"},
            )
            for export in exports_in("fused")
            if export.pictured
        ],
        "results/{flight}/fused/image.json",
        "results/{flight}/fused/export.manifest.json",
    log:
        "results/logs/{flight}/fused.export.log",
    benchmark:
        "results/benchmarks/{flight}/fused.export.tsv"
    conda:
        "../../environment.yml"
    threads: asked["export_fused"].threads
    resources:
        mem_mb=asked["export_fused"].mem_mb,
        runtime=asked["export_fused"].runtime,
    params:
        settings=lambda _: campaign.settings.campaign,
        code=lambda wildcards: result_of(campaign, "fused", wildcards.flight).code_sha256,
    message:
        "{wildcards.flight}: writing what the pairs add up to"
    shell:
        "apertura step export {wildcards.flight} fused > {log} 2>&1"


rule coverage:
    input:
        lambda wildcards: result_of(campaign, "coverage").sources,
    output:
        report("results/coverage.png", caption="../report/coverage.rst", category="campaign"),
        "results/coverage.geojson",
        "results/coverage.manifest.json",
    log:
        "results/logs/coverage.log",
    benchmark:
        "results/benchmarks/coverage.tsv"
    conda:
        "../../environment.yml"
    threads: asked["coverage"].threads
    resources:
        mem_mb=asked["coverage"].mem_mb,
        runtime=asked["coverage"].runtime,
    params:
        settings=lambda _: campaign.settings.campaign,
        code=lambda _: result_of(campaign, "coverage").code_sha256,
    message:
        "drawing what the flights cover"
    shell:
        "apertura step coverage > {log} 2>&1"


rule mosaic:
    input:
        lambda wildcards: result_of(campaign, "mosaic").sources,
    output:
        [f"results/{file}" for file in mosaic_files({one.name: one.pairs for one in campaign.image_flights})],
        "results/mosaic/mosaic.manifest.json",
    log:
        "results/logs/mosaic.log",
    benchmark:
        "results/benchmarks/mosaic.tsv"
    conda:
        "../../environment.yml"
    threads: asked["mosaic"].threads
    resources:
        mem_mb=asked["mosaic"].mem_mb,
        runtime=asked["mosaic"].runtime,
    params:
        settings=lambda _: campaign.settings.campaign,
        code=lambda _: result_of(campaign, "mosaic").code_sha256,
    message:
        "laying the files of all flights upon one another"
    shell:
        "apertura step mosaic > {log} 2>&1"


rule map:
    input:
        lambda wildcards: result_of(campaign, "map").sources,
    output:
        f"results/{MAP}",
        "results/map/map.manifest.json",
    log:
        "results/logs/map.log",
    benchmark:
        "results/benchmarks/map.tsv"
    conda:
        "../../environment.yml"
    threads: asked["map"].threads
    resources:
        mem_mb=asked["map"].mem_mb,
        runtime=asked["map"].runtime,
    params:
        settings=lambda _: result_of(campaign, "map").settings,
        code=lambda _: result_of(campaign, "map").code_sha256,
    message:
        "making the map"
    shell:
        "apertura step map > {log} 2>&1"
