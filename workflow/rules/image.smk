# Tiles of one image are formed by so many jobs: --set-scatter tiles=8, or `set-scatter: tiles=8` in a profile.
scattergather:
    tiles=1,


rule scene:
    input:
        lambda wildcards: result_of(campaign, "scene").sources,
    output:
        "results/scene.json",
        "results/scene.manifest.json",
    log:
        "results/logs/scene.log",
    benchmark:
        "results/benchmarks/scene.tsv"
    conda:
        "../../environment.yml"
    threads: asked["scene"].threads
    resources:
        mem_mb=asked["scene"].mem_mb,
        runtime=asked["scene"].runtime,
    params:
        settings=lambda _: result_of(campaign, "scene").settings,
        code=lambda _: result_of(campaign, "scene").code_sha256,
    message:
        "settling the campaign's grid"
    shell:
        "apertura step scene > {log} 2>&1"


rule terrain:
    input:
        lambda wildcards: result_of(campaign, "terrain").sources,
    output:
        "results/terrain.manifest.json",
    log:
        "results/logs/terrain.log",
    benchmark:
        "results/benchmarks/terrain.tsv"
    conda:
        "../../environment.yml"
    threads: asked["terrain"].threads
    resources:
        mem_mb=asked["terrain"].mem_mb,
        runtime=asked["terrain"].runtime,
    params:
        settings=lambda _: campaign.relevant("terrain"),
        code=lambda _: result_of(campaign, "terrain").code_sha256,
    message:
        "bringing the DEM onto the campaign's grid"
    shell:
        "apertura step terrain > {log} 2>&1"


rule layers:
    input:
        lambda wildcards: result_of(campaign, "layers", wildcards.flight, wildcards.pair).sources,
    output:
        [f"results/{{flight}}/{{pair}}/{export.file}" for export in exports_in("layers")],
        "results/{flight}/{pair}/layers.manifest.json",
    log:
        "results/logs/{flight}/{pair}.layers.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.layers.tsv"
    conda:
        "../../environment.yml"
    threads: asked["layers"].threads
    resources:
        mem_mb=asked["layers"].mem_mb,
        runtime=asked["layers"].runtime,
    params:
        settings=lambda wildcards: result_of(campaign, "layers", wildcards.flight, wildcards.pair).settings,
        code=lambda wildcards: result_of(campaign, "layers", wildcards.flight, wildcards.pair).code_sha256,
    message:
        "{wildcards.flight}: how {wildcards.pair} sees the scene"
    shell:
        "apertura step layers {wildcards.flight} {wildcards.pair} --threads {threads} > {log} 2>&1"


rule refine:
    input:
        lambda wildcards: result_of(campaign, "refined_track", wildcards.flight).sources,
    output:
        "results/{flight}/refined_track.manifest.json",
    log:
        "results/logs/{flight}/refine.log",
    benchmark:
        "results/benchmarks/{flight}/refine.tsv"
    conda:
        "../../environment.yml"
    threads: asked["refine"].threads
    resources:
        mem_mb=asked["refine"].mem_mb,
        runtime=asked["refine"].runtime,
    params:
        settings=lambda _: campaign.relevant("refined_track"),
        code=lambda wildcards: result_of(campaign, "refined_track", wildcards.flight).code_sha256,
    message:
        "{wildcards.flight}: refining the tracks of its nodes where that pays"
    shell:
        "apertura step refine {wildcards.flight} > {log} 2>&1"


rule tiles:
    input:
        lambda wildcards: result_of(campaign, "image", wildcards.flight, wildcards.pair).sources,
    output:
        temp("results/{flight}/{pair}/tiles/{scatteritem}.json"),
    log:
        "results/logs/{flight}/{pair}.tiles.{scatteritem}.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.tiles.{scatteritem}.tsv"
    conda:
        "../../environment.yml"
    threads: asked["tiles"].threads
    resources:
        mem_mb=asked["tiles"].mem_mb,
        runtime=asked["tiles"].runtime,
    params:
        settings=lambda wildcards: campaign.relevant("image", wildcards.pair),
        code=lambda wildcards: result_of(campaign, "image", wildcards.flight, wildcards.pair).code_sha256,
    message:
        "{wildcards.flight}: share {wildcards.scatteritem} of the tiles of {wildcards.pair}"
    shell:
        "apertura step tiles {wildcards.flight} {wildcards.pair} {wildcards.scatteritem} --threads {threads} > {log} 2>&1"


# One job alone forms the tiles and finishes the image; the shares of many are gathered.
rule image:
    input:
        lambda wildcards: result_of(campaign, "image", wildcards.flight, wildcards.pair).sources,
        [
            share
            for share in gather.tiles("results/{{flight}}/{{pair}}/tiles/{scatteritem}.json")
            if "-of-1." not in share
        ],
    output:
        "results/{flight}/{pair}/image.manifest.json",
    log:
        "results/logs/{flight}/{pair}.image.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.image.tsv"
    conda:
        "../../environment.yml"
    threads: asked["image"].threads
    resources:
        mem_mb=asked["image"].mem_mb,
        runtime=asked["image"].runtime,
    params:
        settings=lambda wildcards: campaign.relevant("image", wildcards.pair),
        code=lambda wildcards: result_of(campaign, "image", wildcards.flight, wildcards.pair).code_sha256,
    message:
        "{wildcards.flight}: focusing {wildcards.pair} with {threads} threads"
    shell:
        "apertura step image {wildcards.flight} {wildcards.pair} --threads {threads} > {log} 2>&1"


rule assess:
    input:
        lambda wildcards: result_of(campaign, "assessment", wildcards.flight).sources,
    output:
        "results/{flight}/assessment.json",
        "results/{flight}/assessment.manifest.json",
    log:
        "results/logs/{flight}/assess.log",
    benchmark:
        "results/benchmarks/{flight}/assess.tsv"
    conda:
        "../../environment.yml"
    threads: asked["assess"].threads
    resources:
        mem_mb=asked["assess"].mem_mb,
        runtime=asked["assess"].runtime,
    params:
        settings=lambda _: campaign.relevant("assess"),
        code=lambda wildcards: result_of(campaign, "assessment", wildcards.flight).code_sha256,
    message:
        "{wildcards.flight}: comparing the images with each other"
    shell:
        "apertura step assess {wildcards.flight} > {log} 2>&1"
