# Tiles of one image are formed by so many jobs: --set-scatter tiles=8, or `set-scatter: tiles=8` in a profile.
scattergather:
    tiles=1,


rule scene:
    input:
        campaign.scene_sources(),
        list(campaign.height_files().values()),
    output:
        "results/scene.json",
    log:
        "results/logs/scene.log",
    benchmark:
        "results/benchmarks/scene.tsv"
    conda:
        "../../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 500 * attempt,
    params:
        settings=campaign.relevant("scene"),
        code=code_sha256("apertura.steps.scene"),
    message:
        "settling the campaign's grid"
    shell:
        "apertura step scene > {log} 2>&1"


rule terrain:
    input:
        "results/scene.json",
        list(campaign.height_files().values()),
    output:
        "results/terrain.manifest.json",
    log:
        "results/logs/terrain.log",
    benchmark:
        "results/benchmarks/terrain.tsv"
    conda:
        "../../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1000 * attempt,
    params:
        settings=campaign.relevant("terrain"),
        code=code_sha256("apertura.steps.terrain"),
    message:
        "bringing the DEM onto the campaign's grid"
    shell:
        "apertura step terrain > {log} 2>&1"


rule layers:
    input:
        [campaign.manifest("echo", campaign.image_flights[0].name, pair) for pair in campaign.image_flights[0].pairs],
        "results/scene.json",
        campaign.terrain_sources(),
    output:
        [f"results/layers/{export.file}" for export in exports_in("layers")],
    log:
        "results/logs/layers.log",
    benchmark:
        "results/benchmarks/layers.tsv"
    conda:
        "../../environment.yml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 1000 * attempt,
    params:
        code=code_sha256("apertura.steps.layers", *export_modules("layers")),
    message:
        "drawing how the scene is seen"
    shell:
        "apertura step layers --threads {threads} > {log} 2>&1"


rule tiles:
    input:
        "results/{flight}/{pair}/echo.manifest.json",
        "results/{flight}/{pair}/profile.manifest.json",
        "results/scene.json",
        campaign.terrain_sources(),
        lambda wildcards: list(campaign.pattern_files(wildcards.pair).values()),
    output:
        temp("results/{flight}/{pair}/tiles/{scatteritem}.json"),
    log:
        "results/logs/{flight}/{pair}.tiles.{scatteritem}.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.tiles.{scatteritem}.tsv"
    conda:
        "../../environment.yml"
    threads: 4
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
    params:
        settings=lambda wildcards: campaign.relevant("image", wildcards.pair),
        code=code_sha256("apertura.steps.image", *ENGINES.values()),
    message:
        "{wildcards.flight}: share {wildcards.scatteritem} of the tiles of {wildcards.pair}"
    shell:
        "apertura step tiles {wildcards.flight} {wildcards.pair} {wildcards.scatteritem} --threads {threads} > {log} 2>&1"


# One job alone forms the tiles and finishes the image; the shares of many are gathered.
rule image:
    input:
        "results/{flight}/{pair}/echo.manifest.json",
        "results/{flight}/{pair}/profile.manifest.json",
        "results/scene.json",
        campaign.terrain_sources(),
        lambda wildcards: list(campaign.pattern_files(wildcards.pair).values()),
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
    threads: 4
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
    params:
        settings=lambda wildcards: campaign.relevant("image", wildcards.pair),
        code=code_sha256("apertura.steps.image", *ENGINES.values()),
    message:
        "{wildcards.flight}: focusing {wildcards.pair} with {threads} threads"
    shell:
        "apertura step image {wildcards.flight} {wildcards.pair} --threads {threads} > {log} 2>&1"


rule assess:
    input:
        lambda wildcards: [
            campaign.manifest(stage, wildcards.flight, pair)
            for pair in campaign.flight(wildcards.flight).pairs
            for stage in ("echo", "image")
        ],
        "results/scene.json",
        campaign.terrain_sources(),
    output:
        "results/{flight}/assessment.json",
    log:
        "results/logs/{flight}/assess.log",
    benchmark:
        "results/benchmarks/{flight}/assess.tsv"
    conda:
        "../../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        settings=campaign.relevant("assess"),
        code=code_sha256("apertura.steps.assess"),
    message:
        "{wildcards.flight}: comparing the images with each other"
    shell:
        "apertura step assess {wildcards.flight} > {log} 2>&1"
